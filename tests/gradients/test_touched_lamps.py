"""Area lights that touch what they shine on: emission is followed along directions (`edges/followed_lights.py`)."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, fd, forward

import psdr_jit
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.statistics import Gain, gain
from psdr_jit.errors import UnsupportedWarning

SEEDS, SPP, REFERENCE_SPP, EPS = 16, 512, 2048, 4e-3
LARGEST_ERROR = 0.02  # of a gain: followed on their material, lights in these scenes give 0.7 to 0.9
X, Y = (1, 0, 0), (0, 1, 0)


def room(lamp: dict, **others: dict) -> mi.Scene:
    """A floor, and a lamp in it or on it."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    look = T().look_at(origin=[3, 2.5, 2.4], target=[0, 0.3, 0], up=[0, 1, 0])
    return mi.load_dict({
        "type": "scene", "camera": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(3),
                  "bsdf": {"type": "diffuse", "reflectance": 0.7}},
        "lamp": lamp, **others,
    }, optimize=False)  # fmt: skip


def cube(x: float, y: float, z: float, side: float, **more: dict) -> dict:
    to_world = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], 30).scale(side / 2)
    return {"type": "cube", "to_world": to_world, **more}


def glow(radiance: float | dict = 2.0) -> dict:
    return {"type": "area", "radiance": radiance}


def sunk(**others: dict) -> mi.Scene:
    return room(cube(0, 0.3, 0, 1, emitter=glow()), **others)


def block(x: float) -> dict:
    return cube(x, 0.25, 0.3, 0.5, bsdf={"type": "diffuse", "reflectance": 0.6})


def mirror() -> dict:
    T = mi.ScalarTransform4f
    to_world = T().translate([-1, 0.5, -1]).rotate([0, 1, 0], 40).scale(0.9)
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "twosided", "of": {"type": "conductor"}}}


def picture() -> mi.Scene:
    """A painted light that stands on the floor."""
    to_world = mi.ScalarTransform4f().translate([-0.6, 0.5, 0]).rotate([0, 1, 0], 70).scale(0.5)
    black = {"type": "twosided", "of": {"type": "diffuse"}}
    checks = {"type": "checkerboard", "color0": 0.5, "color1": 3.0, "to_uv": mi.ScalarTransform4f().scale(3)}
    return room({"type": "rectangle", "to_world": to_world, "bsdf": black, "emitter": glow(checks)})


def ball() -> mi.Scene:
    return room({"type": "sphere", "center": [0, 0.2, 0], "radius": 0.5, "emitter": glow()})


CASES = {  # scene, parameter, direction, depth
    "camera": (sunk, "camera.to_world", X, 2),
    "lamp-slides": (sunk, "lamp.vertex_positions", X, 3),
    "lamp-rises": (sunk, "lamp.vertex_positions", Y, 2),
    "ball-rises": (ball, "lamp.to_world", Y, 2),
    "shadow": (lambda: sunk(block=block(0.9)), "block.vertex_positions", X, 3),
    "block-in-lamp": (lambda: sunk(block=block(0.6)), "block.vertex_positions", X, 3),
    "painted": (picture, "camera.to_world", X, 3),
    "in-a-mirror": (lambda: sunk(mirror=mirror()), "lamp.vertex_positions", X, 3),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_against_finite_differences(mono, case):
    make, param, direction, depth = CASES[case]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedWarning)
        motion = perturb(make(), param, direction)
        spec = {"type": "psdr_path", "max_depth": depth, "rr_depth": 99}
        ours = forward(motion, spec, SEEDS, SPP)
    reference = fd(motion, spec, EPS, 2 * SEEDS, REFERENCE_SPP)
    found = gain(ours, reference[0::2], reference[1::2])
    assert found.stderr < LARGEST_ERROR
    assert abs(found.value - 1) < max(LARGEST_ERROR, 3 * found.stderr)


@pytest.mark.parametrize("case", ["lamp-slides", pytest.param("in-a-mirror", marks=pytest.mark.slow)])
def test_backward_is_the_transpose(mono, case):
    make, param, _, depth = CASES[case]
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": depth})
    forward_dot, backward_dot, w, Jv = adjoint_identity(make(), param, integrator)
    assert abs(forward_dot - backward_dot) < 1e-4 * w * Jv


def test_the_plan_says_so_and_material_form_warns(mono):
    scene = sunk()
    spec = {"type": "psdr_path", "max_depth": 2, "sppc": 1, "sppp": 1, "sppd": 1, "sppi": 1}  # as set: no pilot
    plan = psdr_jit.make_plan(scene, ["lamp.vertex_positions"], integrator=spec)
    assert plan.form == "spatial" and plan.term("indirect").runs and "'lamp'" in plan.term("indirect").reason
    apart = room(cube(0, 0.7, 0, 1, emitter=glow()))
    plan = psdr_jit.make_plan(apart, ["lamp.vertex_positions"], integrator=spec)
    assert not plan.term("indirect").runs
    motion = perturb(scene, "lamp.vertex_positions", X)
    with pytest.warns(UnsupportedWarning, match="'lamp' touches 'floor'"):
        image = forward(motion, {"type": "psdr_path", "max_depth": 2, "form": "material"}, 1, 4)
    assert np.isfinite(image).all()


