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

from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from ..plan.job import Job
from .segments import EdgeSet
from .solids import Ball, Solid


def warn_about_material(job: Job, found: EdgeSet) -> None:
    """Say that the material form is off where shapes touch, once: 10 to 14 % for a box that slides on or in a floor."""
    if job.form != "material" or job.options.depth_limit < 3 or dr.flag(dr.JitFlag.FreezingScope):
        return
    for a, b, _ in _moved_against(found):
        warn_once(
            f"shapes '{a.id()}' and '{b.id()}' touch and move against each other: in the material form, which this "
            "integrator was asked for, the light that goes from one to the other where they meet is wrong (10 % of the "
            "derivative) and noisy; use form='spatial', or 'auto', which knows of contacts",
            UnsupportedWarning,
            job.call.memory,
        )
        return


def warn_about_lamps(job: Job, found: EdgeSet) -> None:
    """Name shapes that stand on, or in, an area light, each pair once.

    What they cover of it does not shine. Points of lights are followed on their material, so that the border of what
    is covered moves over them: an edge of the light, which is sampled for the primary term only.
    """
    if job.options.depth_limit < 2 or dr.flag(dr.JitFlag.FreezingScope):
        return
    for a, b, covers in _moved_against(found):
        lamp, other = (a, b) if a.is_emitter() else (b, a)
        if covers:
            warn_once(
                f"shape '{other.id()}' touches the area light '{lamp.id()}' and moves against it: what it covers or "
                "uncovers of the light is missing from the derivative of what that shines on; keep them apart, or move "
                "them together",
                UnsupportedWarning,
                job.call.memory,
            )


def _moved_against(found: EdgeSet) -> Iterator[tuple[mi.Shape, mi.Shape, bool]]:
    """Pairs that touch of which one can move, and whether one covers a part of the other, a light."""
    for c in found.contacts:
        a, b = c.a.mesh, c.b.mesh
        if c.a.moves != c.b.moves:
            yield a, b, bool((a.is_emitter() and len(c.b_in_a.edge)) or (b.is_emitter() and len(c.a_in_b.edge)))
    for first, second in found.junctions.pairs if found.junctions is not None else ():
        a, b = _shape(first), _shape(second)
        if first.moves != second.moves:
            yield a, b, a.is_emitter() or b.is_emitter()


def _shape(item: Solid | Ball) -> mi.Shape:
    return item.mesh if isinstance(item, Solid) else item.shape
