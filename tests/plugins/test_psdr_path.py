"""The plugin as users meet it: registration, options, determinism, `mi.render`, variants."""

from __future__ import annotations

import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, load, motion_of, spec_of
from problems import Problem, named
from variants import activate

from psdr_jit.derivative import integrator_specs
from psdr_jit.errors import OptionError, UnsupportedError, ZeroDerivativeWarning
from psdr_jit.scene import io as scene_io

SIZE = {"res": 16}
BOX = Problem("lit_box", "box.vertex_positions", 0.0, direction=(1, 0, 0))
CAMERA = Problem("lit_box", "camera.to_world", 0.0, direction=(1, 0, 0))
PLATE = named("rectangle_moved", "plate.to_world")

ORDERS = {
    "variant, then import": "mi.set_variant('llvm_ad_rgb'); import psdr_jit",
    "import, then variant": "import psdr_jit; mi.set_variant('llvm_ad_rgb')",
    "another variant first": "mi.set_variant('scalar_rgb'); import psdr_jit; mi.set_variant('llvm_ad_rgb')",
    "there and back": "import psdr_jit; [mi.set_variant(v) for v in ('llvm_ad_rgb', 'llvm_ad_spectral', 'scalar_rgb',"
                      " 'llvm_mono' if 'llvm_mono' in mi.variants() else 'scalar_rgb', 'llvm_ad_rgb')]",
}  # fmt: skip


