"""The columns of a table of edges between two faces: what is known of each, whatever the faces belong to."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class EdgeRows:
    """One entry per edge; detached device arrays."""

    v0: mi.UInt32  # global vertex indices of the end points
    v1: mi.UInt32
    p0: mi.Point3f  # their positions [m]
    p1: mi.Point3f
    n0: mi.Normal3f  # unit normals of the adjacent faces, consistently oriented across the edge
    n1: mi.Normal3f
    angle: mi.Float  # exterior angle [rad]
    blur: mi.Float  # how far beside the edge a ray may still meet its faces, by rounding [m]
    inset0: mi.Float  # share of the way from the edge to the centroid of face 0 at which that face is looked at
    inset1: mi.Float  # the same of face 1
    border: mi.Bool
    seam: mi.Bool  # radiance may step here even where both faces are visible
    smooth: mi.Bool  # the faces share their shading normals: such a step is where one turns away from a light, no more
    pattern: mi.Bool  # textures or shading normals are split: such a step may be larger than the angle explains
    traced: mi.Bool  # several edges coincide here: what lies beside them is found by rays, not by topology
    moves: mi.Bool  # one of the faces can move
    shell0: mi.Float  # of face 0. +1: closed surface, normals outward; −1: inward; 0: either side can be seen
    shell1: mi.Float
    shape0: mi.UInt32  # index into the edge set's meshes, of the first face ...
    shape1: mi.UInt32  # ... and of the second
    prim0: mi.UInt32  # adjacent faces
    prim1: mi.UInt32
    corner0: mi.Vector2u  # corners of the faces at v0 and v1
    corner1: mi.Vector2u


def face_uv(corners: mi.Vector2u, t: mi.Float) -> mi.Point2f:
    """Barycentric (b1, b2) of the point at parameter `t` between two corners of a face, as Mitsuba's `prim_uv`."""

    def weight(corner: int) -> mi.Float:
        return dr.select(corners.x == corner, 1 - t, 0) + dr.select(corners.y == corner, t, 0)

    return mi.Point2f(weight(1), weight(2))
