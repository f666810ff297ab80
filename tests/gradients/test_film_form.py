"""The film form: places on the film follow what is seen there. The same derivative as that of the spatial form."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, fd, forward, load, spec_of
from problems import Problem
from variants import also

import psdr_jit
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.driver.prepare import prepare
from psdr_jit.errors import OptionError
from psdr_jit.interior import film_borders, film_places

RES, SPP, SEEDS, STEP = 16, 64, 24, 0.01
TEXELS = 48  # a side, of the fine picture
UP = [0, 1, 0]
FILM, FILM_MATERIAL, SPATIAL = {"form": "film"}, {"form": "film-material"}, {"form": "spatial"}

CASES = {  # scene, parameter, motion
    "moved": ("lit_box", "camera.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "turned": ("cbox", "sensor.to_world", {"rotate": (0.48, 0.6, 0.64)}),
    "view": ("lit_box", "camera.x_fov", {}),
    "thin-lens": ("thinlens_shadow", "camera.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "parallel": ("camera_orthographic", "camera.to_world", {"rotate": (0.48, 0.6, 0.64)}),
    "crop": ("camera_crop", "camera.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "sky": ("envmap_rotation", "camera.to_world", {"rotate": (0.48, 0.6, 0.64)}),
    "smooth": ("smooth_mesh", "camera.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "box": ("lit_box", "box.vertex_positions", {"direction": (0.3, 0.2, 0.1)}),  # before a camera at rest
    "ball": ("ball_shadow", "blocker.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "light": ("disk_rim", "disk.to_world", {"rotate": (0.48, 0.6, 0.64)}),  # that is seen alone: else nothing changes
    "mirrored": ("mirrors", "blocker.vertex_positions", {"direction": (0.3, 0.2, 0.1)}),  # and seen there
    "mirror": ("mirrors", "mirror.to_world", {"rotate": (0.48, 0.6, 0.64)}),
    "glass": ("glass", "body.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "glass-view": ("glass", "camera.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "window": ("window", "pane.to_world", {"rotate": (0.48, 0.6, 0.64)}),
    "mask": ("mask_shadow", "sheet.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "grid": ("grid_shadow", "blocker.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "gaussians": ("ellipsoids_shadow", "camera.to_world", {"direction": (0.3, 0.2, 0.1)}),
    "rod": ("rod_shadow", "blocker.control_points", {"direction": (0.3, 0.2, 0.1)}),
    "spline": ("painted_curves", "spline.control_points", {"direction": (0.3, 0.2, 0.1)}),
    "away": ("baffled_light", "blocker.vertex_positions", {"rotate": (0.48, 0.6, 0.64)}),
}
FAST = ("moved",)
SLIDING = {"mirrored", "mirror", "glass", "glass-view", "window", "mask", "grid", "gaussians", "rod", "spline"}
MORE = {"mirror": 4, "window": 4, "glass": 4, "away": 8}  # samples: the spatial form has heavy tails
KNOWN_TO = dict.fromkeys(("mirror", "window", "glass"), 0.1)  # of gains
EACH = [case if case in FAST else also(case) for case in CASES]
TOLD_UNDER_BOXES = [case if case in FAST else also(case) for case in CASES if case != "away"]  # noise would hide half


def motion_of(case: str, rfilter: str = "gaussian") -> Perturbation:
    name, param, how = CASES[case]
    size = {} if case == "crop" else {"res": RES}
    return perturb(load(Problem(name, param, 0.0), rfilter=rfilter, **size), param, **how)


def picture(pixel_format: str = "luminance", rfilter: str = "gaussian", wall: str = "diffuse") -> mi.Scene:
    """A card whose texels are a third of a pixel, before a grey wall, and a camera."""
    noise = np.random.default_rng(3).random((TEXELS, TEXELS, 1)).astype(np.float32)
    texture = {"type": "bitmap", "data": mi.TensorXf(noise), "raw": True, "filter_type": "bilinear"}
    film = {"type": "hdrfilm", "width": RES, "height": RES, "rfilter": {"type": rfilter}, "pixel_format": pixel_format}
    pose = mi.ScalarTransform4f()
    return mi.load_dict({
        "type": "scene", "lamp": {"type": "point", "position": [0.5, 1, 3], "intensity": 20.0},
        "card": {"type": "rectangle", "to_world": pose.rotate([0, 1, 0.2], 35), "bsdf":
                 {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}},
        "wall": {"type": "rectangle", "to_world": pose.translate([0, 0.4, -2]).scale(1.5), "bsdf": {"type": wall}},
        "camera": {"type": "perspective", "fov": 40, "to_world": pose.look_at([0, 0, 4], [0, 0, 0], UP), "film": film},
    }, optimize=False)  # fmt: skip


CARD, CAMERA = "card.to_world", "camera.to_world"
BALL = ("smooth_mesh", "ball.vertex_positions")


def picture_moves(param: str = CAMERA, **how) -> Perturbation:
    return perturb(picture(**how), param, (0.4, 0.3, 0.2))


def plan_of(scene: mi.Scene, param: str, kind: str = "psdr_path", **options):
    return psdr_jit.make_plan(scene, [param], integrator={"type": kind, "max_depth": 2, **options})


def assert_as_spatial(case: str, rfilter: str) -> None:
    motion = motion_of(case, rfilter)
    spp = SPP * MORE.get(case, 1)
    ours, theirs = (forward(motion, spec_of(motion.scene, **form), SEEDS, spp) for form in (FILM, SPATIAL))
    assert_grad_close(ours, theirs, **({"max_stderr": KNOWN_TO[case]} if case in KNOWN_TO else {}))


def assert_transposes(case: str, form: dict, rfilter: str) -> None:
    motion = motion_of(case, rfilter)
    integrator = integrator_specs.build(spec_of(motion.scene, **form))
    wJv, JTwv, w, Jv = adjoint_identity(motion.scene, CASES[case][1], integrator)
    assert integrator.plan.form == ("film" if case in SLIDING else form["form"]) and Jv > 0
    assert abs(wJv - JTwv) <= 1e-5 * w * Jv


@pytest.mark.parametrize("case", EACH)
def test_it_is_the_same_derivative(llvm, case):
    assert_as_spatial(case, "gaussian")


@pytest.mark.parametrize("case", TOLD_UNDER_BOXES)
def test_it_is_the_same_under_a_box_filter(llvm, case):
    """Whose pixels see what moves by what crosses their borders."""
    assert_as_spatial(case, "box")


@pytest.mark.parametrize("case", EACH)
def test_both_modes_know_what_crosses_borders(llvm, case):
    assert_transposes(case, FILM, "box")


@pytest.mark.slow
def test_what_crosses_borders_could_have_been_missing(llvm, monkeypatch):
    motion = motion_of("moved", rfilter="box")
    spec = spec_of(motion.scene, **FILM)
    whole = forward(motion, spec, SEEDS, SPP)
    monkeypatch.setattr(film_borders, "forward", lambda job: mi.TensorXf(0.0))
    with pytest.raises(AssertionError, match="gain"):
        assert_grad_close(forward(motion, spec, SEEDS, SPP), whole, max_stderr=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if case not in {"smooth", *SLIDING}])
def test_it_is_the_same_where_vertices_keep_to_their_surfaces(llvm, case):
    motion = motion_of(case)
    ours = forward(motion, spec_of(motion.scene, **FILM_MATERIAL), SEEDS, SPP)
    assert_grad_close(ours, forward(motion, spec_of(motion.scene, **SPATIAL), SEEDS, SPP))


@pytest.mark.parametrize(
    "form", [FILM, also(FILM_MATERIAL), also({"form": "film-mixed"})], ids=["film", "film-material", "film-mixed"]
)
@pytest.mark.parametrize("case", [*EACH[:1], "turned", *EACH[2:]])
def test_forward_and_backward_are_transposes(llvm, case, form):
    assert_transposes(case, form, "gaussian")


def test_other_things_may_move_as_well(llvm):
    """Both the card and the camera depend on one number: the flow hands on to both."""
    scene = picture()
    params = psdr_jit.traverse(scene)
    names = (CARD, CAMERA)
    poses = {name: mi.Transform4f(params[name]) for name in names}
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, **FILM})

    def attach() -> mi.Float:
        θ = mi.Float(0)
        dr.enable_grad(θ)
        for name, towards in zip(names, ((0, 1, 0), (1, 0, 0.5)), strict=True):
            params[name] = mi.Transform4f().translate(θ * mi.Vector3f(towards)) @ poses[name]
        params.update()
        return θ

    θ = attach()
    dr.forward(θ, dr.ADFlag.ClearEdges)
    image = np.array(integrator.render_forward(scene, params, seed=1, spp=8), np.float64)
    assert integrator.plan.form == "film"
    w = np.random.default_rng(1).normal(size=image.shape)
    θ = attach()
    integrator.render_backward(scene, params, mi.TensorXf(w.astype(np.float32)), seed=1, spp=8)
    bound = np.linalg.norm(w) * np.linalg.norm(image)
    assert abs(float(dr.grad(θ)[0]) - (w * image).sum()) < 1e-5 * bound


@pytest.mark.slow
@pytest.mark.parametrize("param", [CAMERA, CARD])
def test_fine_pictures_are_less_noisy(llvm, param):
    """Of slopes of texels the spatial form sees the largest part of their noise."""
    motion = picture_moves(param)
    spec = {"type": "psdr_path", "max_depth": 2}
    film, spatial = (forward(motion, {**spec, **form}, SEEDS, SPP) for form in (FILM, SPATIAL))
    assert 5 * film.var(0, ddof=1).mean() < spatial.var(0, ddof=1).mean()
    assert_grad_close(film, fd(motion, {"type": "path", "max_depth": 2}, STEP, SEEDS, 1024))


def test_it_is_chosen_before_fine_pictures(llvm):
    plan = plan_of(picture(), CAMERA)
    assert plan.form == "film" and "than spatial, by a pilot" in plan.form_reason


def test_it_is_chosen_for_what_is_round(llvm):
    """At outlines the spatial form has no finite variance, or nearly none: vertices slide by 1/cosθ there."""
    motion = perturb(load(Problem(*BALL, 0.0), res=RES, rfilter="gaussian"), BALL[1], (0.3, 0.2, 0.1))
    spec = {"type": "psdr_path", "max_depth": 2}
    auto, spatial = (forward(motion, {**spec, **form}, SEEDS, SPP) for form in ({}, SPATIAL))
    assert 4 * auto.var(0, ddof=1).mean() < spatial.var(0, ddof=1).mean()
    assert_grad_close(auto, spatial)
    plan = plan_of(motion.scene, BALL[1])
    assert plan.form == "film" and "than spatial, by a pilot" in plan.form_reason


@pytest.mark.slow
def test_what_moving_places_bring_could_have_been_missing(llvm, monkeypatch):
    """The comparison above can fail: nearly all of the derivative is there."""
    motion = picture_moves()
    spec = {"type": "psdr_path", "max_depth": 2, **FILM}
    whole = forward(motion, spec, SEEDS, SPP)
    monkeypatch.setattr(film_places, "forward", lambda job, p, records, L: mi.TensorXf(0.0))
    with pytest.raises(AssertionError, match="gain"):
        assert_grad_close(forward(motion, spec, SEEDS, SPP), whole, max_stderr=1.0)


@pytest.mark.slow
def test_coverage_moves_too(llvm):
    """The alpha channel, which nothing but outlines changes, by both forms."""
    motion = picture_moves(pixel_format="rgba")
    film, spatial = (
        forward(motion, {"type": "psdr_path", "max_depth": 2, **form}, SEEDS, SPP)[..., 3:] for form in (FILM, SPATIAL)
    )
    assert_grad_close(film, spatial)


@pytest.mark.slow
def test_a_pass_at_a_time(llvm):
    """In several passes, as memory demands, the same derivative."""
    motion = picture_moves()
    spec = {"type": "psdr_path", "max_depth": 8, **FILM}
    whole, parts = (forward(motion, {**spec, "record_mib": mib}, 8, 512) for mib in (512, 16))
    assert_grad_close(parts, whole)


def test_where_places_on_the_film_rest(llvm):
    """The plan says why; where nothing is painted or round, and under box filters, the form is not tried."""
    scene = picture()
    assert plan_of(scene, CAMERA, **FILM).form == "film"
    boxes = picture(rfilter="box")
    assert plan_of(boxes, CAMERA, **FILM).form == "film" and "film" not in plan_of(boxes, CAMERA).form_reason
    still = plan_of(scene, "lamp.position", **FILM)
    assert still.form == "spatial" and "camera and shapes rest" in still.form_reason
    assert plan_of(scene, CAMERA, "psdr_bdpt", **FILM).form == "film"  # no light is traced
    plain = motion_of("moved").scene
    assert "film" not in plan_of(plain, CAMERA).form_reason
    assert "film" not in plan_of(scene, "wall.to_world").form_reason  # grey: only the card is painted


def test_a_given_plan_is_one_of_its_film(llvm):
    scene, box, mirror = picture(), picture(rfilter="box"), picture(wall="conductor")
    text = plan_of(scene, CAMERA, **FILM).to_json()
    for there, match in ((scene, None), (box, None), (mirror, "leaves out chain")):
        motion = perturb(there, CAMERA, (1, 0, 0))
        motion.attach()
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "plan": text})
        call = integrator.call(there, there.sensors()[0], 0, 4)
        if match is None:
            assert prepare(call).plan.form == "film"
        else:
            with pytest.raises(OptionError, match=match):
                prepare(call)
        motion.restore()
