"""The step that all walks share: densities both ways, and walks that only look follow the paths of the real one."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.low_discrepancy import lane_sampler
from psdr_jit.paths.bounce import PathLimits
from psdr_jit.paths.dry_walk import count_vertices, touches
from psdr_jit.paths.rays import first_hit, interaction
from psdr_jit.paths.recording import PathRecords
from psdr_jit.paths.scattering import PLAIN, Mixture, mixture_pdf, reverse_pdf
from psdr_jit.paths.sink import NoSink
from psdr_jit.paths.walk import walk

COUNT = 1 << 12
DEPTH = 6
BSDFS = {
    "diffuse": {"type": "diffuse"},
    "rough conductor": {"type": "roughconductor", "alpha": 0.3},
    "rough dielectric": {"type": "roughdielectric", "alpha": 0.3},
    "rough plastic": {"type": "roughplastic", "alpha": 0.2},
    "mirror": {"type": "conductor"},
}


def room(bsdf: dict) -> mi.Scene:
    """A ball of that material on a floor, under a sky."""
    return mi.load_dict({
        "type": "scene",
        "ball": {"type": "sphere", "center": [0, 0, 1], "bsdf": bsdf},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
        "sky": {"type": "constant"},
    })  # fmt: skip


def rays() -> mi.Ray3f:
    rng = np.random.default_rng(0)
    target = mi.Point3f(rng.uniform(-1, 1, COUNT), rng.uniform(-1, 1, COUNT), rng.uniform(0, 2, COUNT))
    o = mi.Point3f(0, -4, 2.5)
    return mi.Ray3f(o, dr.normalize(target - o))


def sampler():
    return lane_sampler(mi.UInt32(7), dr.arange(mi.UInt32, COUNT))


def limits(**options):
    return PathLimits(**{"max_depth": DEPTH, "rr_depth": 3, **options})


def recorded(scene: mi.Scene, rules):
    records = PathRecords(COUNT, DEPTH)
    ray, pi, emission = first_hit(scene, rays(), False)
    _, records.count, _ = walk(scene, sampler(), ray, pi, rules, records, emission, mi.Bool(True))
    return records


@pytest.mark.parametrize("share", [0.0, 0.25])
@pytest.mark.parametrize("name", BSDFS)
def test_densities_both_ways(variant, name, share):
    """What a sink is handed knows the density of the path's own direction, and of the way back."""

    class Compare(NoSink):
        def scattered(self, k, scatter, active):
            found.append((scatter, scatter.pdf_reverse()))

    found = []
    scene = room(BSDFS[name])
    ray, pi, emission = first_hit(scene, rays(), False)
    # without a loop to record, the sink sees the first vertices as plain arrays
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
        walk(scene, sampler(), ray, pi, limits(max_depth=2, uniform_share=share), Compare(), emission, mi.Bool(True))
    scatter, reverse = found[0]
    s, si, bsdf = scatter.onward.scattering, scatter.si, scatter.bsdf
    smooth = scatter.onward.alive & ~s.delta

    back = mi.SurfaceInteraction3f(si)
    back.wi = mi.Vector3f(s.wo)
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    alone = bsdf.pdf(ctx, back, si.wi, smooth)
    expected = dr.select(smooth, mixture_pdf(back, bsdf, si.wi, alone, Mixture(share)), 0)
    assert np.allclose(np.array(reverse), np.array(expected), rtol=1e-6)
    forth = mixture_pdf(si, bsdf, s.wo, bsdf.pdf(mi.BSDFContext(), si, s.wo, smooth), Mixture(share))
    chosen = np.array(smooth)
    assert np.allclose(np.array(s.pdf)[chosen], np.array(forth)[chosen], rtol=1e-4)
    if share == 0:
        assert np.allclose(np.array(reverse)[chosen], np.array(alone)[chosen], rtol=1e-6)
    assert chosen.any() and (np.array(reverse)[chosen] > 0).mean() > 0.9
    assert not np.allclose(np.array(reverse)[chosen], np.array(s.pdf)[chosen], rtol=0.05), "the test shows nothing"
    assert not np.array(reverse)[~chosen].any()


