"""Which way places on the film go, and what of it is looked at."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from helpers import load
from problems import Problem

from psdr_jit.core.records import Hit
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver.prepare import prepare
from psdr_jit.plan.film_flow import _in_front
from psdr_jit.plan.probe_motion import probe_motion

COLUMNS, ROWS = 5, 3
NONE, FLOOR, BALL = 0, 1, 2


def seen(shape: list, t: list) -> Hit:
    """What corners see, in `ROWS` rows; numbered by the first coordinate of where their rays start."""
    hit = Hit.made(dr.zeros, COLUMNS * ROWS)
    hit.shape = mi.UInt32(np.ravel(shape).astype(np.uint32))
    hit.t = mi.Float(np.ravel(t).astype(np.float32))
    hit.o = mi.Point3f(mi.Float(dr.arange(mi.UInt32, COLUMNS * ROWS)), 0, 0)
    return hit


def taken(shape: list, t: list) -> list:
    """By corner: the number of the one whose surface it moves with."""
    found = _in_front(seen(shape, t), dr.arange(mi.UInt32, COLUMNS * ROWS), COLUMNS, ROWS)
    return np.array(found.o.x).astype(int).reshape(ROWS, COLUMNS).tolist()


def test_corners_move_with_what_is_in_front(llvm):
    """A ball in the upper left corner, before a floor and nothing at all; its own corners stay with themselves."""
    shape = [[BALL, BALL, FLOOR, FLOOR, NONE], [BALL, NONE, FLOOR, FLOOR, NONE], [NONE, NONE, FLOOR, FLOOR, NONE]]
    t = [[1.0, 1.05, 3.0, 3.0, 0.0], [1.1, 0.0, 3.0, 3.0, 0.0], [0.0, 0.0, 3.0, 3.0, 0.0]]
    assert taken(shape, t) == [[0, 1, 1, 3, 3], [5, 0, 1, 8, 3], [5, 5, 12, 13, 8]]


def test_on_one_shape_only_what_is_clearly_nearer_counts(llvm):
    """A floor that recedes along the rows, with a step in it."""
    t = [[3.0, 3.0, 3.0, 2.9, 2.9]] * ROWS
    assert taken([[FLOOR] * COLUMNS] * ROWS, t) == np.arange(COLUMNS * ROWS).reshape(ROWS, COLUMNS).tolist()
    t = [[3.0, 3.0, 3.0, 2.0, 2.0]] * ROWS
    assert [row[2] % COLUMNS for row in taken([[FLOOR] * COLUMNS] * ROWS, t)] == [3] * ROWS


def test_the_probe_leaves_a_resting_camera_where_it_is(llvm):
    """What it made of the film form, as if the camera moved with the ball, had kept it from being chosen."""
    for name, moves in (("ball.vertex_positions", False), ("camera.to_world", True)):
        motion = perturb(load(Problem("smooth_mesh", name, 0.0)), name, (1, 0, 0))
        motion.attach()
        call = integrator_specs.build({"type": "psdr_path", "max_depth": 2}).call(
            motion.scene, motion.scene.sensors()[0], 0, 4
        )
        probe = probe_motion(motion.scene, prepare(call).facts)
        o, d = probe.camera_tangents(mi.Ray3f([0, 0, 4], [0, 0, -1]))
        assert (np.abs(np.array([o, d])).max() > 0) == moves
        motion.restore()
