"""What the size of a scene and its distance from the origin cost, in the precision that Mitsuba computes in."""

from __future__ import annotations

import mitsuba as mi

from .facts import SceneFacts

WORTH_SAYING = 1e-3
"""Smallest height at which rays start, relative to the scene's extent, to warn about.

The derivative is that of the image all the same. A box and its shadow over a tenth of the extent, made smaller or moved
away, against differences of the same scene: gain 1.01 at .7 %, 1.05 at 2.5 %; at 22 % there is no shadow in either."""

OUTLINES_TOO = 1.0
"""Offset / extent from where on rounded coordinates cost outlines that are seen directly: half of them at 2.6."""

LARGEST = 5e9
"""Largest coordinate or diagonal [units]. At 3.5e9 images and derivatives are right, at 3.5e10 neither is: products of
four lengths overflow."""


def overflow(facts: SceneFacts) -> str:
    """Why a scene is too large to be rendered at all; empty if it is not."""
    size = max(facts.extent, facts.reach)
    if size <= LARGEST or "double" in facts.variant:
        return ""
    return (f"the scene is {facts.extent:.2g} units across and reaches {facts.reach:.2g} units from the origin: beyond "
            f"{LARGEST:.0e} units products of lengths overflow single precision, and images are black or wrong; scale "
            "the scene down, or move it to the origin")  # fmt: skip


def lift_of(facts: SceneFacts) -> float:
    """The height at which Mitsuba starts rays above surfaces, at the far end of the scene, relative to its extent."""
    return mi.math.RayEpsilon * (1 + facts.reach) / facts.extent if facts.extent > 0 else 0.0


def too_low_for_shadows(facts: SceneFacts) -> str:
    """What that height costs this scene, in words; empty if it is next to nothing."""
    relative = lift_of(facts)
    if relative < WORTH_SAYING:
        return ""
    also = ", and rounding a part of the outlines" if relative > OUTLINES_TOO else ""
    way_out = "move it to the origin" if facts.reach > max(1.0, facts.extent) else "scale the scene up"
    return (f"the scene is {facts.extent:.2g} units across and reaches {facts.reach:.2g} units from the origin, where "
            f"Mitsuba starts rays {relative * facts.extent:.1g} units off surfaces, {relative:.1%} of that: images "
            f"lack shadows and reflections of what is lower, and so do derivatives{also}; {way_out}")  # fmt: skip
