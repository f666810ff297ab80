"""Shading outlines: curves inside smooth-shaded faces, on which the interpolated normal turns away from the viewer.

A BSDF and an area light are evaluated in the shading frame: what a point x sends along −ω steps where h = n(x)·ω = 0,
ω the direction of view and n the interpolated normal. Position and normal are linear on a face, so that the gradient
∇h within the face is constant for a fixed ω (`kind_within_faces` says how the curve moves, and how lines that see it
from anywhere are drawn).

*From a viewpoint* o (the sensor) they are found directly: the curve h(x, (x − o)/|x − o|) = 0 separates one corner A,
or none, from the others. With E(s) on the side opposite to A, and x = A + r (E − A), h |x − o| is quadratic in r; one
root lies between corners of different sign. Per unit of s the curve weighs |∇h| |∂x/∂s × ∂x/∂r| / |∂h/∂r|, where h is
taken as seen from o.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .kind import Use
from .kind_mirror_horizon import MirroredFace
from .kind_within_faces import CurvesWithinFaces
from .shading_curve import Face


class ShadingOutlines(CurvesWithinFaces):
    """Where n is the interpolated normal."""

    def of_corners(self, p: list[mi.Point3f], n: list[mi.Normal3f]) -> Face:
        return Face(p, n)

    def other_curve(self, face: Face) -> Face:
        return MirroredFace(face.p, face.n)

    def line_weights(self, use: Use) -> mi.Float:
        if use is Use.SHADOW:
            return dr.zeros(mi.Float, self.count)
        return self.bends(self.all_faces())
