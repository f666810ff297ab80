"""Forward and backward mode are transposes of each other: |⟨w, Jv⟩ − ⟨Jᵀw, v⟩| ≤ 1e-5 ‖w‖‖Jv‖ at the same seed."""

from __future__ import annotations

import pytest
from helpers import TERMS, adjoint_identity, load, spec_of
from problems import Problem

from psdr_jit.derivative import integrator_specs

TOLERANCE = 1e-5
SIZE = {"res": 16}

CASES = {  # what moves: (scene, parameter, terms whose derivative is not zero)
    "mesh": ("lit_box", "box.vertex_positions", {"interior", "primary"}),
    "area-light-pose": ("lit_box", "light.to_world", {"interior"}),
    "emitter-mesh": ("emitter_mesh", "card.vertex_positions", {"interior", "primary"}),
    "sphere": ("envmap_rotation", "ball.to_world", {"interior", "primary"}),
    "cylinder": ("cylinder_outline", "tube.to_world", {"primary"}),
    "curve": ("curve_shadow", "blocker.control_points", {"interior", "primary", "direct"}),
    "linear-curve": ("rod_shadow", "blocker.control_points", {"interior", "primary", "direct"}),
    "painted-spline": ("painted_curves", "spline.control_points", {"interior", "primary", "direct"}),
    "painted-rods": ("painted_curves", "rods.control_points", {"interior", "primary", "direct"}),
    "ellipsoids": ("ellipsoids_shadow", "blocker.data", {"interior", "primary", "direct"}),
    "grid": ("grid_shadow", "blocker.grid", {"interior", "primary", "direct"}),
    "camera-pose": ("lit_box", "camera.to_world", {"interior", "primary"}),
    "camera-fov": ("lit_box", "camera.x_fov", {"interior", "primary"}),
    "thin-lens": ("camera_thinlens", "camera.focus_distance", {"interior", "primary"}),
    "orthographic": ("camera_orthographic", "camera.to_world", {"interior", "primary"}),
    "environment-pose": ("envmap_rotation", "sky.to_world", {"interior"}),
    "lamp": ("point_light", "lamp.position", {"interior"}),
    "radiance": ("textured_emitter", "card.emitter.radiance.data", {"interior"}),
    "texture": ("sliding_texture", "floor.bsdf.reflectance.data", {"interior"}),
    "shadow": ("area_shadow", "blocker.vertex_positions", {"interior", "primary", "direct"}),
    "sky": ("environment_shadow", "blocker.vertex_positions", {"interior", "primary", "direct", "indirect"}),
    "sunk-mesh": ("sunk_box", "box.vertex_positions", {"interior", "primary", "direct", "indirect"}),
    "sunk-ball": ("sunk_ball", "ball.to_world", {"interior", "primary", "direct", "indirect"}),
    "floor-around-ball": ("sunk_ball", "floor.to_world", {"interior", "primary", "direct", "indirect"}),
    "roughness": ("rough_dielectric", "ball.bsdf.alpha.value", {"interior"}),
}


def check(case: str, term: str | None, known: bool | None, **options) -> None:
    """`known`: must this derivative be non-zero (True), zero (False), or may it be either (None)?"""
    scene_name, param, _ = CASES[case]
    scene = load(Problem(scene_name, param, 0.0), **{**SIZE, **options.pop("load", {})})
    integrator = integrator_specs.build(spec_of(scene, term, **options))
    wJv, JTwv, w, Jv = adjoint_identity(scene, param, integrator)
    assert known is None or (Jv > 1e-6) == known
    if Jv == 0:
        assert JTwv == 0
    else:
        assert abs(wJv - JTwv) <= TOLERANCE * w * Jv, f"forward {wJv:.8g}, backward {JTwv:.8g}, bound on {w * Jv:.3g}"


# much as others, with kernels of their own to compile
SLOW = (
    "orthographic", "thin-lens", "sunk-ball", "sunk-mesh", "floor-around-ball", "sky", "curve", "painted-spline",
    "painted-rods", "ellipsoids", "grid",
)  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow) if c in SLOW else c for c in CASES])
def test_all_terms(variant, case):
    check(case, None, True)


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("case", ["mesh", "sphere", "camera-pose", "texture"])
def test_each_term_alone(variant, case, term):
    """A term that has nothing to say for a parameter is exactly 0 in both modes."""
    check(case, term, known=term in CASES[case][2] if term in ("interior", "primary") else None)


@pytest.mark.parametrize("options", [
    dict(load=dict(rfilter="gaussian", sample_border="true", pixel_format="rgba")),
    dict(max_depth=-1, rr_depth=2),
    dict(hide_emitters=True),
    dict(record_mib=16, load=dict(res=48, spp=64)),
], ids=["gaussian-border-rgba", "roulette", "hide-emitters", "several-passes"])  # fmt: skip
def test_options(variant, options):
    check("mesh", None, True, **options)


@pytest.mark.slow
def test_blended_normals(variant):
    check("grid", None, True, load={"normals": "smooth"})


def test_the_identity_can_fail(llvm):
    """Different seeds are different matrices: the bound tells them apart."""
    scene_name, param, _ = CASES["mesh"]
    scene = load(Problem(scene_name, param, 0.0), **SIZE)
    integrator = integrator_specs.build(spec_of(scene))
    wJv, _, w, Jv = adjoint_identity(scene, param, integrator, seed=1)
    _, JTwv, _, _ = adjoint_identity(scene, param, integrator, seed=2)
    assert abs(wJv - JTwv) > 10 * TOLERANCE * w * Jv
    for wrong in (0.0, -wJv, wJv / 2):
        assert abs(wJv - wrong) > 10 * TOLERANCE * w * Jv
