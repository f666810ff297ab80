"""Shapes that touch, or cut into each other, and move against each other: what is missing there, and is said.

For x on the one shape and y on the other, at the distances a and b from where they meet, the geometry term is of
degree −1 in (a, b) and its derivative, with both points at rest on their surfaces, of degree −2: its integral over both
depends on the shape of the corner that is left out. Rays start a little above surfaces and leave out one of the wrong
shape; the rest that this leaves does not depend on its size.

Where the two are at rest against each other, but the camera moves, or both of them before it, the material form has
the derivative at the vertex that is seen alone: what is seen slides over its surface, what it is lit by does not. With
a its distance, b that of the other point, the integral over b is 0 for reasons of scale, that of its square ~ 1/a²: the
derivative is right, and its variance, ∫ da / a² down to where rays start, far above what a few seeds show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot, key_of
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..plan.job import Job
from ..scene.names import shown_name
from ..scene.shading_normals import is_shaded_smoothly
from . import intersections as cut
from .contacts import Contact, normals_beside
from .segments import EdgeSet
from .solids import Ball, Solid, triangles
from .standing_rims import Body
from .topology import INVALID

#: Sine of the angle between two faces from which one stands off the other.
STANDS_OFF = 0.05

#: Sine of the angle between two faces up to which they are flush.
FLUSH = 1e-3

#: Of an integrator: by a question and the names of two shapes that touch, the contact and the answer.
ANSWERS: Slot[dict[tuple[str, str | int, str | int], tuple[Contact, bool]]] = Slot(dict)


@dataclass(frozen=True)
class Touching:
    """What shapes that touch, or cut into each other, ask for."""

    lamps: tuple[tuple[mi.Shape, mi.Shape], ...] = ()  # an area light, and what it touches at an angle
    movers: tuple[mi.Shape, mi.Shape] | None = None  # of which one moves against the other
    standing: tuple[tuple[mi.Shape, mi.Shape], ...] = ()  # of `lamps`, those with an edge or a face in the other
    glass: tuple[tuple[mi.Shape, mi.Shape], ...] = ()  # smooth glass, and what a face of it is flush with
    slid_over: tuple[mi.Shape, mi.Shape] | None = None  # at rest against each other, which what is seen slides over


def touching(found: EdgeSet, on_rims: Sequence[tuple[Body, Body]], camera_moves: bool, memory: Memory) -> Touching:
    """Of the edges that were found, and of what stands on rims."""
    glass = tuple(_flush_glass(found, memory))
    standing = tuple(_with_lamp(_standing(found, memory)))
    cut_lamps = tuple(_with_lamp((_shape(a), _shape(b)) for a, b in _cut(found)))
    met = [*_cut(found), *on_rims]
    movers = next(_moved_against(found, met), None)
    slid_over = next(_slid_over(found, met, camera_moves, memory), None)
    return Touching(standing + cut_lamps, movers, standing, glass, slid_over)


def warn_about_contacts(job: Job, contacts: Touching) -> None:
    """Say what is off where these touch, once.

    In the material form, the light from one to the other: 10 to 14 % for a box that slides on or in a floor. Of area
    lights that are followed on their material (`followed_lights.py` says which are not) the emission: the derivative by
    the camera is 10 to 15 % off for a cube of light in a floor, that of a box that sinks into a lamp 11 %.
    """
    if job.options.depth_limit < 2:
        return
    memory = job.call.memory
    asked_for = job.options.form != "auto" and job.form == "material"  # a pilot looks at it as well
    if asked_for and job.options.depth_limit > 2:
        _warn_about_material_form(contacts, memory)
    for glass, other in contacts.glass:
        warn_once(
            f"a face of '{shown_name(glass)}', which is smooth glass, lies in one of '{shown_name(other)}': which of "
            "the two a ray meets is rounding, in Mitsuba's images as well, and the derivative of what is seen through "
            "the glass there is noise; lift it by a hundredth of its size, or sink it in",
            UnsupportedWarning,
            memory,
        )
    if job.options.hide_emitters:
        _warn_about_hidden_lamps(contacts, memory)
    for lamp, other in contacts.lamps:
        if other.bsdf() is not None and mi.has_flag(other.bsdf().flags(), mi.BSDFFlags.Null):
            warn_once(
                f"the area light '{shown_name(lamp)}' cuts into '{shown_name(other)}', behind which it is seen: where "
                "the camera sees it on both sides, a part of the derivative is missing (a quarter for a ball of light "
                "half below a pane, as the field of view changes); keep them apart by a hundredth of their size",
                UnsupportedWarning,
                memory,
            )
        if job.form == "spatial" and not is_shaded_smoothly(lamp, memory):
            continue
        cure = "keep them apart by a hundredth of their size"
        cure += " or give it face_normals" if is_shaded_smoothly(lamp, memory) else ", or use form='spatial', or 'auto'"
        warn_once(
            f"the area light '{shown_name(lamp)}' touches '{shown_name(other)}' or cuts into it: where the two meet, "
            "the derivative of the light on it is wrong and noisy (15 % of the total if there is no other light), and "
            "so is what one "
            f"covers of the other if they move against each other; {cure}",
            UnsupportedWarning,
            memory,
        )


def _warn_about_material_form(contacts: Touching, memory: Memory) -> None:
    """Of what a path's points that stay on their surfaces do to light between two of them."""
    if contacts.movers is not None:
        a, b = contacts.movers
        warn_once(
            f"shapes '{shown_name(a)}' and '{shown_name(b)}' touch and move against each other: in "
            "the material form, which this integrator was asked for, the light that goes from one to the other where "
            "they meet is wrong (10 % of the "
            "derivative) and noisy; use form='spatial', or 'auto', which knows of contacts",
            UnsupportedWarning,
            memory,
        )
    if contacts.slid_over is not None:
        a, b = contacts.slid_over
        warn_once(
            f"shapes '{shown_name(a)}' and '{shown_name(b)}' touch, and what is seen slides over both: in the material "
            "form, which this integrator was asked for, the light that goes from one to the other where they meet is "
            "so noisy (30 times the standard deviation of the spatial form) that a few images do not show how noisy; "
            "use form='spatial', or 'auto'",
            UnsupportedWarning,
            memory,
        )


