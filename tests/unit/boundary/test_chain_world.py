"""What the last segments of chains are looked at for."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import pytest

from psdr_jit.boundary.chain_world import ChainWorld, Last

DEPTH = 4  # segments 0 to 3


def world(last: Last, scene: mi.Scene | None = None) -> SimpleNamespace:
    return SimpleNamespace(last=last, depth=DEPTH, scene=scene)


@pytest.mark.parametrize(
    ("last", "smooth", "delta"),
    [
        (Last.ALL, [True, True, True], [True, True, True]),
        (Last.EMISSION, [True, True, False], [True, True, True]),
        (Last.NOTHING, [True, True, False], [True, True, False]),
    ],
)
def test_which_segments_are_followed(last, smooth, delta, llvm):
    k = mi.UInt32(0, 1, 2)
    for by_delta, expected in ((False, smooth), (True, delta)):
        found = mi.Bool(ChainWorld.goes_on(world(last), k, mi.Bool([by_delta] * 3))) & (k < DEPTH)
        assert list(found) == expected


@pytest.mark.parametrize("sky", [False, True])
def test_at_the_last_one_lights_alone_differ(sky, llvm):
    """A lamp from a wall, and the sky from anything, but no wall from another; before the last one all do."""
    parts = {
        "lamp": {"type": "rectangle", "emitter": {"type": "area"}},
        "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([4, 0, 0])},
        "other": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([8, 0, 0])},
    }
    scene = mi.load_dict({"type": "scene", **parts, **({"sky": {"type": "constant"}} if sky else {})})
    lamp, wall, other, nothing = (
        scene.ray_intersect(mi.Ray3f([x, 0, 5], [0, 0, -1])) for x in (0.0, 4.0, 8.0, 12.0)
    )
    pairs = ((lamp, wall, True), (wall, other, False), (wall, nothing, sky), (nothing, lamp, True))
    for a, b, expected in pairs:
        found = [mi.Bool(ChainWorld.differ(world(Last.EMISSION, scene), a, b, mi.UInt32(k)))[0] for k in (2, 3)]
        assert found == [True, expected]
        assert ChainWorld.differ(world(Last.ALL, scene), a, b, mi.UInt32(3)) is True
