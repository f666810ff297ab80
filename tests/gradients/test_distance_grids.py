"""Grids of signed distances: what finite differences of whole scenes (`problems`) do not tell apart."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fd, forward
from test_linear_curves import EYE, scene_of

from psdr_jit import make_plan
from psdr_jit.core.ad import tangents
from psdr_jit.core.memory import Memory
from psdr_jit.core.records import Hit
from psdr_jit.core.upload import in_memory
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain
from psdr_jit.edges.grid_triangles import grid_triangles
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.paths.grid_surface import grid_surface
from psdr_jit.plan.motion import SceneMotion
from psdr_jit.scene import io as scene_io
from psdr_jit.scene.facts import analyse
from psdr_jit.scene.grids import blends_normals, moving_grids
from psdr_jit.scene.surfaces import surfaces_of

SIZE = 2.2  # edge of a grid
ONE_TERM = {"type": "psdr_path", "form": "spatial", "sppc": 1, "max_depth": 2}


def axes(n: int) -> list[np.ndarray]:
    """Coordinates (z, y, x) of n³ points in [−1, 1]³."""
    return np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")


def torus(n: int) -> np.ndarray:
    z, y, x = axes(n)
    return np.hypot(np.hypot(x, y) - 0.6, z) - 0.27


def blob(n: int) -> np.ndarray:
    z, y, x = axes(n)
    return np.sqrt(x * x + 1.7 * y * y + z * z) - 0.6 + 0.13 * np.sin(5 * x + 1) * np.cos(4 * z) + 0.1 * np.sin(4 * y)


def sheet(n: int) -> np.ndarray:
    """Ends at the border of the grid."""
    z, y, x = axes(n)
    return z + 0.3 * np.sin(2.5 * x) * np.cos(2 * y + 0.5) - 0.1


def grid(values: np.ndarray, normals: str = "analytic", size: float = SIZE, **children) -> dict:
    place = mi.ScalarTransform4f().translate([-size / 2] * 3).scale(size)
    tensor = mi.TensorXf(values[..., None].astype(np.float32))
    return {"type": "sdfgrid", "grid": tensor, "normals": normals, "to_world": place, **children}


@pytest.mark.parametrize("normals", ["analytic", "smooth"])
def test_how_a_grid_is_shaded_is_found_out(llvm, normals):
    assert blends_normals(mi.load_dict(grid(blob(8), normals)), Memory()) == (normals == "smooth")


@pytest.mark.parametrize("normals", ["analytic", "smooth"])
def test_its_surface_moves_with_its_values(llvm, normals):
    """Points and normals are Mitsuba's, their derivatives those of rays that are traced anew."""
    if llvm.startswith("cuda"):
        pytest.skip("textures of CUDA have weights of 8 bits: Mitsuba's normals are known to 0.002")
    scene = scene_of(blob=grid(blob(9), normals))
    shape, params, rng = scene.shapes()[1], mi.traverse(scene), np.random.default_rng(0)
    target = mi.Point3f(*(mi.Float(rng.uniform(-0.8, 0.8, 4000)) for _ in range(3)))
    d, values = dr.normalize(target - mi.Point3f(*EYE)), dr.detach(params["blob.grid"])
    direction = mi.Float(rng.normal(size=9**3))

    def ray(θ):
        return mi.Ray3f(mi.Point3f(*EYE) + θ * mi.Vector3f(0.2, 0.1, 0.4), dr.normalize(d + θ * mi.Vector3f(0.1, 0, 0)))

    def move(θ):
        params["blob.grid"] = in_memory(mi.TensorXf(values.array + θ * direction, values.shape))
        params.update()

    def cell(p):  # CUDA numbers cells anew with every change
        return mi.Vector3i(dr.floor((p / SIZE + 0.5) * 8))

    h, met = 1e-3, []
    for θ in (mi.Float(h), mi.Float(-h), mi.Float(0)):
        move(θ)
        pi = scene.ray_intersect_preliminary(ray(θ))
        si = pi.compute_surface_interaction(ray(θ))
        dr.eval(pi, si)
        met.append(si)
    θ = mi.Float(0)
    dr.enable_grad(θ)
    move(θ)
    (own,) = moving_grids(scene, analyse(scene), Memory())
    assert own.shape is shape and own.blends == (normals == "smooth")
    si = grid_surface(own, pi, pi.prim_index, ray(θ), False, own.segment(pi, pi.is_valid())[1])
    dr.forward(θ, dr.ADFlag.ClearNone)
    same = own.segment(pi, pi.is_valid())[1]
    for other in met[:2]:  # in one cell all along
        same &= other.is_valid() & (other.shape == mi.ShapePtr(shape)) & dr.all(cell(other.p) == cell(met[2].p))
    same = np.array(same)
    assert same.sum() > 300
    for name, value in (("p", lambda s: s.p), ("n", lambda s: s.n), ("shading", lambda s: s.sh_frame.n)):
        assert np.abs(np.array(value(si) - value(met[2])))[:, same].max() < 1e-4, name
        expected = np.array((value(met[0]) - value(met[1])) / (2 * h))[:, same]
        error = np.abs(np.array(dr.grad(value(si)))[:, same] - expected).max(0) / (np.abs(expected).max(0) + 0.1)
        assert np.quantile(error, 0.95) < 5e-3, name


