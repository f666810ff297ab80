"""Tools around one derivative: images with error bars, finite differences, the verdict of a comparison, files."""
