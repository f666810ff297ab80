"""What the size of a scene and its distance from the origin cost, in the single precision that Mitsuba computes in."""

from __future__ import annotations

import math

from .facts import SceneFacts

RAY_OFFSET = 8.94e-5
"""Rays start this times (1 + largest coordinate) off a surface (`math::RayEpsilon`, `Interaction::offset_p`)."""

SHADOW_LOSS = 5.0
"""Shadows and reflections lose 1 - exp(-5 offset / extent) of their derivative.

Measured on two scenes, moved up to 1e5 units away or made up to 1e4 times smaller, whose shadows fall over a tenth of
their extent. Offset 0.3 % of the extent: 0.2 to 1 % lost; 2.6 %: 5 to 12 %; 26 %: 68 to 75 %; 76 %: 96 %."""

WORTH_SAYING = 0.005
"""Smallest loss to warn about."""

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


def loss(facts: SceneFacts) -> float:
    """Share of the derivative of shadows and reflections that Mitsuba's ray offsets swallow, about."""
    return -math.expm1(-SHADOW_LOSS * _relative_offset(facts)) if facts.extent > 0 else 0.0


def _relative_offset(facts: SceneFacts) -> float:
    return RAY_OFFSET * (1 + facts.reach) / facts.extent


def loss_by_offsets(facts: SceneFacts) -> str:
    """The loss to expect of this scene, in words; empty if there is next to none."""
    lost = loss(facts)
    if lost < WORTH_SAYING or "double" in facts.variant:
        return ""
    relative = _relative_offset(facts)
    parts = "moving shadows and reflections" + (", and a part of the outlines" if relative > OUTLINES_TOO else "")
    far = facts.reach > max(1.0, facts.extent)
    return (f"the scene is {facts.extent:.2g} units across and reaches {facts.reach:.2g} units from the origin, where "
            f"Mitsuba starts rays {relative * facts.extent:.1g} units off surfaces: expect to lose about {lost:.0%} of "
            f"the derivative of {parts}; {'move it to the origin' if far else 'scale the scene up'}")  # fmt: skip
