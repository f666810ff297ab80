"""Depth, position, normals and shape indices as channels beside radiance: their derivatives have the steps at outlines.

Without these, the derivative of a shape index would be 0, and that of depth a small part of what it is.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, fd, forward

import psdr_jit
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain
from psdr_jit.errors import OptionError, UnsupportedError
from psdr_jit.paths.aovs import Aovs
from psdr_jit.scene import io as scene_io

ALL = "dd:depth, pp:position, nn:sh_normal, ss:shape_index"
SEEDS, RES = 16, 24
TOLERANCE, MAX_STDERR = 0.02, 0.02
BOX = "blocker.vertex_positions"


def scene_of(name: str, **defaults) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), **{"res": RES, **defaults})


def spec_of(aovs: str, **options) -> dict:
    return {"type": "psdr_path", "max_depth": 1, "aovs": aovs, **options}


@pytest.mark.slow
@pytest.mark.parametrize("name, parameter, how, eps, more", [
    ("point_shadow", BOX, {"direction": (1, 0, 0)}, 0.003, ", gg:geo_normal"),  # outlines and creases of a box
    ("sunk_box", "box.vertex_positions", {"direction": (1, 0, 0)}, 0.005, ""),  # it cuts into the floor
    ("sphere_silhouette", "ball.to_world", {"direction": (1, 0, 0)}, 0.002, ""),
    ("smooth_mesh", "ball.vertex_positions", {"direction": (1, 0, 0)}, 0.002, ""),
    ("rod_shadow", "blocker.control_points", {"direction": (1, 0, 0)}, 0.003, ""),
    ("curve_shadow", "blocker.control_points", {"direction": (1, 0, 0)}, 0.003, ""),
    ("ellipsoids_shadow", "blocker.data", {"index": 1}, 0.003, ""),
    ("camera_perspective", "camera.to_world", {"rotate": (0, 1, 0)}, 0.002, ""),
    ("camera_perspective", "camera.to_world", {"direction": (1, 0, 0)}, 0.005, ""),
])  # fmt: skip
def test_against_finite_differences(llvm, name, parameter, how, eps, more):
    """Of Mitsuba's `aov` images, channel by channel."""
    motion = perturb(scene_of(name), parameter, **how)
    spec = spec_of(ALL + more)
    est, ref = forward(motion, spec, SEEDS, 256), fd(motion, spec, eps, SEEDS, 2048)
    for k, channel in enumerate(Aovs.parse(ALL + more).channels, start=3):
        found = gain(est[..., k], ref[::2, ..., k], ref[1::2, ..., k])
        stderr = float(np.hypot(found.stderr_estimate, found.stderr_reference))
        assert stderr < MAX_STDERR, f"{channel}: raise spp, the gain is known to {stderr:.3f}"
        assert abs(found.value - 1) < TOLERANCE + 3 * stderr, f"{channel}: gain {found.value:.4f} +- {stderr:.4f}"
        for wrong in (0, -1, 0.5):
            assert abs(wrong * found.value - 1) > TOLERANCE + 5 * stderr, "the test could not fail"


@pytest.mark.slow
def test_a_pattern_is_no_step(llvm):
    """A camera over a floor with a hundred lines: where it looks moves as it does, everywhere."""
    squares = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([50, 50, 1])}
    pose = mi.ScalarTransform4f().look_at(origin=(0.01, 0.02, 3), target=(0.01, 0.02, 0), up=(0, 1, 0))
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    scene = mi.load_dict({
        "type": "scene",
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": squares}},
        "camera": {"type": "perspective", "fov": 30, "to_world": pose, "film": film},
        "lamp": {"type": "point", "position": (0, 0, 4)},
    })  # fmt: skip
    found = forward(perturb(scene, "camera.to_world", (1, 0, 0)), spec_of("pp:position", max_depth=2), 4, 64).mean(0)
    x, y, z = (found[..., k] for k in (-3, -2, -1))
    assert np.abs(found[..., :3]).max() > 0.01, "radiance steps at the lines"
    assert abs(x.mean() - 1) < 1e-4 and np.abs(x - 1).max() < 1e-3
    assert np.abs(y).max() < 1e-3 and np.abs(z).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name, parameter", [("point_shadow", BOX), ("camera_perspective", "camera.to_world")])
