"""Coarse smooth-shaded meshes: what a face reflects steps where a light, or what is lit, sinks below its plane.

Without these steps turned spheres of 16 segments are wrong by up to 38 standard errors a block of pixels here, and a
cube that is shaded as if it were round by 62.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import TERMS, adjoint_identity, fd, forward
from test_smooth_meshes import REFLECTOR, coarse_cube, smooth_mesh, sphere, torus

from psdr_jit import make_plan
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import block_means, gain

AXIS, X = (0.48, 0.6, 0.64), (1, 0, 0)
POSITIONS = "shape.vertex_positions"
TURNED, MOVED = (POSITIONS, {"rotate": AXIS}), (POSITIONS, {"direction": X})
STEP = 0.01  # of finite differences [scene units, rad]
SEEDS, BLOCK = 16, 4
RMS_Z, MAX_Z = 1.7, 4.5  # of 16 blocks
FLOOR = 1e-3  # relative to the largest block: what finite steps leave where next to nothing is seen


def at(origin: tuple, target: tuple = (0, 0, 0), up: tuple = (0, 0, 1)) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up))


def card(pose: mi.ScalarTransform4f, albedo: float, radiance: float | None = None) -> dict:
    found = {"type": "rectangle", "to_world": pose,
             "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}}  # fmt: skip
    light = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return found if radiance is None else {**found, "emitter": light}


def lamp() -> dict:
    return {"lamp": card(at((2.5, -1.5, 2.5), up=(0, 1, 0.3)).scale(0.8), 0.0, 8.0)}


def lit_wall() -> dict:
    """The lamp shines on the wall alone."""
    wall = at((2.6, -0.4, 0.6), (0, 0, 0.2))
    shade = at((1.5, -0.3, 2.0), (2.6, -0.4, 0.6), up=(0, 1, 0)).scale(0.4)
    return {"wall": card(wall, 0.9), "lamp": card(shade, 0.0, 40.0)}


def sky() -> dict:
    """Two windows in the dark."""
    picture = np.full((16, 32, 3), 0.2, np.float32)
    picture[4:7, 10:14], picture[3:9, 24:27] = 12, 6
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(picture),
                    "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90)}}  # fmt: skip


def many_lamps() -> dict:
    """More lights than are looked at one by one."""
    ring = [(3 * np.cos(a), 3 * np.sin(a), 2 * np.cos(3 * a)) for a in np.linspace(0, 2 * np.pi, 20, endpoint=False)]
    return {f"lamp{i}": card(at(place).scale(0.4), 0.0, 3.0) for i, place in enumerate(ring)}


def scene_of(shape: mi.Mesh, fov: float = 26, **others: dict) -> mi.Scene:
    shape.set_id("shape")
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    camera = {"type": "perspective", "fov": fov, "to_world": at((0.3, -6, 1)), "film": film}
    return mi.load_dict({"type": "scene", "shape": shape, "camera": camera, **others}, optimize=False)


def ball(**others: dict) -> mi.Scene:
    return scene_of(sphere(16, **REFLECTOR), **(others or lamp()))


def sheet(**children: dict) -> mi.Mesh:
    """Open, a dome: below its faces as above them there is air, and then the other faces' backs."""
    ticks = np.linspace(-1, 1, 5)
    x, y = (a.ravel() for a in np.meshgrid(ticks, ticks, indexing="ij"))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(4), np.arange(4), indexing="ij"))
    a, b, c, d = 5 * i + j, 5 * i + 5 + j, 5 * i + 6 + j, 5 * i + j + 1
    normals = np.stack([x, y, 1 + 0 * x], -1)
    points = np.stack([x, y, -0.5 * (x * x + y * y)], -1)
    return smooth_mesh(points, normals, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), **children)


