"""Adjoints of chains whose ends have no finite derivative; and what the plan says of their random numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
from helpers import Leaves

from psdr_jit.boundary import chain
from psdr_jit.boundary.chain_outline import Curve
from psdr_jit.boundary.chain_sweeps import adjoints_at_start
from psdr_jit.boundary.chain_trace import ChainRecords
from psdr_jit.core.counters import Counter
from psdr_jit.core.records import Hit
from psdr_jit.core.streams import Stream
from psdr_jit.plan.motion import SceneMotion

LANES = 3
SLOPES = (np.inf, np.inf, 1.0)  # ∂F/∂o along x

# Directions of segments, by component.
SLANTING = ((0.6, 0.6, 0.6), (0, 0, 0), (-0.8, -0.8, -0.8))
EDGE_ON = ((0.6, 0.6, 1), (0, 0, 0), (-0.8, -0.8, 0))


@dataclass
class End:
    """The end of a chain, as `adjoints_at_start` knows it."""

    segment: mi.UInt32
    curve: Curve

    def attached_F(self, o, d, moving, facts):
        return self.curve.attached_F(o, d, moving, facts)


def curve_on(scene: mi.Scene) -> Curve:
    """Lines of sight past a point of the block, met head-on; F is not finite where `SLOPES` are not."""
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 2), mi.Vector3f(0, 0, -1))
    hit, nothing = Hit.of(ray, scene.ray_intersect_preliminary(ray)), dr.zeros(mi.Float, LANES)
    no = dr.zeros(mi.Bool, LANES)
    hit = dr.select(no, hit, hit)  # as wide as the others
    slope = mi.Vector3f(mi.Float(SLOPES), 0, 0)
    m = replace(hit, shape=dr.select(dr.arange(mi.UInt32, LANES) == 1, 0, hit.shape))  # of the second, on nothing
    zero = mi.Vector3f(0)
    return Curve(hit, no, no, zero, no, mi.Vector2f(0), no, nothing, m, m, slope, zero, zero, nothing, slope.x,
                 dr.isfinite(slope.x))  # fmt: skip


def adjoints(λ: tuple[float, ...], first: tuple | None = None):
    """`(λ_o, λ_d, gradient of the vertices, lanes that were dropped)` for the adjoints `λ` of F.

    `first`: directions in which a segment before the last meets the block, by component; None: there is no such.
    """
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}
    scene = mi.load_dict({"type": "scene", "block": {"type": "cube"}, "camera": camera}, optimize=False)
    leaf, rejected = Leaves(scene, "block.vertex_positions").attach(), Counter()
    with dr.suspend_grad():
        curve, records = curve_on(scene), ChainRecords(LANES, 2)
        records.write(mi.UInt32(1), curve.line, mi.Bool(True))
        if first is not None:
            records.write(mi.UInt32(0), replace(curve.line, d=mi.Vector3f(*map(mi.Float, first))), mi.Bool(True))
        end = End(dr.full(mi.UInt32, int(first is not None), LANES), curve)
        motion = SceneMotion(scene.sensors()[0])
        found = adjoints_at_start(SimpleNamespace(shapes=()), records, end, mi.Float(λ), motion, rejected)
    return *(np.array(v) for v in found), np.array(dr.grad(leaf)), int(rejected)


def test_zeros_are_not_spoilt(llvm):
    """λ = 0, as on every side that brings nothing: no parameter may become NaN of it."""
    λ_o, λ_d, vertices, dropped = adjoints((0, 0, 1))
    assert (λ_o[0] == [0, 0, 1]).all() and np.isfinite(λ_d).all()
    assert np.isfinite(vertices).all() and abs(vertices.sum() + 1) < 1e-5  # F = o − (the point of the block)
    assert dropped == 0


def test_ends_that_are_not_finite_are_dropped_and_counted(llvm):
    """Before they are carried back: the block, which they have met on their way, does not hear of them."""
    λ_o, λ_d, vertices, dropped = adjoints((0, 1, 1), SLANTING)
    assert np.isfinite(λ_o).all() and (λ_o[:, 1] == 0).all() and λ_o[0, 2] == 1 and (λ_d[:, :2] == 0).all()
    assert np.isfinite(vertices).all()
    assert dropped == 1


def test_ways_that_are_not_finite_are_dropped_and_counted(llvm):
    """A chain that meets a surface edge-on on its way slides along it without bounds."""
    λ_o, λ_d, _, dropped = adjoints((0, 0, 1), EDGE_ON)
    assert np.isfinite(λ_o).all() and np.isfinite(λ_d).all()
    assert dropped >= 1


def test_streams_of_the_term():
    """All that its lines draw from, those of the pilot from lights included."""
    names = {s for s in Stream if s.name.startswith(("CHAIN", "LIGHT_CHAIN"))}
    assert set(chain.TERM.streams) == names