@pytest.mark.parametrize("order", ORDERS)
def test_registration(order):
    code = (
        f"import mitsuba as mi; {ORDERS[order]}; i = mi.load_dict({{'type': 'psdr_path', 'max_depth': 3}}); "
        "assert i.options.max_depth == 3 and isinstance(i, mi.ad.common.ADIntegrator), type(i)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_variants_switch_back_and_forth(llvm):
    for name in ("llvm_ad_spectral", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
        activate(name)
        scene = load(PLATE, **SIZE)
        integrator = integrator_specs.build(spec_of(scene))
        assert isinstance(integrator, mi.Integrator)  # of this variant, not of the one before
        image = derivative(scene, integrator, problem=PLATE)
        assert image.shape[:2] == (16, 16) and np.abs(image).max() > 0


def test_from_xml(llvm):
    scene = mi.load_string(
        '<scene version="3.0.0"><integrator type="psdr_path"><integer name="max_depth" value="4"/>'
        '<integer name="sppp" value="7"/></integrator></scene>'
    )
    options = scene.integrator().options
    assert options.max_depth == 4 and options.sppp == 7 and options.sppc is None
    assert "max_depth=4" in str(scene.integrator())


@pytest.mark.parametrize("properties, message", [
    ({"max_deth": 3}, "max_deth"),
    ({"max_depth": -2}, "max_depth"),
    ({"sppc": -1}, "sppc"),
    ({"rr_depth": 0}, "rr_depth"),
    ({"record_mib": 1}, "record_mib"),
], ids=lambda p: str(p))  # fmt: skip
def test_wrong_properties_are_errors(llvm, properties, message):
    with pytest.raises((RuntimeError, ValueError, TypeError), match=message):
        mi.load_dict({"type": "psdr_path", **properties})


def derivative(scene, integrator, seed=0, spp=4, problem=BOX) -> np.ndarray:
    motion_of(problem, scene).attach()
    return np.array(dr.detach(integrator.render_forward(scene, mi.traverse(scene), seed=seed, spp=spp)))


def test_a_budget_of_zero_switches_a_term_off(variant):
    scene = load(BOX, **SIZE)
    full, interior, primary = (
        derivative(scene, integrator_specs.build({"type": "psdr_path", "max_depth": 2, **off}))
        for off in ({"sppc": 1}, {"sppp": 0}, {"sppc": 0})  # any budget that is set ends automatic ones
    )
    assert np.abs(interior).max() > 0 and np.abs(primary).max() > 0
    assert np.allclose(full, interior + primary, rtol=1e-4, atol=1e-4 * np.abs(full).max())


def test_all_terms_off_is_an_error(llvm):
    scene = load(BOX, **SIZE)
    off = {"type": "psdr_path", "sppc": 0, "sppp": 0, "sppd": 0, "sppi": 0}
    with pytest.raises(OptionError, match="switched off"):
        derivative(scene, integrator_specs.build(off))


def test_depth_zero_is_black(llvm):
    card = Problem("emissive_card", "card.vertex_positions", 0.0, direction=(1, 0, 0))
    with pytest.warns(ZeroDerivativeWarning, match="max_depth = 0"):
        image = derivative(load(card, **SIZE), mi.load_dict({"type": "psdr_path", "max_depth": 0}), problem=card)
    assert image.shape == (16, 16, 3) and not image.any()


def test_budgets_without_runtime_spp(llvm):
    """spp = 0: a term's own budget counts, or else the sampler's."""
    scene = load(BOX, spp=3, **SIZE)
    by_sampler = derivative(scene, mi.load_dict({"type": "psdr_path", "max_depth": 2, "sppd": 3}), spp=0)
    explicit = derivative(scene, mi.load_dict({"type": "psdr_path", "max_depth": 2, "sppc": 3, "sppp": 3}), spp=0)
    runtime = derivative(scene, mi.load_dict({"type": "psdr_path", "max_depth": 2, "sppc": 9, "sppp": 1}), spp=3)
    other = derivative(scene, mi.load_dict({"type": "psdr_path", "max_depth": 2, "sppp": 5}), spp=0)
    assert np.array_equal(by_sampler != 0, explicit != 0) and np.allclose(by_sampler, explicit, atol=1e-4)
    assert np.allclose(by_sampler, runtime, atol=1e-4)
    assert not np.allclose(by_sampler, other, atol=1e-3)


def test_same_seed_same_image(variant):
    """Up to the order in which splats are added: within rounding, and far closer than another seed."""
    scene, integrator = load(BOX, **SIZE), mi.load_dict({"type": "psdr_path", "max_depth": 2})
    one, again, other = (derivative(scene, integrator, seed) for seed in (1, 1, 2))
    assert np.abs(one - again).max() <= 1e-5 * np.abs(one).max()
    assert np.abs(one - other).max() > 1e-2 * np.abs(one).max()


def test_seeds_are_independent_when_split_into_passes(llvm):
    """The noise of two seeds is uncorrelated, also where the paths of one call do not fit into memory at once."""
    scene = load(Problem("point_light", "floor.bsdf.reflectance.value", 0.0), res=64, max_depth=4)
    scene_param = Problem("point_light", "floor.bsdf.reflectance.value", 0.0)
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 4, "record_mib": 16, "sppp": 0})
    from psdr_jit.paths.recording import PathRecords

    per_pass = 16 * 2**20 // (PathRecords.BYTES_RGB * 4 * 64 * 64)
    images = [derivative(scene, integrator, k * per_pass, 2 * per_pass, scene_param).ravel() for k in range(8)]
    noise = np.array(images) - np.mean(images, axis=0)
    neighbours = [np.corrcoef(noise[k], noise[k + 1])[0, 1] for k in range(7)]
    assert np.abs(neighbours).max() < 0.25


def test_primal_is_path(variant):
    scene = load(BOX, **SIZE)
    options = {"max_depth": 3, "rr_depth": 2, "hide_emitters": True}
    ours, path = (mi.load_dict({"type": t, **options}) for t in ("psdr_path", "path"))
    assert np.array_equal(np.array(ours.render(scene, seed=5, spp=4)), np.array(path.render(scene, seed=5, spp=4)))


