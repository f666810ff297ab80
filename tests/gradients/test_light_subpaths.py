"""`psdr_bdpt`: paths that are found from the light. The image is that of `path`, and so is its derivative.

`light_paths="only"` leaves to light subpaths all that they find: then nothing else can make up for what they get wrong.
"""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import (
    adjoint_identity,
    assert_grad_close,
    assert_image_of_path,
    fd,
    forward,
    kernels_compiled,
    load,
)
from problems import Problem

from psdr_jit import make_plan
from psdr_jit.cli.main import main
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.plan.plan import Plan
from psdr_jit.scene import io as scene_io

X, Y = (1, 0, 0), (0, 1, 0)
LIMITS = {"max_depth": 5, "rr_depth": 1000}
GLASS = Problem("rough_glass", "lamp.to_world", 0.01, direction=X)
SEEDS = 16
SLOW = pytest.mark.slow
Z_LIMIT = 5.0
TOLERANCE = 1e-5  # of the adjoint identity


QUICK = {"form": "spatial", "sppc": 4, "sppp": 0, "sppi": 0}  # no pilot, the interior term alone


def bdpt(light_paths: str = "auto", **options) -> dict:
    return {"type": "psdr_bdpt", "light_paths": light_paths, **LIMITS, **options}


@pytest.mark.parametrize("options", [
    pytest.param(dict(), marks=pytest.mark.slow),
    pytest.param(dict(light_paths="only"), marks=pytest.mark.slow),
    dict(light_paths="only", hide_emitters=True, max_depth=-1, rr_depth=3),
], ids=["auto", "only", "only-roulette-hidden"])  # fmt: skip
def test_image(variant, options):
    assert_image_of_path(load(GLASS, res=16), bdpt(**options), 128, SEEDS, Z_LIMIT)


@pytest.mark.slow
def test_image_with_a_smooth_filter(variant):
    assert_image_of_path(load(GLASS, res=16, rfilter="gaussian"), bdpt("only"), 128, SEEDS, Z_LIMIT)


SENSORS = {
    "thinlens": {"fov": 40, "aperture_radius": 0.15, "focus_distance": 3.5},
    "orthographic": {},
}


