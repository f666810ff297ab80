"""Shadows, reflections and patterns that are seen in a mirror: it shows what a mirrored copy of the room would.

The copy is seen directly, by a path that is one segment shorter, where other boundary terms are at work.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close
from test_patterns import checkerboard, texels
from test_specular_chain import SEEDS, along, camera, moved_images, rest, turned

from psdr_jit.derivative import integrator_specs

slow = pytest.mark.slow
GREY = {"type": "diffuse", "reflectance": 0.6}
EYE, TARGET, FOV = [2.0, 0.9, 3.0], [0, 0.3, 0], 24

LAMPS = {
    "point": {"type": "point", "position": [-2.6, 1.8, 2.0], "intensity": 9.0},
    "area": {"type": "sphere", "center": [-2.6, 1.8, 2.0], "radius": 0.2,
             "emitter": {"type": "area", "radiance": 30.0}},
    # No corner of the shadow is close to the border of a pixel, where lifted rays (3e-4 of a pixel) already tell.
    "distant": {"type": "directional", "direction": [0.5, -1, 0.25], "irradiance": 2.0},
}  # fmt: skip


def poses() -> dict[str, mi.ScalarTransform4f]:
    """Of what stands in front of the mirror z = 0, out of sight but for its image."""
    T = mi.ScalarTransform4f()
    return {
        "floor": T.translate([-1.6, -0.5, 2.3]).rotate([1, 0, 0], -90).scale([2, 1.4, 1]),
        "sheet": T.translate([-1.7, 0.05, 2.2]).rotate([1, 0.3, 0.2], -75).scale([0.45, 0.35, 1]),
    }


def room(lamp: str, texture: dict | None) -> tuple[mi.Scene, mi.Scene]:
    """`(in the mirror, its copy)`."""
    floor = {"type": "diffuse", "reflectance": texture} if texture else GREY
    things = {"floor": floor, "sheet": GREY}
    mirror = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": {"type": "conductor"}}
    flip = mi.ScalarTransform4f().scale([1, 1, -1])
    scenes = []
    for copied in (False, True):
        description = {"type": "scene", "camera": camera(EYE, TARGET, FOV)}
        for name, pose in poses().items():
            bsdf = {"type": "twosided", "bsdf": things[name]}
            description[name] = {"type": "rectangle", "to_world": flip @ pose if copied else pose, "bsdf": bsdf}
        description["lamp"] = reflected(LAMPS[lamp]) if copied else LAMPS[lamp]
        if not copied:
            description["mirror"] = mirror
        scenes.append(mi.load_dict(description, optimize=False))
    return scenes[0], scenes[1]


def reflected(lamp: dict) -> dict:
    return {key: [*value[:2], -value[2]] if key in ("position", "center", "direction") else value
            for key, value in lamp.items()}  # fmt: skip


MOTIONS = {  # of floor, sheet, lamp (at a point), mirror and camera
    "sheet": {"sheet": along},
    "floor": {"floor": along},
    "mirror": {"mirror": turned},
    "camera": {"camera": along},
    "lamp": {"lamp": along},
}


def images(
    case: str, lamp: str, texture: dict | None, depth: int, spp: int, seeds: int = SEEDS
) -> tuple[np.ndarray, np.ndarray]:
    """Derivative images `(in the mirror, of the copy)` by seeds."""
    seen, copy = room(lamp, texture)
    motion, flip = MOTIONS[case], mi.Transform4f().scale([1, 1, -1])
    of_mirror = motion.get("mirror", rest)
    in_mirror, in_copy = {}, {}
    eye = mi.Transform4f(mi.traverse(seen)["camera.to_world"])
    for name, pose in poses().items():
        at, moved = mi.Transform4f(pose), motion.get(name, rest)
        in_mirror[f"{name}.to_world"] = lambda θ, at=at, moved=moved: moved(θ) @ at
        in_copy[f"{name}.to_world"] = lambda θ, at=at, moved=moved: (
            of_mirror(θ) @ flip @ of_mirror(θ).inverse() @ moved(θ) @ at
        )
    in_mirror["mirror.to_world"] = lambda θ: of_mirror(θ) @ mi.Transform4f().scale(3)
    if lamp == "point":
        at, moved = mi.Point3f(LAMPS[lamp]["position"]), motion.get("lamp", rest)
        in_mirror["lamp.position"] = lambda θ: moved(θ) @ at
        in_copy["lamp.position"] = lambda θ: of_mirror(θ) @ flip @ of_mirror(θ).inverse() @ moved(θ) @ at
    for named in (in_mirror, in_copy):
        named["camera.to_world"] = lambda θ: motion.get("camera", rest)(θ) @ eye
    spec = {"type": "psdr_path", "rr_depth": 1000, "form": "spatial"}
    shown = moved_images(seen, in_mirror, {**spec, "max_depth": depth + 1}, spp, seeds)
    return shown, moved_images(copy, in_copy, {**spec, "max_depth": depth}, spp, seeds)


def test_the_shadow_of_a_sheet_in_a_mirror(llvm):
    """The quick one."""
    assert_grad_close(*images("sheet", "point", None, 2, 32, 6), max_stderr=0.05)


@slow
@pytest.mark.parametrize("case", ["sheet", "mirror", "camera", "lamp"])
def test_a_shadow_in_a_mirror(llvm, case):
    assert_grad_close(*images(case, "point", None, 2, 64))


@pytest.mark.slow
def test_a_pattern_and_a_shadow_in_a_mirror_that_turns(llvm):
    assert_grad_close(*images("mirror", "point", checkerboard(), 2, 32, 6), max_stderr=0.05)


@slow
@pytest.mark.parametrize("case", ["mirror", "floor", "camera"])
@pytest.mark.parametrize("texture", [checkerboard, texels])
def test_a_pattern_in_a_mirror(llvm, case, texture):
    assert_grad_close(*images(case, "point", texture(), 2, 64))


@slow
@pytest.mark.parametrize("case", ["sheet", "camera"])
@pytest.mark.parametrize("lamp", ["area", "distant"])
def test_shadows_of_other_lights_in_a_mirror(llvm, lamp, case):
    assert_grad_close(*images(case, lamp, None, 2, 512))


@slow
@pytest.mark.parametrize("case", ["sheet", "mirror", "camera"])
def test_what_surfaces_in_a_mirror_see_of_each_other(llvm, case):
    assert_grad_close(*images(case, "point", checkerboard(), 3, 2048))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sheet.to_world", pytest.param("lamp.position", marks=slow)])
def test_backward_mode_is_the_adjoint(llvm, name):
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4, "sppc": 0, "sppp": 0, "spps": 32})
    forwards, backwards, w, jv = adjoint_identity(room("point", checkerboard())[0], name, integrator, spp=32)
    assert jv > 0
    assert abs(forwards - backwards) < 1e-5 * w * jv
