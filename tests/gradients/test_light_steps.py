"""Pictures and hard cones that slide over what they light: lights, receivers and the camera moved, against finite
differences. Without the steps of the lights, gains are 0 to 0.2 where nothing else moves.
"""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, fd, forward, kernels_compiled

import psdr_jit
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain

slow = pytest.mark.slow
TOLERANCE, MAX_STDERR = 0.02, 0.01
STEP, TURN, OPENING = 0.005, 0.002, 0.05  # of finite differences [scene units, rad, degrees]
MOVED, RAISED, TURNED = {"direction": (1, 0, 0)}, {"direction": (0, 0.3, 1)}, {"rotate": (1, 0.3, 0.2)}


def pose(origin=(0.3, -0.8, 2.5), target=(0.05, 0, 0)):
    return mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0.2])


def picture(height: int = 5, width: int = 8, nearest: bool = True, **others) -> dict:
    data = 0.1 + np.random.default_rng(0).random((height, width, 3)).astype(np.float32)
    filtered = {"filter_type": "nearest" if nearest else "bilinear", **others}
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, **filtered}


def projector(irradiance=1.0) -> dict:
    return {"type": "projector", "irradiance": irradiance, "fov": 32.0, "to_world": pose()}


def spot(beam: float = 16.0, **others) -> dict:
    return {"type": "spot", "cutoff_angle": 16.0, "beam_width": beam, "intensity": 20.0, "to_world": pose(), **others}


def card(bsdf: dict | None = None) -> dict:
    """In the beam, in part."""
    place = mi.ScalarTransform4f().translate([0.3, 0.1, 0.8]).rotate([1, 0, 0], 10).scale(0.35)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf or {"type": "twosided", "of": {"type": "diffuse"}}}


def wall() -> dict:
    """Behind the floor, above it: it sees what is lit there, and touches nothing."""
    place = mi.ScalarTransform4f().translate([0, 1.3, 2.1]).rotate([1, 0, 0], 90).scale(2)
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.8}}


def scene_of(light: dict, floor: dict | None = None, **others) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    view = mi.ScalarTransform4f().look_at(origin=[0.4, -3, 2.6], target=[0, 0, 0], up=[0, 0, 1])
    camera = {"type": "perspective", "fov": 35, "to_world": view, "film": film}
    bsdf = floor or {"type": "diffuse", "reflectance": 0.6}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2), "bsdf": bsdf}
    return mi.load_dict({"type": "scene", "camera": camera, "floor": floor, "light": light, **others}, optimize=False)


def assert_gain(scene: mi.Scene, param: str, how: dict, seeds: int = 8, spp: int = 512, **options):
    motion = perturb(scene, param, **how)
    spec = {"type": "psdr_path", "max_depth": 2, **options}
    step = OPENING if param.endswith("angle") else STEP if "direction" in how else TURN
    reference = fd(motion, spec, step, 4 * seeds, 2 * spp)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slope = gain(forward(motion, spec, seeds, spp), reference[0::2], reference[1::2])
    assert slope.stderr < MAX_STDERR, slope
    assert abs(slope.value - 1) < TOLERANCE + 2 * slope.stderr, slope


@pytest.mark.parametrize("light, param, how", [
    pytest.param(projector, "light.to_world", MOVED, id="frame-moved", marks=slow),
    pytest.param(projector, "light.to_world", TURNED, id="frame-turned", marks=slow),
    pytest.param(projector, "floor.to_world", RAISED, id="frame-floor-raised", marks=slow),
    pytest.param(projector, "camera.to_world", {"rotate": (0, 0, 1)}, id="frame-camera-turned", marks=slow),
    pytest.param(lambda: projector(picture()), "light.to_world", MOVED, id="texels-moved", marks=slow),
    pytest.param(lambda: projector(picture(7, 4)), "light.to_world", TURNED, id="texels-turned", marks=slow),
    pytest.param(lambda: projector(picture(nearest=False)), "floor.to_world", RAISED, id="smooth-picture", marks=slow),
    pytest.param(spot, "light.to_world", MOVED, id="spot-moved", marks=slow),
    pytest.param(spot, "light.to_world", TURNED, id="spot-turned", marks=slow),
    pytest.param(spot, "floor.to_world", RAISED, id="spot-floor-raised", marks=slow),
    pytest.param(spot, "camera.to_world", MOVED, id="spot-camera-moved", marks=slow),
])  # fmt: skip
def test_a_plane(llvm, light, param, how):
    assert_gain(scene_of(light()), param, how)


@slow
@pytest.mark.parametrize("texture", [
    pytest.param(lambda to_uv: {"type": "checkerboard", "to_uv": to_uv}, id="checkerboard"),
    pytest.param(lambda to_uv: picture(3, 4, wrap_mode="mirror", to_uv=to_uv), id="mirrored-texels"),
])  # fmt: skip
def test_turned_texture_coordinates(llvm, texture):
    to_uv = mi.ScalarTransform4f().rotate([0, 0, 1], 25).scale([2.3, 1.7, 1])
    assert_gain(scene_of(projector(texture(to_uv))), "light.to_world", MOVED)


@slow
@pytest.mark.parametrize("beam", [8.0, 16.0])
def test_a_spot_with_a_picture(llvm, beam):
    """Its square just holds the cone: lines on its sides touch the rim, and light nothing."""
    assert_gain(scene_of(spot(beam, texture=picture(6, 6))), "light.to_world", MOVED, spp=2048)


@slow
def test_a_picture_that_opens_with_the_cone(llvm):
    assert_gain(scene_of(spot(8.0, texture=picture(6, 6))), "light.cutoff_angle", {"direction": 1.0})


