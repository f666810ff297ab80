"""Edges that lie in a face of another body which looks the same way: boards that reach into a post, flush in front.

Of such an edge one face goes on as the other body's, and the other lies inside of it: what is known of them is not what
is seen there. Both sides are traced.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.joining import starts
from ..core.upload import uploaded
from .contacts import FLAT, Contact, normals_beside
from .intersections import TriangleMesh
from .rows import EdgeRows
from .solids import Solid, triangles
from .touching import Resting


def trace_in_flush_faces(rows: EdgeRows, solids: Sequence[Solid], contacts: Sequence[Contact]) -> None:
    """Mark such rows, in place: one for each edge of `solids`, in order. Of bodies that both move or both rest."""
    first = starts([len(solid.topology) for solid in solids])
    found: set[int] = set()
    for contact in contacts:
        if contact.a.moves != contact.b.moves:
            continue
        for own, other, resting in ((contact.a, contact.b, contact.a_in_b), (contact.b, contact.a, contact.b_in_a)):
            if len(resting.edge):
                edges = _alike(triangles(own), triangles(other), resting)
                found.update((first[own.index] + edges).tolist())
    if found:
        dr.eval(rows.traced)
        dr.scatter(rows.traced, mi.Bool(True), uploaded(mi.UInt32, np.array(sorted(found), np.uint32)))


def _alike(own: TriangleMesh, other: TriangleMesh, resting: Resting) -> np.ndarray:
    """The edges of which a face looks the same way as the face in which they rest."""
    same = np.zeros(len(resting.edge), bool)
    for exists, here, there in normals_beside(own, other, resting):
        turned = np.linalg.norm(np.cross(here, there), axis=1)
        same |= exists & (turned < FLAT) & (np.sum(here * there, axis=1) > 0)
    return resting.edge[same]
