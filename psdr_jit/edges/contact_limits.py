"""Shapes that touch, or cut into each other, and move against each other: what is missing there, and is said.

For x on the one shape and y on the other, at the distances a and b from where they meet, the geometry term is of
degree −1 in (a, b) and its derivative, with both points at rest on their surfaces, of degree −2: its integral over both
depends on the shape of the corner that is left out. Rays start a little above surfaces and leave out one of the wrong
shape; the rest that this leaves does not depend on its size.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..plan.job import Job
from .contacts import Contact
from .intersections import TriangleMesh
from .segments import EdgeSet
from .solids import Ball, Solid, triangles
from .topology import INVALID

#: Sine of the angle between two faces from which one stands off the other.
STANDS_OFF = 0.05

#: Of an integrator: contacts with lights that have been looked at, by the names of the two.
LOOKED_AT: Slot[dict[tuple[str, str], Contact]] = Slot(dict)


def warn_about_material(job: Job, found: EdgeSet) -> None:
    """Say that the material form is off where shapes touch, once: 10 to 14 % for a box that slides on or in a floor."""
    if job.form != "material" or job.options.depth_limit < 3 or dr.flag(dr.JitFlag.FreezingScope):
        return
    for a, b in _moved_against(found):
        warn_once(
            f"shapes '{a.id()}' and '{b.id()}' touch and move against each other: in the material form, which this "
            "integrator was asked for, the light that goes from one to the other where they meet is wrong (10 % of the "
            "derivative) and noisy; use form='spatial', or 'auto', which knows of contacts",
            UnsupportedWarning,
            job.call.memory,
        )
        return


def warn_about_lamps(job: Job, found: EdgeSet) -> None:
    """Name area lights that touch what they shine on, each pair once.

    The emitted light is followed on the light's material in both forms: beside the curve where the two meet it has the
    corner of the module's text, and what a mover covers or uncovers of the light is no edge of the terms that need it.
    Of a cube of light in a floor, the derivative by the camera is 10 to 15 % off; of a box that sinks into a lamp 11 %.
    """
    if job.options.depth_limit < 2 or dr.flag(dr.JitFlag.FreezingScope):
        return
    for a, b in _touching_lamps(found, job.call.memory):
        lamp, other = (a, b) if a.is_emitter() else (b, a)
        warn_once(
            f"the area light '{lamp.id()}' touches '{other.id()}' or cuts into it: where the two meet, the derivative "
            "of the light on it is wrong and noisy (15 % of the total if there is no other light), and so is what one "
            "covers of the other if they move against each other; keep them apart by a hundredth of their size",
            UnsupportedWarning,
            job.call.memory,
        )


def _touching_lamps(found: EdgeSet, memory: Memory) -> Iterator[tuple[mi.Shape, mi.Shape]]:
    """Pairs with a light that meet at an angle: a flat light on a ceiling, in its plane, does not shine on that.

    A contact that has been looked at before is left out: it is one and the same object until a mesh changes.
    """
    for c in found.contacts:
        a, b = c.a.mesh, c.b.mesh
        if c.a is c.b or not (a.is_emitter() or b.is_emitter()) or memory[LOOKED_AT].get((a.id(), b.id())) is c:
            continue
        memory[LOOKED_AT][a.id(), b.id()] = c
        if _at_an_angle(c):
            yield a, b
    for first, second in found.junctions.pairs if found.junctions is not None else ():
        a, b = _shape(first), _shape(second)
        if first is not second and (a.is_emitter() or b.is_emitter()):
            yield a, b


def _at_an_angle(contact: Contact) -> bool:
    """Does a face beside an edge that lies in a face of the other mesh stand off that face?"""
    a, b = triangles(contact.a), triangles(contact.b)
    for own, other, resting in ((a, b, contact.a_in_b), (b, a, contact.b_in_a)):
        n_other = _normals(other)[resting.face]
        for k in range(2):
            beside = own.edge_faces[resting.edge, k]
            there = beside != INVALID
            n_own = _normals(own)[beside[there]]
            if np.any(np.linalg.norm(np.cross(n_own, n_other[there]), axis=1) > STANDS_OFF):
                return True
    return False


def _normals(mesh: TriangleMesh) -> np.ndarray:
    """(F, 3) unit normals."""
    corners = mesh.positions[mesh.faces].astype(float)
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), np.finfo(float).tiny)


def _moved_against(found: EdgeSet) -> Iterator[tuple[mi.Shape, mi.Shape]]:
    """Pairs that touch of which one can move."""
    for c in found.contacts:
        if c.a.moves != c.b.moves:
            yield c.a.mesh, c.b.mesh
    for first, second in found.junctions.pairs if found.junctions is not None else ():
        if first.moves != second.moves:
            yield _shape(first), _shape(second)


def _shape(item: Solid | Ball) -> mi.Shape:
    return item.mesh if isinstance(item, Solid) else item.shape
