"""Recovering parameters from images: variables, losses, the loop, checkpoints."""
