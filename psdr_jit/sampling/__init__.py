"""Where on which edge to sample, and in which direction: distributions and their densities."""