def test_a_lamp_in_a_window_is_named(mono):
    """What is seen of it behind the window, while what is above is seen beside, is not whole."""
    bright = {"sky": {"type": "constant", "radiance": 0.7}}
    for floor, named in (({"type": "thindielectric"}, True), ({"type": "diffuse"}, False)):
        scene = sunk(**bright, floor={
            "type": "rectangle", "bsdf": floor,
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(3),
        })  # fmt: skip
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            psdr_jit.make_plan(scene, ["camera.to_world"], integrator={"type": "psdr_path", "max_depth": 2})
        assert any("cuts into 'floor', behind which it is seen" in str(w.message) for w in said) == named


@pytest.mark.parametrize("sunk_by, hidden", [(0, True), (0, False), (0.1, True)])
def test_a_hidden_lamp_on_a_floor_is_named(mono, sunk_by, hidden):
    """The floor is seen beside it and beneath it, where nothing lights it. Of one in the floor this is right."""
    spec = {"type": "psdr_path", "max_depth": 2, "hide_emitters": hidden}
    scene = room(cube(0, 0.4 - sunk_by, 0, 0.8, emitter=glow()))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        psdr_jit.make_plan(scene, ["camera.to_world"], integrator=spec)
    named = any("which hide_emitters makes transparent, stands on 'floor'" in str(w.message) for w in said)
    assert named == (hidden and sunk_by == 0)


def slope_behind_lamps(motion: Perturbation, eps: float, seeds: int) -> Gain:
    """Of what the camera sees through lights that are hidden from it."""
    spec = {"type": "psdr_path", "max_depth": 2, "form": "spatial", "hide_emitters": True}
    differences = fd(motion, spec, eps, seeds, 1024)
    return gain(forward(motion, spec, 16, 256), differences[0::2], differences[1::2])


@pytest.mark.slow
@pytest.mark.parametrize("plugin, tilt", [("cube", 0), ("cube", 35), ("cylinder", 30), ("cylinder", 65)])
def test_a_hidden_lamp_in_a_floor(mono, plugin, tilt):
    """The floor steps where it gets inside: of cubes 30 and 72 % were missing where rays passed that by."""
    to_world = mi.ScalarTransform4f().translate([0.1, 0.1, 0]).rotate([0.28, 0, 0.96], tilt).scale(0.4)
    sky = {"type": "constant", "radiance": 0.3}
    scene = room({"type": plugin, "to_world": to_world, "emitter": glow()}, sky=sky)
    motion = perturb(scene, "camera.to_world", (1, 0.2, 0.3))
    slope = slope_behind_lamps(motion, 0.004, 256)
    assert slope.stderr < 0.02
    assert abs(slope.value - 1) < 3 * slope.stderr + 0.01, slope


@pytest.mark.slow
def test_a_hidden_ball_in_a_floor_is_named_and_roughly_right(mono):
    """The light on the floor changes with the root of the distance. 0.4 and 0.8 of the derivative were found."""
    for y in (0, -0.1):
        at = mi.ScalarTransform4f().translate([0.1, y, 0]).scale(0.4)
        motion = perturb(room({"type": "sphere", "to_world": at, "emitter": glow()}), "camera.to_world", (1, 0.2, 0.3))
        with pytest.warns(UnsupportedWarning, match="sphere 'lamp' .* cuts into 'floor'"):
            slope = slope_behind_lamps(motion, 0.002, 128)
        assert slope.stderr < 0.05 and 0.85 < slope.value < 1.05, (y, slope)


@pytest.mark.slow
def test_a_hidden_cylinder_that_cuts_into_a_box(mono):
    """Of the curve in which they meet, the part where it overhangs was missing: blocks were 17 % off."""
    T = mi.ScalarTransform4f
    at = T().translate([-0.05, 0.73, 0.39]).rotate([-0.021, -0.258, -0.966], 75).scale(0.33)
    lamp = {"type": "cylinder", "to_world": at, "emitter": glow(1.6)}
    at = T().translate([-0.56, 0.23, 0.19]).rotate([-0.944, 0.238, 0.229], 52).scale(0.58)
    box = {"type": "cube", "to_world": at}
    scene = room(lamp, box=box, sky={"type": "constant", "radiance": 0.9})
    motion = perturb(scene, "lamp.to_world", (-0.763, 0.495, -0.416))
    slope = slope_behind_lamps(motion, 0.002, 128)
    assert slope.stderr < 0.02
    assert abs(slope.value - 1) < 3 * slope.stderr + 0.01, slope


def test_a_point_light_on_a_surface(llvm):
    """It casts shadows like one that hangs a little below: Mitsuba's shadow rays end before what it lies on."""
    images = []
    for gap in (0.0, 0.02):
        above = mi.ScalarTransform4f().translate([0.3, 2, 0.4]).rotate([1, 0, 0], 90)
        ceiling = {"type": "rectangle", "to_world": above}
        bulb = {"type": "point", "position": [0.3, 2 - gap, 0.4], "intensity": 5.0}
        scene = room(ceiling | {"bsdf": {"type": "diffuse", "reflectance": 0}}, block=block(0.2), bulb=bulb)
        motion = perturb(scene, "camera.to_world", direction=(1, 0.3, 0.2))
        images.append(forward(motion, {"type": "psdr_path", "max_depth": 2, "sppc": 0, "sppp": 0}, 4, 256).mean(0))
    assert np.linalg.norm(images[0] - images[1]) < 0.1 * np.linalg.norm(images[1])