def assert_right(scene: mi.Scene, param: str, how: dict, depth: int = 2, scale: float = 2, **options) -> None:
    """Every block of pixels is what finite differences say, and so is the gain."""
    motion, plain = perturb(scene, param, **how), {"type": "psdr_path", "max_depth": depth}
    reference = fd(motion, plain, STEP, 2 * SEEDS, int(1024 * scale))
    found = forward(motion, {**plain, **options}, SEEDS, int(512 * scale))
    slope = gain(found, reference[0::2], reference[1::2])
    ours, theirs = block_means(found, BLOCK), block_means((reference[0::2] + reference[1::2]) / 2, BLOCK)
    error = ours.var(0, ddof=1) / len(ours) + theirs.var(0, ddof=1) / len(theirs)
    z = (ours.mean(0) - theirs.mean(0)) / np.sqrt(error + (FLOOR * np.abs(theirs.mean(0)).max()) ** 2)
    assert abs(slope.value - 1) < 0.01 + 2.5 * slope.stderr, slope
    assert np.sqrt(np.mean(z**2)) < RMS_Z and np.abs(z).max() < MAX_Z, z.squeeze().round(1)


@pytest.mark.slow
def test_a_cube_shaded_as_if_it_were_round(llvm):
    assert_right(scene_of(coarse_cube(**REFLECTOR), **lamp()), *TURNED, scale=0.25)


TWOSIDED = {"bsdf": {"type": "twosided", "nested": {"type": "diffuse"}}}
GLOSSY = {"bsdf": {"type": "roughconductor", "alpha": 0.4}}
LAMP_MOVED = ("lamp.to_world", {"direction": (0.6, 0, 0.8)})
CASES = {
    "moved": (ball, *MOVED),
    "turned": (ball, *TURNED),
    "lamp-moved": (ball, *LAMP_MOVED),
    "two-sided": (lambda: scene_of(sphere(12, **TWOSIDED), **lamp()), *TURNED),
    "glossy": (lambda: scene_of(sphere(12, **GLOSSY), **lamp()), *TURNED),
    "torus": (lambda: scene_of(torus(12, **REFLECTOR), fov=32, **lamp()), *TURNED),
    "dome": (lambda: scene_of(sheet(**TWOSIDED), fov=36, **lamp()), *TURNED),
    "alone-under-a-sky": (lambda: ball(**sky()), *TURNED),
    "many-lamps": (lambda: ball(**many_lamps()), *TURNED),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_lights(llvm, case):
    make, param, how = CASES[case]
    assert_right(make(), param, how)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("param, how", [TURNED, MOVED, ("wall.to_world", {"direction": (0, 0, 1)})],
                         ids=["turned", "moved", "wall-moved"])  # fmt: skip
def test_what_is_lit(llvm, param, how, form):
    """A ball that sees a bright wall, and no light: the indirect term."""
    assert_right(scene_of(sphere(12, **REFLECTOR), **lit_wall()), param, how, depth=3, form=form)


@pytest.mark.parametrize("budget, depth, form, lights", [
    ("sppd", 2, "spatial", lamp), ("sppd", 2, "spatial", sky), ("sppi", 3, "spatial", lit_wall),
    ("sppi", 3, "material", lit_wall),
], ids=["lamp", "sky", "wall-spatial", "wall-material"])  # fmt: skip
def test_backward_mode(llvm, budget, depth, form, lights):
    budgets = {other: int(other == budget) for other in TERMS.values()}
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": depth, "form": form, **budgets})
    wJv, JTwv, w, Jv = adjoint_identity(ball(**lights()), POSITIONS, integrator)
    assert Jv > 0 and abs(wJv - JTwv) <= 1e-5 * w * Jv


def edges_of_direct(segments: int) -> tuple[int, int]:
    """Rows that the direct term samples, and a mesh's faces."""
    scene = scene_of(sphere(segments, **REFLECTOR), **lamp())
    plan = make_plan(scene, POSITIONS, integrator={"type": "psdr_path", "max_depth": 2, "sppd": 1})
    return plan.term("direct").edges.total, scene.shapes()[0].face_count()


def test_fine_meshes_have_none(llvm):
    """Rows are edges (1.5 a face), shading outlines (1), and horizons (1) where normals are far off their faces."""
    for segments, coarse in ((16, True), (64, False)):
        total, faces = edges_of_direct(segments)
        assert (total > 3 * faces) == coarse, (total, faces)
