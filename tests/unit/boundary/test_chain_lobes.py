"""Chains leave glass by either lobe as often as it is worth, and never rarely."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.boundary.chain_lobes import LEAST_LOBE, SPENT, Leaving, LobeNumber, leave, lobes_part

ETA, NUMBERS = 1.5, 1000


def leave_pane(u: mi.Float, cos: float, inside: bool, plugin: str = "dielectric") -> Leaving:
    """How random numbers have chains leave a pane that they meet at this cosine of incidence."""
    return met_and_left(u, cos, inside, plugin)[1]


def met_and_left(u: mi.Float, cos: float, inside: bool, plugin: str) -> tuple[mi.SurfaceInteraction3f, Leaving]:
    bsdf = mi.load_dict({"type": plugin, "int_ior": ETA, "ext_ior": 1.0})
    scene = mi.load_dict({"type": "scene", "pane": {"type": "rectangle", "bsdf": bsdf}})
    up = -1 if inside else 1
    d = mi.Vector3f(float(np.sqrt(1 - cos**2)), 0, -up * cos)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0) - d, d))
    onward = leave(si, mi.UInt32(0), mi.Point2f(0.5, u), None, mi.Bool(True), mi.BSDFContext())
    dr.eval(si, onward)  # with CUDA, no kernel traces rays in two scenes
    return si, onward


def even() -> mi.Float:
    return (dr.arange(mi.Float, NUMBERS) + 0.5) / NUMBERS


def leaving(cos: float, inside: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """`(led through, factors, reflected share)` of evenly spread random numbers, at this cosine of incidence."""
    onward = leave_pane(even(), cos, inside)
    F = float(mi.fresnel(mi.Float(-cos if inside else cos), ETA)[0][0])
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


@pytest.mark.parametrize("plugin", ["dielectric", "psdr_dielectric", "thindielectric"])
def test_what_is_left_of_a_number_is_uniform(llvm, plugin):
    """So one number chooses lobes at several vertices, each as often as it should, whichever went before."""
    first = leave_pane(even(), 0.9, False, plugin)
    P, through, rest = np.array(first.probability), np.array(first.through), np.array(first.rest)
    for lobe in (through, ~through):
        assert np.allclose(np.sort(rest[lobe]), (np.arange(lobe.sum()) + 0.5) / lobe.sum(), atol=1 / lobe.sum())
    number = LobeNumber.begin(even()).behind(first, mi.Bool(True))
    second = leave_pane(number.u, 0.8, True, plugin)
    both = through & np.array(second.through)
    assert abs(both.mean() - P[through][0] * np.array(second.probability)[both][0]) < 2 / NUMBERS


def test_a_spent_number_is_replaced(llvm):
    number = LobeNumber(mi.Float(0.25, 0.25), mi.Float(1, 0.5 * SPENT)).or_fresh(mi.Float(0.75))
    assert np.array_equal(number.u, [0.25, 0.75]) and np.array_equal(number.length, [1, 1])


def test_nothing_is_spent_where_there_is_no_choice(llvm):
    mirrored = leave_pane(even(), 0.3, True)
    number = LobeNumber.begin(even()).behind(mirrored, mi.Bool(True))
    assert np.allclose(number.u, even(), atol=1e-6) and np.array_equal(number.length, np.ones(NUMBERS))


@pytest.mark.parametrize(
    ("cosines", "inside"),
    [((0.42, 0.4), False), ((0.3, 0.15), False), ((0.78, 0.77), True), ((0.72, 0.77), True), ((0.76, 0.73), True)],
)
def test_where_the_choice_changes_is_told(llvm, cosines, inside):
    """Two chains with one number, which squared cosines lie evenly between: it is where reflectance and that meet,
    though total reflection begins there, below cos θ = .745. Straight lines are off by up to a half.
    """
    ends, onward = zip(*(met_and_left(even(), c, inside, "dielectric") for c in cosines), strict=True)
    chosen, where = (np.array(x) for x in lobes_part(ends, onward, (even(), even())))
    s = np.linspace(0, 1, 4001)
    cos = np.sqrt((1 - s) * cosines[0] ** 2 + s * cosines[1] ** 2)
    F = np.array(mi.fresnel(mi.Float(-cos if inside else cos), ETA)[0])
    edge = np.where(F < 1, LEAST_LOBE + (1 - 2 * LEAST_LOBE) * F, 1)
    u = np.array(even())
    assert np.array_equal(chosen, (u > min(edge[[0, -1]])) & (u < max(edge[[0, -1]]))) and chosen.any()
    rising = edge[-1] > edge[0]
    truth = np.interp(u, edge if rising else edge[::-1], s if rising else s[::-1])
    assert np.abs(where - truth)[chosen].max() < 0.14
