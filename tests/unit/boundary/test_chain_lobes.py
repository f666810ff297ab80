"""Chains leave glass by either lobe as often as it is worth, and never rarely."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.boundary.chain_lobes import LEAST_LOBE, leave

ETA, NUMBERS = 1.5, 1000


def leaving(cos: float, inside: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """`(led through, factors, reflected share)` of evenly spread random numbers, at this cosine of incidence."""
    bsdf = mi.load_dict({"type": "dielectric", "int_ior": ETA, "ext_ior": 1.0})
    scene = mi.load_dict({"type": "scene", "pane": {"type": "rectangle", "bsdf": bsdf}})
    up = -1 if inside else 1
    d = mi.Vector3f(float(np.sqrt(1 - cos**2)), 0, -up * cos)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0) - d, d))
    u = (dr.arange(mi.Float, NUMBERS) + 0.5) / NUMBERS
    onward = leave(si, mi.UInt32(0), mi.Point2f(0.5, u), None, mi.Bool(True), mi.BSDFContext())
    F = float(mi.fresnel(mi.Float(up * cos), ETA)[0][0])
    return np.array(onward.through), np.array(onward.factor).mean(0), F


@pytest.mark.parametrize(("cos", "inside"), [(0.9, False), (0.15, False), (0.9, True)])
def test_both_lobes_are_worth_what_they_are(llvm, cos, inside):
    through, factor, F = leaving(cos, inside)
    spread = ETA**2 if inside else ETA**-2  # of radiance that passes
    for lobe, value in ((~through, F), (through, (1 - F) * spread)):
        assert LEAST_LOBE <= lobe.mean() <= 1 - LEAST_LOBE
        assert np.isclose(factor[lobe].sum() / NUMBERS, value, rtol=0.01)
        assert np.ptp(factor[lobe]) < 1e-5 * value


def test_total_reflection_leaves_no_choice(llvm):
    through, factor, F = leaving(0.3, inside=True)
    assert F == 1 and not through.any() and np.allclose(factor, 1)
