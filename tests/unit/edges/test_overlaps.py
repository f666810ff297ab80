"""Pairs of shapes that may cut into each other, by their boxes, and the warning for those that are not covered."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.memory import Memory
from psdr_jit.edges.overlaps import box_of, crossing, warn_about_pairs
from psdr_jit.errors import UnsupportedWarning

UNIT = np.array([[-1, -1, -1], [1, 1, 1]], float)
FLOOR = np.array([[-5, 0, -5], [5, 0, 5]], float)


@pytest.mark.parametrize(("a", "b", "expected"), [
    (UNIT, UNIT + 1, True),
    (UNIT, UNIT + [2, 0, 0], False),  # they touch
    (UNIT, UNIT + [2.1, 0, 0], False),
    (UNIT, FLOOR, True),
    (UNIT, FLOOR + [0, 1, 0], False),  # it rests on the box
    (UNIT, FLOOR + [0, 0.99, 0], True),
    (FLOOR, FLOOR + [1, 0, 0], False),  # one plane
    (FLOOR, FLOOR + [0, 0.1, 0], False),
    (FLOOR, np.array([[0, -1, -1], [0, 1, 1]], float), True),  # two upright planes that cross
    (UNIT * 1e-3, FLOOR * 1e-3, True),
    (UNIT * 1e3, UNIT * 1e3 + 1, True),
])  # fmt: skip
def test_crossing(a, b, expected):
    assert crossing([a, b]) == crossing([b, a]) == ([(0, 1)] if expected else [])


def shapes(**kinds):
    return [(mi.load_dict({"type": kind, "id": name, "to_world": to_world}), kind)
            for name, (kind, to_world) in kinds.items()]  # fmt: skip


def pairs_of(found):
    return crossing([box_of(shape) for shape, _ in found])


def warnings_about(found) -> int:
    """How many pairs are named at the first look."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_about_pairs(found, pairs_of(found), Memory())
    return len(caught)


def test_uncovered_pairs_are_named_once(llvm):
    T = mi.ScalarTransform4f
    found = shapes(tube=("cylinder", T()), floor=("disk", T().translate([0, 0, 0.5]).scale(3)),
                   box=("cube", T().translate([0, 0, 9])))  # fmt: skip
    said = Memory()
    with pytest.warns(UnsupportedWarning, match="'tube' .cylinder. and 'floor'") as caught:
        warn_about_pairs(found, pairs_of(found), said)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_about_pairs(found, pairs_of(found), said)


@pytest.mark.parametrize(("shift", "count"), [(0.5, 1), (2.5, 0), (1.95, 0)])
def test_two_balls(llvm, shift, count):
    """Their boxes overlap earlier than they do."""
    T = mi.ScalarTransform4f
    direction = np.ones(3) * shift / np.sqrt(3) * (2.1 / 1.95 if shift == 1.95 else 1)
    found = shapes(a=("sphere", T()), b=("sphere", T().translate(list(direction))))
    assert warnings_about(found) == count


def test_covered_pairs_are_not_named(llvm):
    T = mi.ScalarTransform4f
    found = shapes(ball=("sphere", T()), floor=("rectangle", T().scale(3)), box=("cube", T().translate([0.3, 0, 0])))
    assert warnings_about(found) == 0
    assert warnings_about(shapes(tube=("cylinder", T()), floor=("rectangle", T().translate([0, 0, 0.5]).scale(3)))) == 0


@pytest.mark.parametrize(("height", "count"), [(0.72, 0), (0.6, 1), (-0.5, 1)])
def test_a_tilted_disk_over_a_ball(llvm, height, count):
    """Their boxes overlap whether the disk, which leans by 45 degrees, cuts into the ball or not."""
    T = mi.ScalarTransform4f
    lean = T().translate([height, 0, height]).rotate([0, 1, 0], 45)
    found = shapes(ball=("sphere", T()), disk=("disk", lean))
    assert pairs_of(found) == [(0, 1)]
    assert warnings_about(found) == count


def test_a_tube_beside_a_corner(llvm):
    """Inside of the box of a bent mesh, and clear of it."""
    T = mi.ScalarTransform4f
    found = shapes(tube=("cylinder", T().translate([0, 0, 0.2]).scale([0.3, 0.3, 0.5])), box=("cube", T()))
    assert pairs_of(found) == [(0, 1)]
    assert warnings_about(found) == 0