@slow
@pytest.mark.parametrize("param, how", [("light.to_world", MOVED), ("card.to_world", {"direction": (0.5, 0.2, 1)})])
def test_two_receivers_one_before_the_other(llvm, param, how):
    assert_gain(scene_of(projector(picture()), card=card()), param, how)


@slow
def test_a_rough_conductor(llvm):
    assert_gain(scene_of(projector(picture()), {"type": "roughconductor", "alpha": 0.4}), "light.to_world", MOVED)


@slow
@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("param, how", [
    ("light.to_world", MOVED), ("floor.to_world", RAISED),
    ("card.to_world", {"direction": (0.2, 0.3, 1)}), ("camera.to_world", {"rotate": (0.3, 0, 1)}),
])  # fmt: skip
def test_seen_over_a_further_bounce(llvm, param, how, form):
    scene = scene_of(projector(picture()), wall=wall(), **({"card": card()} if param.startswith("card") else {}))
    assert_gain(scene, param, how, max_depth=3, form=form)


@slow
def test_a_lamp_in_the_surface_it_hangs_from(llvm):
    ceiling = {"type": "rectangle", "bsdf": {"type": "twosided", "of": {"type": "diffuse"}},
               "to_world": mi.ScalarTransform4f().translate([0, 0, 2.5]).scale(0.5)}  # fmt: skip
    light = spot(to_world=pose((0.3, -0.3, 2.5), (0, 0, 0)))
    assert_gain(scene_of(light, ceiling=ceiling), "floor.to_world", RAISED)


@slow
def test_a_stretched_picture_on_a_ball(llvm):
    ball = {"type": "sphere", "center": [0, 0, 0.4], "radius": 0.4, "bsdf": {"type": "diffuse"}}
    light = {**projector(), "fov": 15.0, "to_world": pose() @ mi.ScalarTransform4f().scale([1, 1.5, 1])}
    assert_gain(scene_of(light, ball=ball), "ball.to_world", {"direction": (0.4, 0.3, 0.5)})


def box() -> dict:
    """Closed, in the beam: which of its edges are outlines depends on where the light is."""
    place = mi.ScalarTransform4f().translate([0.1, 0, 0.5]).rotate([0.2, 1, 0.1], 30).scale(0.25)
    return {"type": "cube", "to_world": place}


def test_a_projector_sees_the_outlines_that_a_lamp_in_its_place_sees(llvm):
    """Mitsuba's projectors have no bounding box."""
    place = [float(x) for x in pose().translation()]
    lights = {"its frame": projector(), "": {"type": "point", "position": place}}
    sampled = {}
    for step, light in lights.items():
        plan = psdr_jit.make_plan(scene_of(light, box=box()), ["box.vertex_positions"], integrator={
            "type": "psdr_path", "max_depth": 2, "form": "spatial", "sppc": 1, "sppp": 1, "sppd": 1,
        })  # fmt: skip
        sampled[step] = plan.term("direct").edges
    with_frame, without = sampled["its frame"], sampled[""]
    assert with_frame.sampled - without.sampled == with_frame.total - without.total > 0
    assert 0 < without.sampled < without.total


@slow
@pytest.mark.parametrize("param, how", [("light.to_world", MOVED), ("box.vertex_positions", {"direction": (1, 0, 0)})])
def test_the_shadow_of_a_box(llvm, param, how):
    assert_gain(scene_of(projector(picture()), box=box()), param, how)


@slow
def test_two_lights(llvm):
    other = spot(intensity=8.0, to_world=pose((-1, 0.5, 2), (0, 0, 0)))
    assert_gain(scene_of(projector(picture()), other=other), "floor.to_world", {"direction": (0.4, 0.3, 1)})


@slow
@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("light, param", [
    (lambda: projector(picture()), "light.to_world"),
    (spot, "floor.to_world"),
    (spot, "light.cutoff_angle"),
])  # fmt: skip
def test_forward_and_backward_mode_are_transposes(llvm, light, param, form):
    scene = scene_of(light(), wall=wall(), card=card())
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3, "form": form})
    wJv, JTwv, w, Jv = adjoint_identity(scene, param, integrator)
    assert Jv > 0 and abs(wJv - JTwv) <= 1e-5 * w * Jv


def test_everything_and_the_camera_moved_together(llvm):
    """Nothing changes: what is left is noise, far below what the light alone does."""
    scene = scene_of(spot())
    spec = {"type": "psdr_path", "max_depth": 2, "sppp": 0}
    alone = {name: forward(perturb(scene, name, (1, 0, 0)), spec, 2, 256).mean(0)
             for name in ("light.to_world", "floor.to_world", "camera.to_world")}  # fmt: skip
    assert np.abs(sum(alone.values()).sum()) < 0.02 * np.abs(alone["light.to_world"]).sum()


def test_the_plan_counts_steps_of_lights(llvm):
    """A lone plane casts no shadow, but what is thrown on it moves."""
    plan = psdr_jit.make_plan(scene_of(spot()), "floor.to_world", integrator={"type": "psdr_path", "max_depth": 2})
    direct = plan.term("direct")
    assert direct.runs and direct.edges.sampled > 0 and "lights" in direct.reason
    soft = psdr_jit.make_plan(scene_of(spot(8.0)), "floor.to_world", integrator={"type": "psdr_path", "max_depth": 2})
    assert not soft.term("direct").runs


def test_later_calls_compile_nothing(llvm):
    scene = scene_of(projector(picture(20, 30)), card=card())
    motion = perturb(scene, "light.to_world", **MOVED)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2})
    compiled = kernels_compiled(motion, integrator)
    assert compiled[0] > 0 and not any(compiled[4:]), compiled