def test_backward_mode_is_the_adjoint(llvm, name, parameter):
    integrator = integrator_specs.build(spec_of(ALL, sppc=8, sppp=8, sppi=8, form="spatial"))
    forward_dot, backward_dot, *norms = adjoint_identity(scene_of(name), parameter, integrator, spp=8)
    assert abs(forward_dot - backward_dot) <= 1e-5 * norms[0] * norms[1]
    assert abs(forward_dot) > 1e-3 * norms[0] * norms[1], "a test of nothing"


@pytest.mark.slow
def test_radiance_stays_as_it_is(llvm):
    """Image and derivative of the first channels are those without AOVs; further ones those of `aov`."""
    options = {"max_depth": 2, "sppc": 16, "sppp": 16, "sppi": 16, "form": "spatial"}
    with_aovs, without = spec_of(ALL, **options), {"type": "psdr_path", **options}
    motion = perturb(scene_of("point_shadow"), BOX, (1, 0, 0))
    a, b = (forward(motion, spec, 1, 16) for spec in (with_aovs, without))
    assert np.array_equal(a[..., :3], b[..., :3]) and np.abs(a[..., 3:]).max() > 0
    image = np.array(mi.render(motion.scene, integrator=integrator_specs.build(with_aovs), spp=16))
    outer = {"type": "aov", "aovs": Aovs.parse(ALL).text, "image": {"type": "path", "max_depth": 2}}
    assert np.allclose(image, np.array(mi.render(motion.scene, integrator=mi.load_dict(outer), spp=16)), atol=1e-5)
    aov_path = {"type": "aov", "aovs": Aovs.parse(ALL).text, "image": without}
    nested = mi.render(motion.scene, integrator=mi.load_dict(aov_path), spp=16)
    assert np.allclose(image, np.array(nested), atol=1e-5), "an image around ours is right"
    with pytest.raises(UnsupportedError, match="aovs = "):
        integrator = mi.load_dict(aov_path)
        motion.attach()
        integrator.render_forward(motion.scene, motion.params, spp=4)


@pytest.mark.slow
def test_both_integrators_have_the_same(llvm):
    """AOVs know nothing of light subpaths."""
    motion = perturb(scene_of("point_shadow"), BOX, (1, 0, 0))
    spec = spec_of("dd:depth", sppc=8, sppp=8, sppi=8, form="spatial")
    a, b = (forward(motion, {**spec, "type": name}, 1, 8)[..., 3] for name in ("psdr_path", "psdr_bdpt"))
    assert np.abs(a).max() > 1 and np.allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_gradient_has_them_too(llvm):
    """Terms of the public function add up, and its check compares all channels."""
    scene = scene_of("point_shadow", res=16)
    spec = spec_of("dd:depth", sppc=64, sppp=64)
    found = psdr_jit.gradient(scene, BOX, (1, 0, 0), integrator=spec, spp=64, seeds=4)
    assert found.total.shape == (16, 16, 4) and found.primal.shape == (16, 16, 4)
    assert found.aovs == ["dd.T"] == integrator_specs.aovs_of(integrator_specs.build(spec))
    assert np.abs(found.terms["primary"][..., 3]).max() > 10 * np.abs(found.terms["primary"][..., :3]).max()


@pytest.mark.parametrize("aovs, error, words", [
    ("depth", OptionError, "name:kind"),
    ("d:far", OptionError, "kind out of depth"),
    ("d:depth, d:position", OptionError, "its own name"),
    ("u:uv", UnsupportedError, "seams.*Mitsuba's `aov`"),
    ("i:prim_index", UnsupportedError, "between any two faces"),
])  # fmt: skip
def test_others_are_refused(aovs, error, words):
    with pytest.raises(error, match=words):
        Aovs.parse(aovs)


def test_face_normals_of_smooth_meshes_are_refused(llvm):
    Aovs.parse("g:geo_normal").require_edges(scene_of("point_shadow"))
    with pytest.raises(UnsupportedError, match="smooth mesh 'ball'"):
        Aovs.parse("g:geo_normal").require_edges(scene_of("smooth_mesh"))


def test_the_summary_is_of_colours(llvm):
    """Depths and normals have other units."""
    plain, more = (
        repr(psdr_jit.gradient(scene_of("area_shadow"), BOX, (1, 0, 0), integrator=spec, spp=4, seeds=1)).splitlines()
        for spec in ({"type": "psdr_path", "max_depth": 1}, spec_of("dd:depth, nn:sh_normal"))
    )
    assert plain[2] == more[2]  # the total
    assert any("dd.T" in line for line in more)