def glass_scene(
    alpha: float = 0.2, sensor: str = "perspective", light: str = "spot", glass: str = "ball", rfilter: str = "box"
) -> mi.Scene:
    """Rough glass, or a rough mirror, between a floor and a small light."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": rfilter}, "pixel_format": "luminance"}
    pose = T().look_at(origin=[0.5, 2.2, 3.2], target=[0, -0.7, 0], up=[0, 1, 0])
    if sensor == "orthographic":
        pose = pose @ T().scale([1.3, 1.3, 1])
    camera = {"type": sensor, "to_world": pose, "film": film, **SENSORS.get(sensor, {"fov": 40})}
    rough = {"type": "roughdielectric", "alpha": alpha}
    down = T().look_at(origin=[1.2, 1.8, -0.8], target=[0, -0.4, 0], up=[1, 0, 0])
    lights = {
        "spot": {"type": "spot", "intensity": 6.0, "cutoff_angle": 30, "beam_width": 10, "to_world": down},
        "point": {"type": "point", "intensity": 6.0, "position": [1.2, 1.8, -0.8]},
        "area": {"type": "rectangle", "to_world": down @ T().scale(0.3), "emitter": {"type": "area", "radiance": 20.0}},
        "bulb": {"type": "sphere", "center": [1.2, 1.8, -0.8], "radius": 0.2,
                 "emitter": {"type": "area", "radiance": 20.0}},
    }  # fmt: skip
    mirror = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": alpha}}
    bodies = {
        "ball": {"type": "sphere", "center": [0, -0.2, 0], "radius": 0.6, "bsdf": rough},
        "slab": {"type": "cube", "to_world": T().translate([0, -0.2, 0]).scale([0.9, 0.15, 0.9]), "bsdf": rough},
        "mirror": {"type": "rectangle", "to_world": T().translate([-1, -0.3, 0]).rotate([0, 1, 0], 70).scale(0.7),
                   "bsdf": mirror},
        "smooth": {"type": "sphere", "center": [0, -0.2, 0], "radius": 0.6, "bsdf": {"type": "dielectric"}},
    }  # fmt: skip
    floor = T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(8)
    return mi.load_dict({
        "type": "scene", "camera": camera, "body": bodies[glass], "lamp": lights[light],
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": {"type": "diffuse"}},
    }, optimize=False)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("scene", [
    dict(sensor="thinlens"), dict(sensor="orthographic"), dict(light="area"), dict(light="bulb"), dict(light="point"),
    dict(glass="slab"), dict(glass="mirror"), dict(alpha=0.1),
], ids=lambda scene: "-".join(map(str, scene.values())))  # fmt: skip
def test_image_of(llvm, scene):
    assert_image_of_path(glass_scene(**scene), bdpt("only"), 512, SEEDS, Z_LIMIT)


@pytest.mark.parametrize("name", [
    "spot_light", pytest.param("glossy_floor", marks=SLOW), pytest.param("cbox", marks=SLOW),
    pytest.param("point_shadow", marks=SLOW),
])
def test_without_caustics_nothing_changes(llvm, name):
    """The image and the derivative are those of the same kernels."""
    scene = load(Problem(name, "", 0.0), res=16)
    limits = {"max_depth": 3}
    path, ours = (np.array(mi.render(scene, integrator=mi.load_dict({"type": t, **limits}), spp=4, seed=5))
                  for t in ("path", "psdr_bdpt"))  # fmt: skip
    assert np.allclose(path, ours, rtol=1e-5, atol=1e-6)  # threads add to the film in any order
    name = next(key for key in mi.traverse(scene).keys() if key.endswith(("reflectance.value", "to_world")))
    motion = perturb(scene, name, X) if name.endswith("to_world") else perturb(scene, name)
    a, b = (forward(motion, {"type": t, **limits}, 2, 4) for t in ("psdr_path", "psdr_bdpt"))
    assert np.allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(a).max())


@pytest.mark.slow
@pytest.mark.parametrize("light_paths", ["auto", "only"])
def test_spot_moved(variant, light_paths):
    scene = load(GLASS, res=16)
    motion = perturb(scene, "lamp.to_world", X)
    estimate = forward(motion, bdpt(light_paths, form="spatial"), SEEDS, 64)
    assert_grad_close(estimate, fd(motion, {"type": "path", **LIMITS}, GLASS.eps, SEEDS, 1024))


@pytest.mark.slow
@pytest.mark.parametrize("param, how, options", [
    ("body.bsdf.eta", {}, dict()),
    ("body.bsdf.alpha.value", {}, dict(light_paths="only")),
    ("body.to_world", dict(direction=X), dict(light_paths="only")),
    ("lamp.to_world", dict(direction=X), dict(light_paths="only")),
    ("floor.to_world", dict(direction=Y), dict(form="material")),  # spatial: its boundary has the caustic's noise
    ("camera.to_world", dict(direction=X), dict(light_paths="only")),
], ids=lambda value: value.removesuffix(".to_world") if isinstance(value, str) else "")  # fmt: skip
def test_derivative_by(llvm, param, how, options):
    motion = perturb(glass_scene(alpha=0.4), param, **how)
    estimate = forward(motion, bdpt(**options), SEEDS, 512)
    assert_grad_close(estimate, fd(motion, {"type": "path", **LIMITS}, 0.006, 32, 4096), max_stderr=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["spatial", pytest.param("material", marks=SLOW)])
def test_same_flow_however_found(llvm, form):
    """The interior term alone, where every vertex slides: what the light finds against what the camera finds.

    The camera's paths through a ball start inside of it, off its surface; those that are turned around must, too.
    """
    scene = glass_scene(alpha=0.5)
    motion = perturb(scene, "camera.to_world", X)
    budgets = dict(max_depth=4, form=form, sppc=1, sppp=0, sppi=0)
    spp = {"spatial": 2048, "material": 1024}[form]  # at outlines the spatial form has far outliers
    by_camera, by_light = (forward(motion, bdpt(how, **budgets), SEEDS, spp) for how in ("off", "only"))
    assert_grad_close(by_light, by_camera, max_stderr=0.06)


def assert_transposes(scene: mi.Scene, param: str, form: str) -> None:
    integrator = integrator_specs.build(bdpt(form=form))
    wJv, JTwv, w, Jv = adjoint_identity(scene, param, integrator)
    assert integrator.plan.form == form and Jv > 1e-6
    assert abs(wJv - JTwv) <= TOLERANCE * w * Jv, f"forward {wJv:.8g}, backward {JTwv:.8g}, bound on {w * Jv:.3g}"


@pytest.mark.parametrize("param", [
    pytest.param("lamp.to_world", marks=SLOW), "ball.bsdf.eta", pytest.param("ball.to_world", marks=SLOW),
    pytest.param("camera.to_world", marks=SLOW),
])  # fmt: skip
def test_forward_and_backward_are_transposes(variant, param):
    for form in ("spatial",) if param.endswith("eta") else ("spatial", "material"):
        assert_transposes(load(GLASS, res=16), param, form)


@pytest.mark.parametrize("param, form", [
    ("body.to_world", "film"), pytest.param("camera.to_world", "film-material", marks=SLOW)
])  # fmt: skip
def test_both_modes_know_where_places_on_the_film_go(llvm, param, form):
    assert_transposes(glass_scene(rfilter="gaussian"), param, form)


@pytest.mark.parametrize("param", ["camera.to_world", pytest.param("body.to_world", marks=SLOW)])
def test_what_the_light_finds_moves_over_the_film(llvm, param):
    """Where places on the film follow, by light subpaths alone; without splats that move the gain would be .28, .67."""
    motion = perturb(glass_scene(alpha=0.5, light="area", rfilter="gaussian"), param, X)
    budgets = {"max_depth": 4, "sppc": 1, "sppp": 1, "sppi": 1}
    film, rests = (
        forward(motion, bdpt(how, form=form, **budgets), SEEDS, 96)
        for how, form in (("only", "film"), ("off", "spatial"))
    )
    assert_grad_close(film, rests, max_stderr=0.05)


@pytest.mark.slow
def test_several_passes_are_transposes_too(llvm):
    integrator = integrator_specs.build(bdpt(record_mib=16, **QUICK))
    wJv, JTwv, w, Jv = adjoint_identity(load(GLASS, res=64), "lamp.to_world", integrator)
    assert Jv > 1e-6 and abs(wJv - JTwv) <= TOLERANCE * w * Jv


def test_later_calls_compile_nothing(llvm):
    motion = perturb(load(GLASS, res=16), "lamp.to_world", X)
    compiled = kernels_compiled(motion, integrator_specs.build(bdpt(sppc=8, sppd=0)), calls=6, spp=0)
    assert compiled[0] > 0 and sum(compiled[3:]) == 0


@pytest.mark.slow
def test_nearly_smooth_glass_is_finite(llvm):
    scene = glass_scene(alpha=0.01)
    integrator = integrator_specs.build(bdpt(sppc=64, sppp=0, sppi=0))
    motion = perturb(scene, "body.to_world", X)
    motion.attach()
    image = np.array(dr.detach(integrator.render_forward(scene, motion.params, spp=64)))
    assert np.isfinite(image).all() and int(integrator.stats["rejected"]) == 0


def test_the_plan_says_why(llvm):
    lit = load(GLASS, res=16)
    plan = make_plan(lit, "lamp.to_world", integrator=bdpt(**QUICK))
    assert plan.light.runs and "'ball' may focus light" in str(plan)
    assert Plan.from_json(plan.to_json()) == plan
    assert make_plan(lit, "lamp.to_world", integrator={"type": "psdr_path", **QUICK}).light is None
    for scene, options, reason in (
        (load(Problem("point_shadow", "", 0.0)), {}, "nothing is focused"),
        (load(Problem("rough_dielectric", "", 0.0)), {}, "nothing to aim at"),
        (load(Problem("glossy_floor", "", 0.0)), {}, "nothing to aim at"),
        (lit, {"max_depth": 2}, "max_depth = 2"),
    ):
        name = next(key for key in mi.traverse(scene).keys() if key.endswith("to_world"))
        plan = make_plan(scene, name, integrator={**bdpt(**QUICK), **options})
        assert not plan.light.runs and reason in plan.light.reason and "none: " in str(plan)


def test_a_given_plan_is_executed(llvm):
    """Light subpaths included."""
    scene = load(GLASS, res=16)
    motion = perturb(scene, "lamp.to_world", X)
    plan = make_plan(scene, "lamp.to_world", integrator=bdpt(form="spatial", sppc=8, sppd=0))
    own, given = (forward(motion, spec, 2, 0) for spec in (
        bdpt(form="spatial", sppc=8, sppd=0), bdpt(plan=plan.to_json())))  # fmt: skip
    assert np.allclose(own, given, rtol=1e-3, atol=1e-4 * np.abs(own).max())


def test_points_behind_smooth_glass_are_warned_about(llvm):
    match = r"light of 'lamp' \(spot\) that 'body' \(sphere\) mirrors or bends onto other surfaces is in the image, but"
    with pytest.warns(UnsupportedWarning, match=match):
        make_plan(glass_scene(glass="smooth"), "lamp.to_world", integrator=bdpt(**QUICK))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_plan(glass_scene(glass="smooth"), "lamp.to_world", integrator={"type": "psdr_path", **QUICK})


def test_a_frozen_function_renders(llvm, nothing_collected):
    """Nothing can be read there: the image is that of `path`."""
    scene = load(GLASS, res=16)
    path, ours = (mi.load_dict({"type": t, "max_depth": 4}) for t in ("path", "psdr_bdpt"))

    @dr.freeze
    def frozen(seed: mi.UInt32) -> mi.TensorXf:
        return mi.render(scene, integrator=ours, spp=4, seed=seed)

    for seed in range(2):
        image = mi.render(scene, integrator=path, spp=4, seed=mi.UInt32(seed))
        assert np.allclose(frozen(mi.UInt32(seed)), image)


def test_the_command_line_knows_it(llvm, tmp_path, capsys):
    """By name, or because a scene file asks for it."""
    shipped = scene_io.shipped_scene("rough_glass.xml")
    own = tmp_path / "own.xml"
    own.write_text(shipped.read_text(encoding="utf-8").replace('type="path"', 'type="psdr_bdpt"'), encoding="utf-8")
    wanted = ["--wrt", "ball.bsdf.eta", "-D", "res=16"]
    for argv in (["plan", str(shipped), "--integrator", "psdr_bdpt", *wanted], ["plan", str(own), *wanted]):
        assert main(argv) == 0
        assert "'ball' may focus light" in capsys.readouterr().out
    assert main(["plan", str(shipped), *wanted]) == 0
    assert "light" not in capsys.readouterr().out.split("term ")[0]


def test_words(llvm):
    with pytest.raises(RuntimeError, match="light_paths = 'maybe': use off, auto or only"):
        mi.load_dict({"type": "psdr_bdpt", "light_paths": "maybe"})
    with pytest.raises(RuntimeError, match="light_paths"):
        mi.load_dict({"type": "psdr_path", "light_paths": "auto"})
    text = '<scene version="3.0.0"><integrator type="psdr_bdpt"><integer name="sppc" value="7"/></integrator></scene>'
    options = mi.load_string(text).integrator().options
    assert options.sppc == 7 and options.light_paths == "auto"