def test_points_that_a_ring_throws_shadows_on_move_with_it(llvm):
    """Receivers on the grid itself: their displacement, asked for with the mask that says where there is a surface."""
    scene = scene_of(ring=grid(torus(12)))
    perturb(scene, "ring.grid").attach()
    facts = analyse(scene)
    surfaces = surfaces_of(scene, facts, Memory())
    d = dr.normalize(mi.Point3f(mi.Float(0.6, 0.6, 3), mi.Float(0.1, -0.1, 3), 0) - mi.Point3f(*EYE))
    ray = mi.Ray3f(mi.Point3f(*EYE), d)
    hit = Hit.of(ray, scene.ray_intersect_preliminary(ray))
    with SceneMotion(scene.sensors()[0], surfaces).attached() as moving:
        moved = tangents(moving.of_surface(hit))
    speed = np.array(dr.norm(moved))
    assert (speed[:2] > 0.5).all()
    assert speed[2] == 0


def test_triangles_lie_on_the_surface(llvm):
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    t = grid_triangles(mi.load_dict(grid(torus(20))), np.array(place.matrix))
    area = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2
    assert abs(area / (4 * np.pi**2 * 0.6 * 0.27) - 1) < 0.02


@pytest.mark.parametrize(("height", "cuts"), [(-0.9, False), (-1.3, True)])
def test_a_grid_in_another_shape_is_named(llvm, recwarn, height, cuts):
    lowered = grid(torus(12)) | {"to_world": mi.ScalarTransform4f().translate([-1.1, -1.1, -1.1 + height]).scale(2.2)}
    make_plan(scene_of(ring=lowered), "camera.to_world", integrator=ONE_TERM)
    said = [str(w.message) for w in recwarn if issubclass(w.category, UnsupportedWarning)]
    assert any("'ring' (sdfgrid)" in text for text in said) == cuts


def instance() -> dict:
    turned = mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 40)
    copy = {"type": "instance", "of": {"type": "ref", "id": "group"}, "to_world": turned}
    return {"group": {"type": "shapegroup", "inner": grid(torus(12))}, "copy": copy}


SEEN = {
    "instance": instance,
    "bumpy": lambda: {"blob": grid(blob(10))},
    "open": lambda: {"sheet": grid(sheet(10), bsdf={"type": "twosided", "of": {"type": "diffuse"}})},
    "smooth": lambda: {"ring": grid(torus(12), "smooth")},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEN)
def test_a_camera_passes(llvm, name):
    motion = perturb(scene_of(**SEEN[name]()), "camera.to_world", direction=(0.3, 0, 1))
    spec = {"type": "psdr_path", "max_depth": 2}
    reference = fd(motion, spec, 0.01, 32, 1024)
    slope = gain(forward(motion, spec, 16, 1024), reference[0::2], reference[1::2])
    assert slope.stderr < 0.01, slope
    assert abs(slope.value - 1) < 0.01 + 2.5 * slope.stderr, slope


@pytest.mark.slow
def test_a_fine_grid_with_blended_normals(llvm):
    """The coarse grid of the file has gain 0.99, and is named."""
    scene = scene_io.load_scene(scene_io.shipped_scene("grid_shadow.xml"), res=24, normals="smooth", rfilter="gaussian")
    params = mi.traverse(scene)
    params["blocker.grid"] = mi.TensorXf(torus(48)[..., None].astype(np.float32))
    params.update()
    motion = perturb(scene, "camera.to_world", direction=(0, 1, 0))
    spec = {"type": "psdr_path", "max_depth": 2, "rr_depth": 1000}
    reference = fd(motion, spec, 0.004, 16, 2048)
    slope = gain(forward(motion, spec, 16, 256), reference[0::2], reference[1::2])
    assert slope.stderr < 0.01, slope
    assert abs(slope.value - 1) < 0.01 + 2.5 * slope.stderr, slope


@pytest.mark.parametrize("normals", [pytest.param("smooth", marks=pytest.mark.slow), "analytic"])
def test_coarse_grids_with_blended_normals_are_named(llvm, normals):
    scene = scene_io.load_scene(scene_io.shipped_scene("grid_shadow.xml"), res=8, normals=normals)
    motion = perturb(scene, "camera.to_world", (1, 0, 0))
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2})
    motion.attach()
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        integrator.render_forward(scene, motion.params, sensor=scene.sensors()[0], spp=1)
    assert any("blended normals" in str(w.message) for w in found) == (normals == "smooth")