@pytest.mark.parametrize("case", ["mesh", "camera"])
def test_render_and_backward(variant, case):
    """`mi.render` with gradients: forward and backward agree, and with the plugin's own images."""
    problem = BOX if case == "mesh" else CAMERA
    scene = load(problem, **SIZE)
    integrator = integrator_specs.build(spec_of(scene))
    params = mi.traverse(scene)
    w = np.random.default_rng(0).normal(size=(16, 16, 3)).astype(np.float32)

    def image(theta):
        motion = motion_of(problem, scene)
        params[problem.param] = motion.curve(theta)
        params.set_dirty(problem.param)
        params.update()
        return mi.render(scene, params, integrator=integrator, seed=1, seed_grad=2, spp=4)

    theta = mi.Float(0)
    dr.enable_grad(theta)
    out = image(theta)
    dr.forward(theta)
    forward = float(np.sum(w.astype(np.float64) * np.array(dr.grad(out))))

    theta = mi.Float(0)
    dr.enable_grad(theta)
    dr.backward(dr.sum(image(theta) * mi.TensorXf(w), axis=None))
    backward = float(dr.grad(theta)[0])

    theta = mi.Float(0)
    dr.enable_grad(theta)
    scale = np.linalg.norm(w) * np.linalg.norm(derivative(scene, integrator, 2, 4, problem))
    assert abs(forward) > 1e-3 and abs(forward - backward) < 1e-5 * scale
    own = float(np.sum(w.astype(np.float64) * derivative(scene, integrator, 2, 4, problem)))
    assert abs(forward - own) < 1e-4 * scale


@pytest.mark.parametrize("name", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_colours(name):
    """Forward and backward agree, and the image resembles that of RGB (which the finite differences vouch for)."""
    reference = {}
    for v in ("llvm_ad_rgb", name):
        activate(v)
        scene = load(PLATE, **SIZE)
        integrator = integrator_specs.build(spec_of(scene))
        wJv, JTwv, w, Jv = adjoint_identity(scene, "plate.to_world", integrator)
        assert abs(wJv - JTwv) < 1e-5 * w * Jv
        reference[v] = derivative(scene, integrator, spp=128, problem=PLATE).mean(-1)
    rgb, image = reference.values()
    assert 0.9 < np.sum(rgb * image) / np.sum(rgb**2) < 1.1


def test_polarised_variants_are_refused():
    name = "llvm_ad_spectral_polarized"
    activate(name)
    try:
        scene = load(BOX, **SIZE)
        with pytest.raises(UnsupportedError, match="polarised"):
            derivative(scene, mi.load_dict({"type": "psdr_path", "max_depth": 2}))
    finally:
        activate("llvm_ad_rgb")


def test_several_sensors_and_odd_budgets(llvm):
    """Sensors of different film sizes in one scene; each is rendered with its own film."""
    scene = mi.load_file(str(scene_io.shipped_scene("lit_box.xml")), optimize=False)
    other = mi.load_dict({
        "type": "perspective", "fov": 40.0,
        "to_world": mi.ScalarTransform4f().look_at([2, 1, 3], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 13, "height": 7, "pixel_format": "rgb", "rfilter": {"type": "box"}},
    })  # fmt: skip
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2})
    for sensor, shape in ((0, (32, 32, 3)), (other, (7, 13, 3)), (0, (32, 32, 3))):
        motion_of(BOX, scene).attach()
        image = np.array(integrator.render_forward(scene, mi.traverse(scene), sensor=sensor, seed=0, spp=5))
        assert image.shape == shape and np.isfinite(image).all() and np.abs(image).max() > 0


@pytest.mark.parametrize("where", ["partly behind the camera", "across the near plane", "outside the film"])
def test_awkward_places(variant, where):
    """Edges that the camera cannot see, or sees half of: finite, and equal to the transpose."""
    scene = load(BOX, **SIZE)
    params = mi.traverse(scene)
    offset = {"partly behind the camera": (0.3, 0, 3.8), "across the near plane": (0.05, 0.45, 3.6),
              "outside the film": (1.2, 0.8, 0)}[where]  # fmt: skip
    vertices = np.array(params[BOX.param]).reshape(-1, 3)
    params[BOX.param] = (vertices + np.array(offset)).ravel()
    params.update()
    image = derivative(scene, mi.load_dict({"type": "psdr_path", "max_depth": 2}))
    assert np.isfinite(image).all()
    integrator = integrator_specs.build(spec_of(scene))
    wJv, JTwv, w, Jv = adjoint_identity(scene, BOX.param, integrator)
    assert abs(wJv - JTwv) <= 1e-5 * w * Jv + 1e-12