def _warn_about_hidden_lamps(contacts: Touching, memory: Memory) -> None:
    """Of lights that the camera looks through."""
    for lamp, other in contacts.standing:
        warn_once(
            f"the area light '{shown_name(lamp)}', which hide_emitters makes transparent, stands on "
            f"'{shown_name(other)}': where the camera sees through it what it stands on, a part of the derivative is "
            "missing (a quarter for a cube of light on a floor, as the camera moves); lift it by a hundredth of its "
            "size, or sink it in",
            UnsupportedWarning,
            memory,
        )
    for lamp, other in (pair for pair in contacts.lamps if pair[0].shape_type() == int(mi.ShapeType.Sphere)):
        warn_once(
            f"the sphere '{shown_name(lamp)}' is an area light, which hide_emitters makes transparent, and cuts into "
            f"'{shown_name(other)}': along the curve where they meet, the light on '{shown_name(other)}' changes with "
            "the root of the distance, and 5 to 10 % of the derivative there are missing; keep them apart by a "
            "hundredth of their size, or replace the sphere by a mesh",
            UnsupportedWarning,
            memory,
        )


def _with_lamp(pairs: Iterator[tuple[mi.Shape, mi.Shape]]) -> Iterator[tuple[mi.Shape, mi.Shape]]:
    """Those with a light, which comes first."""
    for a, b in pairs:
        yield from (pair for pair in ((a, b), (b, a)) if pair[0].is_emitter())


def _standing(found: EdgeSet, memory: Memory) -> Iterator[tuple[mi.Shape, mi.Shape]]:
    """Pairs with a light that meet at an angle: a flat light on a ceiling, in its plane, does not shine on that."""
    for c in found.contacts:
        if c.a is not c.b and _with_lamp_at_an_angle(c, memory):
            yield c.a.mesh, c.b.mesh


def _cut(found: EdgeSet) -> Iterator[tuple[Solid | Ball, Solid | Ball]]:
    """Pairs that cut into each other."""
    for first, second in found.junctions.pairs if found.junctions is not None else ():
        if first is not second:
            yield first, second


