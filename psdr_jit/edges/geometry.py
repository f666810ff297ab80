"""Angle, convexity and normals of mesh edges, from the vertex positions of the moment.

`topology` says once per mesh which faces meet where; this module is cheap enough to repeat whenever the
vertices move.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.upload import uploaded
from .points import face_inset
from .topology import EdgeTopology

UNIT_ROUNDOFF = 2.0**-24  # of float32, in which rays are traced

#: Angle up to which two faces are taken for a quad in one plane [rad]. Rounded to six digits, as in files, the quads of
#: fine meshes are folded by 1e-4. Seen along such a quad one face may turn to the viewer and the other away, and where
#: the fold is concave, both of its sides were outlines: 12 % of a pixel, 2 % of the outline of a ball of 640 000 faces.
FOLDED_QUAD = 5e-4

MAX_BLUR = 1e-2  # of the longest side: a collapsed face is met nowhere


@dataclass
class EdgeTopologyDevice:
    """`EdgeTopology` on the device: one entry per edge. `f1 = f0` on a border: gathers stay valid."""

    v0: mi.UInt32
    v1: mi.UInt32
    f0: mi.UInt32
    f1: mi.UInt32
    apex0: mi.UInt32  # corner (0..2) of f0 that is not on the edge
    apex1: mi.UInt32  # corner (0..2) of f1 that is not on the edge
    corner0: mi.Vector2u  # corners of f0 that are v0 and v1
    corner1: mi.Vector2u  # corners of f1 that coincide with v0 and v1
    opposed: mi.Bool  # f1 traverses the edge from v1 to v0: the two faces are wound consistently
    border: mi.Bool
    split: mi.Bool  # UVs or shading normals may jump across this edge


@dataclass
class EdgeGeometry:
    """Shape of every edge: world space, detached, one entry per edge."""

    p0: mi.Point3f  # start of the edge [m]
    p1: mi.Point3f  # end of the edge [m]
    n0: mi.Normal3f  # unit normal of f0 by its winding; 0 if the face has collapsed
    n1: mi.Normal3f  # unit normal of f1 on the same side of the surface as n0; n0 on a border
    length: mi.Float  # [m]
    angle: mi.Float  # exterior dihedral angle [rad]: 0 coplanar, pi/2 on a cube, pi on a border
    convex: mi.Bool  # seen from the side of the normals, the surface bends away; False on a border
    border: mi.Bool
    blur: mi.Float  # how far beside the edge a ray may still meet one of its faces, by rounding [m]
    inset0: mi.Float  # share of the way from the edge to the centroid of f0 at which that face is looked at
    inset1: mi.Float  # the same of f1


def upload_topology(topology: EdgeTopology) -> EdgeTopologyDevice:
    """Copy an edge table to the device of the current variant."""
    border = topology.border
    corner0 = topology.corner0.astype(np.uint32)
    corner1 = np.where(border[:, None], topology.corner0, topology.corner1).astype(np.uint32)
    f1 = np.where(border, topology.f0, topology.f1)
    return EdgeTopologyDevice(
        v0=uploaded(mi.UInt32, topology.v0),
        v1=uploaded(mi.UInt32, topology.v1),
        f0=uploaded(mi.UInt32, topology.f0),
        f1=uploaded(mi.UInt32, f1),
        apex0=uploaded(mi.UInt32, 3 - corner0.sum(axis=1, dtype=np.uint32)),
        apex1=uploaded(mi.UInt32, 3 - corner1.sum(axis=1, dtype=np.uint32)),
        corner0=mi.Vector2u(*(uploaded(mi.UInt32, column) for column in corner0.T)),
        corner1=mi.Vector2u(*(uploaded(mi.UInt32, column) for column in corner1.T)),
        opposed=uploaded(mi.Bool, (corner1[:, 1] + 1) % 3 == corner1[:, 0]),
        border=uploaded(mi.Bool, border),
        split=uploaded(mi.Bool, topology.split),
    )


def edge_geometry(positions: mi.Point3f, faces: mi.Vector3u, topo_device: EdgeTopologyDevice) -> EdgeGeometry:
    """Normals, length, exterior angle and convexity of every edge.

    Args: `positions` (V) world space, `faces` (F), both of the mesh that `topo_device` was built from.
    Everything is detached: an edge table attached to the mesh buffers breaks forward mode through
    `ray_intersect`; callers attach the motion of an edge point on their own.
    """
    positions = dr.detach(positions)
    p0 = dr.gather(mi.Point3f, positions, topo_device.v0)
    p1 = dr.gather(mi.Point3f, positions, topo_device.v1)
    q0 = _apex(positions, faces, topo_device.f0, topo_device.apex0)
    q1 = _apex(positions, faces, topo_device.f1, topo_device.apex1)
    border = topo_device.border

    # Face f0 runs p0 → p1 → q0. On the same side of the surface, f1 then runs p1 → p0 → q1, whatever its own
    # winding: a mesh with a flipped face still has the silhouettes of one without.
    n0 = _unit_normal(p1 - p0, q0 - p0)
    n1 = dr.select(border, n0, _unit_normal(p0 - p1, q1 - p1))

    n0, n1 = _of_quads(topo_device, dr.width(faces), (p1 - p0, q0 - p0, q1 - p0), n0, n1)
    angle = _angle(n0, n1)
    return EdgeGeometry(
        p0=p0,
        p1=p1,
        n0=n0,
        n1=n1,
        length=dr.norm(p1 - p0),
        angle=dr.select(border, dr.pi, angle),
        convex=~border & (dr.dot(n0, q1 - p0) < 0),
        border=border,
        blur=dr.maximum(_blur(p0, p1, q0), _blur(p0, p1, q1)),
        inset0=face_inset(p0, p1, q0, n0, n1),
        inset1=face_inset(p0, p1, q1, n0, n1),
    )


def _angle(n0: mi.Normal3f, n1: mi.Normal3f) -> mi.Float:
    return dr.atan2(dr.norm(dr.cross(n0, n1)), dr.dot(n0, n1))


def _of_quads(
    topo: EdgeTopologyDevice, face_count: int, sides: tuple[mi.Vector3f, ...], n0: mi.Normal3f, n1: mi.Normal3f
) -> tuple[mi.Normal3f, mi.Normal3f]:
    """The normals, with that of the quad in place of those of its two faces: the mean by area, so that it turns to a
    viewer where the far side sticks out beyond the near one.

    `sides`: from the start of each edge to its end and to both apices. A face belongs to one quad at most, that of the
    first of its edges about which it is all but flat.
    """
    angle, edge = _angle(n0, n1), dr.arange(mi.UInt32, dr.width(topo.v0))
    flat = ~topo.border & (angle > 0) & (angle < FOLDED_QUAD)
    first = dr.full(mi.UInt32, dr.width(edge), face_count)  # of each face; no edge has this number
    for face in (topo.f0, topo.f1):
        dr.scatter_reduce(dr.ReduceOp.Min, first, edge, face, flat)
    flat &= (dr.gather(mi.UInt32, first, topo.f0) == edge) & (dr.gather(mi.UInt32, first, topo.f1) == edge)

    along, to0, to1 = sides
    whole = dr.normalize(dr.norm(dr.cross(along, to0)) * n0 + dr.norm(dr.cross(along, to1)) * n1)
    turned = dr.select(topo.opposed, 1.0, -1.0)  # a normal by the winding of f1 is on the other side of f0's, or not
    of_face = dr.zeros(mi.Normal3f, face_count)
    dr.scatter(of_face, mi.Normal3f(whole), topo.f0, flat)
    dr.scatter(of_face, mi.Normal3f(turned * whole), topo.f1, flat)
    q0, q1 = (dr.gather(mi.Normal3f, of_face, face) for face in (topo.f0, topo.f1))
    q1 = dr.select(topo.border, q0, turned * q1)
    return tuple(mi.Normal3f(dr.select(dr.squared_norm(q) > 0, q, n)) for q, n in ((q0, n0), (q1, n1)))


def _blur(a: mi.Point3f, b: mi.Point3f, c: mi.Point3f) -> mi.Float:
    """Rounding of a ray's barycentric coordinates on a triangle, as a length: ε L² / w for longest side L and width w.

    It matters on slivers: 1e-5 of the length of one that is a thousand times as long as wide.
    """
    longest2 = dr.maximum(dr.squared_norm(b - a), dr.maximum(dr.squared_norm(c - b), dr.squared_norm(a - c)))
    longest = dr.sqrt(longest2)
    width = dr.norm(dr.cross(b - a, c - a)) / longest
    return dr.minimum(UNIT_ROUNDOFF * longest2 / width, MAX_BLUR * longest)


def _apex(positions: mi.Point3f, faces: mi.Vector3u, face: mi.UInt32, corner: mi.UInt32) -> mi.Point3f:
    """Position of one corner of each face."""
    tri = dr.gather(mi.Vector3u, faces, face)
    vertex = dr.select(corner == 0, tri.x, dr.select(corner == 1, tri.y, tri.z))
    return dr.gather(mi.Point3f, positions, vertex)


def _unit_normal(a: mi.Vector3f, b: mi.Vector3f) -> mi.Normal3f:
    """Unit vector along a × b, 0 where a and b are parallel or vanish."""
    # Scaling first keeps the cross product of tiny faces (edges of 1e-12 m) out of the denormal range.
    a *= dr.select(dr.squared_norm(a) > 0, dr.rcp(dr.norm(a)), 0)
    b *= dr.select(dr.squared_norm(b) > 0, dr.rcp(dr.norm(b)), 0)
    n = dr.cross(a, b)
    length = dr.norm(n)
    return mi.Normal3f(dr.select(length > 0, n / length, 0))
