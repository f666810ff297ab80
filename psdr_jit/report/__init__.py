"""One self-contained page about a derivative or an optimisation: images, errors, curves."""
