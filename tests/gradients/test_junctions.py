"""Intersection curves alone: glowing shapes, so that nothing but the primary boundary has a derivative."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import assert_grad_close, fd, forward
from variants import also

from psdr_jit.derivative.perturbation import perturb

SEEDS, SPP, REFERENCE_SPP, EPS = 16, 64, 768, 0.004


def glow(value: float) -> dict:
    return {"type": "area", "radiance": {"type": "rgb", "value": [value, value / 2, value / 4]}}


def sunk(kind: str, side: float, tilt: float) -> mi.Scene:
    """Something that glows, halfway in a floor that glows in another colour, seen from above."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    look = T().look_at(origin=[0.3, 4, 2.2], target=[0, 0, 0], up=[0, 1, 0])
    turned = T().translate([0.05, -0.1, 0]).rotate([0.28, 0.96, 0], 25).scale(side)
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 1},
        "camera": {"type": "perspective", "fov": 28, "to_world": look, "film": film},
        "floor": {"type": "rectangle", "emitter": glow(0.5),
                  "to_world": T().rotate([1, 0, 0], -90 + tilt).scale(2.5)},
        "thing": {"type": kind, "emitter": glow(2.0), "to_world": turned},
    })  # fmt: skip


CASES = {
    "cube-up": ("cube", "thing.vertex_positions", (0, 1, 0), None),
    "cube-turns": ("cube", "thing.vertex_positions", None, (1, 0.2, 0)),
    "cube-floor-turns": ("cube", "floor.to_world", None, (1, 0, 0.3)),
    "ball-up": ("sphere", "thing.to_world", (0, 1, 0), None),
    "ball-floor-turns": ("sphere", "floor.to_world", None, (1, 0, 0.3)),
    "tube-up": ("cylinder", "thing.to_world", (0, 1, 0), None),
    "tube-turns": ("cylinder", "thing.to_world", None, (1, 0.2, 0)),
    "ball-floor-slides": ("sphere", "floor.to_world", (1, 0, 0), None),
}


FAST = ("ball-floor-slides",)  # the others are pieces of it, and of other tests


@pytest.mark.parametrize("case", [c if c in FAST else also(c) for c in CASES])
def test_against_finite_differences(llvm, monkeypatch, case):
    from psdr_jit.edges import segments

    kind, param, direction, rotate = CASES[case]
    scene = sunk(kind, 0.6, 7.0)
    motion = perturb(scene, param, direction, rotate=rotate)
    spec = {"type": "psdr_path", "max_depth": 1}
    estimate = forward(motion, spec, SEEDS, SPP)
    if case == "ball-floor-slides":  # in its own plane: nothing but its far border moves, which is out of view
        assert np.abs(estimate).max() < 1e-3
        return
    reference = fd(motion, spec, EPS, 2 * SEEDS, REFERENCE_SPP)
    assert_grad_close(estimate, reference, 0.02)

    monkeypatch.setattr(segments, "find_junctions", lambda solids, balls, memory: None)
    with pytest.raises(AssertionError):  # without the curves the comparison fails
        assert_grad_close(forward(motion, spec, SEEDS, SPP), reference, 0.02)


def test_they_are_updated_with_the_shapes(llvm):
    """A box that is lifted out of the floor and put back: the curve goes and comes, and rests are remembered."""
    from psdr_jit.core.memory import Memory
    from psdr_jit.edges.segments import edge_set

    scene = sunk("cube", 0.6, 0.0)
    params = mi.traverse(scene)
    original = mi.Float(params["thing.vertex_positions"])
    meshes, memory = list(scene.shapes()), Memory()

    def count() -> int:
        found = edge_set(meshes, [s.id() == "thing" for s in meshes], memory).junctions
        assert found is None or np.array(found.edges.moves).all()
        return 0 if found is None else len(np.array(found.edges.moves))

    def lift(height: float) -> None:
        points = dr.unravel(mi.Point3f, original) + mi.Vector3f(0, height, 0)
        params["thing.vertex_positions"] = dr.ravel(points)
        params.update()

    there = count()
    assert there >= 4
    lift(5.0)
    assert count() == 0
    lift(0.0)
    assert count() == there == count()


@pytest.mark.parametrize("tilt, lamp", [(78, 0.3), (12, 0.6355)], ids=["wide", "thin"])
def test_under_an_overhang_it_is_dark(llvm, tilt, lamp):
    """A panel leans over the place where it meets the floor: no step of light there, however close one looks.

    The thin shadow ends 2 mm from the panel, which is a step of 0.1 mm to the side for who looks along the floor.
    """
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    look = T().look_at(origin=[0.1, 0.2, 3], target=[0, 0, 0.05], up=[0, 1, 0])
    white = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    scene = mi.load_dict({
        "type": "scene", "camera": {"type": "perspective", "fov": 4, "to_world": look, "film": film},
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(4), "bsdf": white},
        "panel": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], tilt).scale(1.5), "bsdf": white},
        "lamp": {"type": "point", "position": [0.2, 3, lamp], "intensity": 10.0},
    }, optimize=False)  # fmt: skip
    only_outlines = {"type": "psdr_path", "max_depth": 2, "sppc": 0, "sppd": 0, "sppi": 0, "spps": 0, "sppp": 64}
    image = forward(perturb(scene, "panel.to_world", (0, 0, 1)), only_outlines, 2, 64)
    assert not image.any()
