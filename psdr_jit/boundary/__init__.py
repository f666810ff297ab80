"""The boundary terms: what the motion of discontinuities adds, one file for each, and the parts that they share."""
