"""Shapes that lie flush and are moved apart, or into each other: there the image has a kink, in general.

One way a gap opens, through which one looks into the dark; the other way one shape sinks into the other, and the line
where they meet stays where it is. The terms see neither of the two: for them the edge moves over what it rests on.
Sliding along the contact is fine. Needs the direction of the derivative, which only forward mode has.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.ad import tangents
from ..core.compat import mesh_positions
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..plan.job import Job
from ..scene.names import shown_name
from .contacts import Contact
from .intersections import TriangleMesh, barycentric, unit_normals
from .solids import triangles
from .touching import Resting

#: Relative speed that counts as parting, relative to the largest speed of the two shapes: rounding is far below.
PARTING = 1e-3

#: Distance at which a derivative is that of shapes apart, relative to 1 + the largest coordinate: ten times the height
#: at which Mitsuba starts rays above surfaces.
CLEAR = 1e-3


def warn_about_parting(job: Job, contacts: tuple[Contact, ...]) -> None:
    """Name the shapes whose contact the motion opens, each pair once."""
    if job.call.mode != "forward":
        return
    velocities: dict[int, np.ndarray] = {}
    for contact in contacts:
        if not (contact.a.moves or contact.b.moves):
            continue
        for solid in (contact.a, contact.b):
            if solid.index not in velocities:
                velocities[solid.index] = vertex_velocities(solid.mesh)
        if _parts(contact, velocities):
            say_parted(job, contact.a.mesh, contact.b.mesh)


def say_parted(job: Job, a: mi.Shape, b: mi.Shape) -> None:
    """Of two shapes (or one, whose parts touch) that the motion parts."""
    names = f"parts of shape '{shown_name(a)}'" if a is b else f"shapes '{shown_name(a)}' and '{shown_name(b)}'"
    warn_once(
        f"flush contact: {names} touch, and the motion parts them or presses them into each other. To one side "
        "a gap opens, to the other it does not: in general the image has a kink here and no derivative, and "
        "what is computed is that of neither side. Lift or sink one of them by "
        f"{CLEAR * (1 + job.facts.reach):.1g} units, or slide it along the contact",
        UnsupportedWarning,
        job.call.memory,
    )


def vertex_velocities(mesh: mi.Mesh) -> np.ndarray:
    """(V, 3) of the vertices of a mesh, on the host."""
    return velocities_of(lambda: mesh_positions(mesh))


def velocities_of(points: Callable[[], mi.Point3f]) -> np.ndarray:
    """(N, 3) of points that are attached to what moves, on the host."""
    with dr.resume_grad():
        found = tangents(points())
    return np.array(mi.Vector3f(found), float).T


def _parts(contact: Contact, velocities: dict[int, np.ndarray]) -> bool:
    """Is there a common edge or a contact at which the two move against each other, not just along it?"""
    (a, v_a), (b, v_b) = ((triangles(s), velocities[s.index]) for s in (contact.a, contact.b))
    fastest = max(np.linalg.norm(v, axis=1).max() for v in (v_a, v_b))
    if fastest == 0:
        return False
    s = contact.shared
    along = a.positions[a.edges[s.a]].astype(float)
    along = along[:, 1] - along[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    against = [np.zeros(1)]
    for k in range(2):  # both ends of the common part
        w = _on_edges(a, v_a, s.a, s.on_a[:, k]) - _on_edges(b, v_b, s.b, s.on_b[:, k])
        against.append(np.linalg.norm(w - along * np.sum(along * w, axis=1, keepdims=True), axis=1))
    against += [off_faces(*pair) for pair in ((a, v_a, b, v_b, contact.a_in_b), (b, v_b, a, v_a, contact.b_in_a))]
    return bool(np.concatenate(against).max() > PARTING * fastest)


def _on_edges(mesh: TriangleMesh, values: np.ndarray, edge: np.ndarray, t: np.ndarray) -> np.ndarray:
    """`values` (V, 3) of the vertices, interpolated on edges."""
    start, end = values[mesh.edges[edge]].astype(float).transpose(1, 0, 2)
    return start + t[:, None] * (end - start)


def off_faces(own: TriangleMesh, v: np.ndarray, other: TriangleMesh, v_other: np.ndarray, found: Resting) -> np.ndarray:
    """Speeds at which the ends of stretches leave the faces that they lie in."""
    corners = other.corners(found.face)
    n = unit_normals(corners)
    speeds = []
    for k in range(2):
        x = _on_edges(own, own.positions, found.edge, found.on_edge[:, k])
        weights = barycentric(x, corners)[..., None]
        w = _on_edges(own, v, found.edge, found.on_edge[:, k]) - np.sum(weights * v_other[other.faces[found.face]], 1)
        speeds.append(np.abs(np.sum(w * n, axis=1)))
    return np.concatenate(speeds)
