"""Estimators of other codes that need an environment of their own, one adapter each."""
