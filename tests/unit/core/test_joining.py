"""Arrays one after the other: few on the device, many by way of the host; attached where they are."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.joining import FEW, joined

COUNTS = [1, 2, FEW, FEW + 1, 3 * FEW]


@pytest.mark.parametrize("count", COUNTS)
def test_values(variant, count):
    parts = [np.arange(k % 3 + 1) + 10 * k for k in range(count)]
    assert np.array_equal(joined([mi.UInt32(part) for part in parts]), np.concatenate(parts))
    assert np.array_equal(joined([mi.Bool(part % 2 == 0) for part in parts]), np.concatenate(parts) % 2 == 0)


@pytest.mark.parametrize("count", COUNTS)
def test_derivatives(variant, count):
    """Of the second array and the last, if there are several; of all others there is none."""
    parts = [mi.Float(np.arange(2) + k) for k in range(count)]
    moving = sorted({min(1, count - 1), count - 1})
    for k in moving:
        dr.enable_grad(parts[k])
    weights = mi.Float(np.arange(2 * count) + 1.0)
    dr.backward(dr.sum(joined(parts) * weights))
    for k in moving:
        assert np.array_equal(dr.grad(parts[k]), [2 * k + 1, 2 * k + 2])


@pytest.mark.parametrize("count", [2, FEW + 1])
def test_what_is_joined_is_left_as_it_was(variant, count):
    parts = [mi.Float([k, -k]) for k in range(count)]
    result = joined(parts)
    dr.scatter(result, mi.Float(7), mi.UInt32(0))
    assert np.array_equal(parts[0], [0, 0]) and not dr.grad_enabled(result)


def test_what_is_kept_follows_its_parts_and_has_a_limit(llvm, monkeypatch):
    from psdr_jit.core import joining

    joining._JOINED.clear()
    parts = [mi.Float([k, -k]) for k in range(FEW + 1)]
    first = np.array(joined(parts))
    assert len(joining._JOINED) == 1 and np.array_equal(joined(parts), first) and len(joining._JOINED) == 1
    dr.scatter(parts[3], mi.Float(7), mi.UInt32(0))
    assert np.array(joined(parts))[6] == 7 and len(joining._JOINED) == 2
    dr.enable_grad(parts[3])
    parts[3] += 1  # what is attached is read anew
    assert np.array(dr.detach(joined(parts)))[6] == 8
    monkeypatch.setattr(joining, "KEPT", 0)
    dr.scatter(parts[4], mi.Float(9), mi.UInt32(0))
    assert np.array(dr.detach(joined(parts)))[8] == 9 and not joining._JOINED
