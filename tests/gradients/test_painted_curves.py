"""Patterns on curves, by themselves: what the scene `painted_curves` (`problems`) does not tell apart."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import assert_grad_close, fd, forward

from psdr_jit import make_plan
from psdr_jit.core.curve_frame import frame_turn, radial, turns
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import UnsupportedWarning

SPLINE = ((-1.9, -0.6, -0.3, 0.34), (-0.9, 0.1, 0.4, 0.32), (0.1, -0.3, -0.3, 0.26), (0.9, 0.1, 0.3, 0.28),
          (1.6, -0.7, -0.2, 0.32))  # fmt: skip
RODS = ((-1.2, -0.3, 0.3, 0.3), (-0.4, 0.2, -0.5, 0.26), (0.4, -0.2, 0.4, 0.38), (1.2, 0.1, -0.3, 0.25))
CURVES = {"bsplinecurve": SPLINE, "linearcurve": RODS}
SHINY = {"type": "roughconductor", "alpha": 0.3, "material": "Ag"}

#: Enough for what is said before a ray is traced.
ONE_TERM = {"type": "psdr_path", "sppc": 1, "max_depth": 4}


def checkered(turn: float = 0, cells: tuple = (4, 6)) -> dict:
    to_uv = mi.ScalarTransform4f().rotate([0, 0, 1], turn).scale([cells[0] / 2, cells[1] / 2, 1])
    return {"type": "checkerboard", "color0": 0.1, "color1": 0.9, "to_uv": to_uv}


def texels() -> dict:
    data = np.random.default_rng(0).random((5, 3, 1)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest"}


def scene_of(folder, plugin: str, texture: dict, target=(0, 0, 0), fov=26, floor=None, bsdf=None) -> mi.Scene:
    path = folder / "curve.txt"
    path.write_text("\n".join(" ".join(map(str, p)) for p in CURVES[plugin]) + "\n")
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    pose = mi.ScalarTransform4f().look_at(origin=[0.3, -6, 1], target=target, up=[0, 0, 1])
    camera = {"type": "perspective", "fov": fov, "to_world": pose, "film": film}
    place = mi.ScalarTransform4f().translate([0, 0, -1.4]).scale(5)
    ground = {"type": "rectangle", "to_world": place, "bsdf": floor or {"type": "diffuse"}}
    lamp = {"type": "point", "position": [1.5, -4, 3], "intensity": 50.0}
    tube = {"type": plugin, "filename": str(path), "bsdf": bsdf or {"type": "diffuse", "reflectance": texture}}
    return mi.load_dict({"type": "scene", "camera": camera, "floor": ground, "lamp": lamp, "tube": tube},
                        optimize=False)  # fmt: skip


def assert_gain(scene: mi.Scene, param: str, depth: int = 2, step: float = 0.003, max_stderr=0.02, spp=512, **how):
    """Within 0.02; 0, −g and g/2 are shown to be rejected."""
    motion, spec = perturb(scene, param, **how), {"type": "psdr_path", "max_depth": depth}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedWarning)
        estimate = forward(motion, spec, 16, spp)
    assert_grad_close(estimate, fd(motion, spec, step, 128, spp), max_stderr)


@pytest.mark.slow
@pytest.mark.parametrize("plugin", CURVES)
@pytest.mark.parametrize("texture", [checkered, lambda: checkered(30), texels], ids=["checkered", "oblique", "texels"])
@pytest.mark.parametrize("param", ["tube.control_points", "camera.to_world"])
def test_it_slides_over_the_film(llvm, tmp_path, plugin, texture, param):
    assert_gain(scene_of(tmp_path, plugin, texture()), param, direction=(1, 0, 0.3))


@pytest.mark.slow
@pytest.mark.parametrize("plugin", CURVES)
def test_it_turns_with_a_single_control_point(llvm, tmp_path, plugin):
    """As the axis tilts, the pattern turns about it."""
    direction = np.zeros((len(CURVES[plugin]), 4))
    direction[2, :3] = 0.3, 1, 0.5
    assert_gain(scene_of(tmp_path, plugin, checkered(cells=(8, 4))), "tube.control_points", direction=direction.ravel())


@pytest.mark.slow
@pytest.mark.parametrize("plugin", CURVES)
def test_it_is_seen_in_a_shiny_floor(llvm, tmp_path, plugin):
    """The film shows the floor alone; finite differences are noisy."""
    scene = scene_of(tmp_path, plugin, checkered(), target=(0.1, -1.6, -1.4), fov=14, floor=SHINY)
    assert_gain(scene, "tube.control_points", 3, 0.015, 0.05, 6144, direction=(1, 0, 0))


@pytest.mark.parametrize("plugin", CURVES)
def test_what_is_said_of_it(llvm, tmp_path, plugin):
    """Nothing of patterns, of which points keep no place in the material form; slopes of bump maps are no edges."""
    spec = {**ONE_TERM, "form": "material"}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedWarning)
        plan = make_plan(scene_of(tmp_path, plugin, checkered()), "tube.control_points", integrator=spec)
    assert plan.form == "spatial"
    heights = {"type": "bitmap", "bitmap": mi.Bitmap(np.eye(4, dtype=np.float32)[..., None]), "raw": True}
    bump = {"type": "bumpmap", "map": heights, "of": {"type": "diffuse"}}
    with pytest.warns(UnsupportedWarning, match="steps inside its surface"):
        make_plan(scene_of(tmp_path, plugin, {}, bsdf=bump), "tube.control_points", integrator=spec)


def test_the_frame_turns_as_it_says(llvm):
    rng = mi.PCG32(1000)
    t, dt = (dr.normalize(mi.Vector3f(*(rng.next_float32() - 0.5 for _ in range(3)))) for _ in range(2))
    u, h = rng.next_float32(), 1e-3
    ahead, behind = (dr.normalize(t + s * h * dt) for s in (1, -1))
    (a, da), d = radial(t, u), (radial(ahead, u)[0] - radial(behind, u)[0]) / (2 * h)
    off = dr.abs(dr.dot(d, da) / dr.squared_norm(da) - frame_turn(t, dt))
    assert np.quantile(np.array(off), 0.98) < 1e-3  # near the z axis, it turns ever faster
    assert dr.allclose(turns(t, 2 * a + 3 * t), u, atol=1e-4)