def test_the_reverse_of_a_diffuse_surface(variant):
    """cosθ_i / π, whatever the outgoing direction."""
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.wi = dr.normalize(mi.Vector3f([0.5, 0.1], [0, 0.3], [0.5, 0.9]))
    si.t = mi.Float(1, 1)
    bsdf = mi.load_dict({"type": "diffuse"})  # the pointer does not keep it
    wo = dr.normalize(mi.Vector3f(0.3, 0, 0.2))
    pdf = reverse_pdf(mi.BSDFContext(), si, mi.BSDFPtr(bsdf), wo, PLAIN, mi.Bool(True))
    assert np.allclose(np.array(pdf), np.array(si.wi.z) / np.pi, rtol=1e-5)


@pytest.mark.parametrize("name", ["diffuse", "rough dielectric", "mirror"])
def test_records_keep_densities(variant, name):
    """Throughput follows from what a record keeps: β f cosθ / (pdf · survival) is the next vertex' throughput."""
    scene, rules = room(BSDFS[name]), limits()
    records = recorded(scene, rules)
    lane = dr.arange(mi.UInt32, COUNT)
    v = records.vertex(mi.UInt32(0), records.count > 1)
    following = records.arrival(mi.UInt32(1), records.count > 1)
    si = interaction(v.hit.intersection(), mi.Ray3f(v.hit.o, v.hit.d), rules)
    smooth = v.onward.goes_on() & ~v.onward.delta
    f = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(following.hit.d), smooth)
    expected, chosen = np.array(v.β * f * v.onward.inv_pdf()), np.array(smooth)
    assert chosen.any() and np.allclose(expected[:, chosen], np.array(following.β)[:, chosen], rtol=2e-3, atol=1e-5)
    assert np.array(v.onward.delta).any() == (name == "mirror")
    ended = np.array(records.count == 1)
    last = records.vertex(mi.UInt32(0), lane < COUNT).onward
    assert not np.array(last.goes_on())[ended].any() and not np.array(last.inv_pdf())[ended].any()
    assert np.all(np.array(last.survival)[chosen] == 1)  # the roulette starts later


def test_walks_that_look_follow_the_paths(variant):
    """Against the records of `walk`: which paths scatter at the ball, and how many vertices the longest one has."""
    scene, rules = room(BSDFS["rough dielectric"]), limits(rr_depth=2)
    records = recorded(scene, rules)
    ball = scene.shapes()[[s.id() for s in scene.shapes()].index("ball")]
    index = int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(ball))[0])
    table = mi.UInt32([int(i == index) for i in range(index + len(scene.shapes()) + 1)])

    met = np.zeros(COUNT, dtype=bool)
    for k in range(DEPTH - 1):  # the last vertex only emits
        here = mi.UInt32(k) < records.count
        met |= np.array(records.vertex(mi.UInt32(k), here).hit.shape == index) & np.array(here)
    found = np.array(touches(scene, sampler(), rays(), rules, False, table))
    assert np.array_equal(found, met) and 0.1 < met.mean() < 0.9

    unlimited = replace(rules, max_depth=2**31)
    few = count_vertices(scene, sampler(), rays(), unlimited, False)
    ray, pi, emission = first_hit(scene, rays(), False)
    _, count, _ = walk(scene, sampler(), ray, pi, unlimited, NoSink(), emission, mi.Bool(True))
    assert few == int(dr.max(count)[0]) or few == int(dr.max(count)[0]) + 1
    assert few > DEPTH


@pytest.mark.parametrize("rr_depth", [1, 50])
def test_black_paths_go_on_where_their_derivative_is_wanted(llvm, rr_depth):
    """Roulette would end a throughput of 0 for certain; without `end_black` it must not, however early it starts."""
    scene = room({"type": "diffuse", "reflectance": 0.0})
    counts = {}
    for end_black in (True, False):
        rules = limits(rr_depth=rr_depth, end_black=end_black)
        ray, pi, emission = first_hit(scene, rays(), False)
        _, vertices, _ = walk(scene, sampler(), ray, pi, rules, NoSink(), emission, mi.Bool(True))
        on_ball = np.array(pi.shape == mi.ShapePtr(scene.shapes()[0]))
        counts[end_black] = np.array(vertices)[on_ball]
    assert len(counts[True]) > COUNT / 10 and (counts[True] == 1).all()
    assert (counts[False] > 1).mean() > 0.9