def _slid_over(
    found: EdgeSet, met: Sequence[tuple], camera_moves: bool, memory: Memory
) -> Iterator[tuple[mi.Shape, mi.Shape]]:
    """Pairs that meet at an angle, over which the rays of the camera slide though neither moves against the other."""
    bent = (c for c in found.contacts if c.a is not c.b and _answer(_bent_where_they_meet, c, memory))
    for a, b in chain(met, ((c.a, c.b) for c in bent)):
        if a.moves == b.moves and (camera_moves or a.moves):
            yield _shape(a), _shape(b)


def _with_lamp_at_an_angle(c: Contact, memory: Memory) -> bool:
    """Is one of the two a light, off which the other stands?"""
    return (c.a.mesh.is_emitter() or c.b.mesh.is_emitter()) and _answer(_at_an_angle, c, memory)


def _flush_glass(found: EdgeSet, memory: Memory) -> Iterator[tuple[mi.Shape, mi.Shape]]:
    """Pairs of smooth glass and what it stands on, say."""
    for c in found.contacts:
        pair = [shape for shape in (c.a.mesh, c.b.mesh) if _is_glass(shape)]
        if pair and c.a is not c.b and _answer(_flush, c, memory):
            yield pair[0], c.b.mesh if pair[0] is c.a.mesh else c.a.mesh


def _is_glass(shape: mi.Shape) -> bool:
    """Does it send light on in another direction on its far side?"""
    return shape.bsdf() is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)


def _answer(question: Callable[[Contact], bool], c: Contact, memory: Memory) -> bool:
    """What is the case of a contact, which is one object until a mesh changes."""
    key = (question.__name__, key_of(c.a.mesh), key_of(c.b.mesh))
    known = memory[ANSWERS].get(key)
    if known is None or known[0] is not c:
        known = (c, question(c))
        memory[ANSWERS][key] = known
    return known[1]


def _at_an_angle(contact: Contact) -> bool:
    """Does a face beside an edge that lies in a face of the other mesh stand off that face?"""
    return any(bool(np.any(sine > STANDS_OFF)) for sine in _sines(contact))


def _bent_where_they_meet(contact: Contact) -> bool:
    """Does a face beside an edge that is in the other mesh, or is an edge of both, stand off a face of that?"""
    return _at_an_angle(contact) or any(bool(np.any(sine > STANDS_OFF)) for sine in _sines_across(contact))


def _flush(contact: Contact) -> bool:
    """Does it lie in it?"""
    return any(bool(np.any(sine < FLUSH)) for sine in _sines(contact))


def _sines(contact: Contact) -> Iterator[np.ndarray]:
    """Of the angles between faces beside edges that lie in faces of the other mesh, and those faces."""
    a, b = triangles(contact.a), triangles(contact.b)
    for own, other, resting in ((a, b, contact.a_in_b), (b, a, contact.b_in_a)):
        for exists, here, there in normals_beside(own, other, resting):
            yield np.linalg.norm(np.cross(here, there), axis=1)[exists]


def _sines_across(contact: Contact) -> Iterator[np.ndarray]:
    """Of the angles between faces beside edges that both meshes have, one of each."""
    a, b, shared = triangles(contact.a), triangles(contact.b), contact.shared
    for here in a.edge_faces[shared.a].T:
        for there in b.edge_faces[shared.b].T:
            exist = (here != INVALID) & (there != INVALID)
            normals = [cut.unit_normals(m.corners(faces[exist])) for m, faces in ((a, here), (b, there))]
            yield np.linalg.norm(np.cross(*normals), axis=1)


def _moved_against(found: EdgeSet, met: Sequence[tuple]) -> Iterator[tuple[mi.Shape, mi.Shape]]:
    """Pairs that touch of which one can move."""
    for a, b in chain(((c.a, c.b) for c in found.contacts), met):
        if a.moves != b.moves:
            yield _shape(a), _shape(b)


def _shape(item: Solid | Ball | Body) -> mi.Shape:
    return item.mesh if isinstance(item, Solid) else item.shape
