"""Where discontinuities are: edges of meshes, curves of analytic shapes, intersections; one table of all of them."""
