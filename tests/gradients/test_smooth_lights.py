"""Light of smooth-shaded meshes, which Mitsuba samples as if their faces were turned as their normals are.

The reference integrates Mitsuba's own rule on a floor, face by face (`paths/smooth_lights.py` has it), in double
precision and without a renderer, and takes central differences of the mean over a square.
"""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, fd, forward
from test_smooth_meshes import smooth_mesh
from variants import also

from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain

HEIGHT, RADIUS, ALBEDO = 0.8, 0.5, 0.5
SQUARE = (0.7, 1.1)  # of the floor, in x and y [m]
SEEN_FROM = 9.0
STEP = 0.02
CELLS = 90  # of the square, along a side: a point in each

#: An octahedron, turned so that no plane of a face is parallel to the axes. Its normals are 55 degrees off its faces.
CORNERS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
TURN = np.linalg.qr(np.array([[1, 0.3, 0.2], [-0.2, 1, 0.4], [0.1, -0.5, 1.0]]))[0]


def corners() -> tuple[np.ndarray, np.ndarray]:
    """Positions and normals."""
    n = CORNERS @ (TURN * np.sign(np.linalg.det(TURN))).T
    return RADIUS * n + [0, 0, HEIGHT], n


def scene(material: dict | None = None, **others: object) -> mi.Scene:
    """The floor under the octahedron, and `others`; the sensor sees the square from straight above."""
    p, n = corners()
    middle = sum(SQUARE) / 2
    half = (SQUARE[1] - SQUARE[0]) / 2
    film = {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    above = mi.ScalarTransform4f().look_at([middle, middle, SEEN_FROM], [middle, middle, 0], [0, 1, 0])
    camera = {"type": "orthographic", "to_world": above.scale([half, half, 1]), "film": film}
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": material or diffuse}
    lamp = smooth_mesh(p, n, FACES, emitter={"type": "area", "radiance": {"type": "rgb", "value": 1.0}})
    return mi.load_dict({"type": "scene", "floor": floor, "lamp": lamp, "camera": camera, **others}, optimize=False)


def radiance(x: np.ndarray, p: np.ndarray, n: np.ndarray, points: int = 10) -> np.ndarray:
    """What the floor sends up at `x` (N, 2), one bounce: midpoints of `points`² parts of every face."""
    k = (np.arange(points) + 0.5) / points
    u, v = (a.ravel() for a in np.meshgrid(k, k))
    s = np.sqrt(u)
    b = np.stack([1 - s, s * (1 - v), s * v], -1)
    a, c, d = (p[FACES[:, i]] for i in range(3))
    n_g = np.cross(c - a, d - a)
    area = np.linalg.norm(n_g, axis=1) / 2
    n_g /= 2 * area[:, None]
    total = np.zeros(len(x))
    for face in range(len(FACES)):
        y, n_s = b @ p[FACES[face]], b @ n[FACES[face]]
        n_s /= np.linalg.norm(n_s, axis=1, keepdims=True)
        to = np.concatenate([x, np.zeros((len(x), 1))], 1)[:, None] - y
        r2 = (to**2).sum(-1)
        ω = to / np.sqrt(r2)[..., None]
        seen = (ω[:, :1] @ n_g[face] > 0) & (ω[..., 2] < 0)
        cos_g, cos_s = np.maximum(ω @ n_g[face], 0), np.maximum((ω * n_s).sum(-1), 0)
        p_b = -ω[..., 2] / np.pi
        p_e = r2 / (area.sum() * np.maximum(cos_s, 1e-9))
        value = (p_b**2 * cos_g + p_e**2 * cos_s) / (p_b**2 + p_e**2) * p_b / r2
        total += np.where(seen & (cos_s > 0), value, 0).mean(1) * area[face]
    return ALBEDO * total


def points() -> np.ndarray:
    """Of the square, (N, 2): planes of faces pass through it, so that a regular grid would not do."""
    corner = np.stack(np.meshgrid(np.arange(CELLS), np.arange(CELLS)), -1).reshape(-1, 2)
    u = (corner + np.random.default_rng(0).random(corner.shape)) / CELLS
    return SQUARE[0] + (SQUARE[1] - SQUARE[0]) * u


def reference(pose: Callable[[float], tuple[np.ndarray, np.ndarray]]) -> float:
    """Derivative of the mean over the square where corners and normals are `pose(t)`."""
    x = points()
    ahead, back = (radiance(x, *pose(t)).mean() for t in (STEP, -STEP))
    return (ahead - back) / (2 * STEP)


def moved(axis: tuple[float, ...]) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    p, n = corners()
    return lambda t: (p + t * np.array(axis), n)


def turned(axis: tuple[float, ...]) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """About the middle of the body."""
    p, n = corners()

    def pose(t: float) -> tuple[np.ndarray, np.ndarray]:
        turn = np.array(mi.ScalarTransform4f().rotate(list(axis), np.degrees(t)).matrix)[:3, :3]
        return (p - [0, 0, HEIGHT]) @ turn.T + [0, 0, HEIGHT], n @ turn.T

    return pose


MOTIONS = [
    pytest.param(moved, {"direction": (0, 0, 1)}, id="up"),
    pytest.param(moved, {"direction": (1, 0, 0)}, id="aside", marks=pytest.mark.slow),
    pytest.param(turned, {"rotate": (0, 0, 1)}, id="turned", marks=pytest.mark.slow),
]


def rendered(how: dict, **options) -> np.ndarray:
    """The derivative of the mean, by seed."""
    motion = perturb(scene(), "lamp.vertex_positions", **how)
    spec = {"type": "psdr_path", "max_depth": 2, **options}
    return forward(motion, spec, 8, 4096).mean(axis=(1, 2)).ravel()


@pytest.mark.parametrize("form", [also("spatial"), "material"])
@pytest.mark.parametrize("kind, how", MOTIONS)
def test_a_floor_beneath(llvm, kind, how, form):
    """`direct` is 10 to 90 % of it: what is sent along the planes of faces."""
    expected = reference(kind(next(iter(how.values()))))
    found = rendered(how, form=form, sppc=4096, sppd=16384, sppp=0, sppi=0)
    error = found.std(ddof=1) / len(found) ** 0.5
    assert error < 0.03 * abs(expected)
    assert abs(found.mean() - expected) < 3.5 * error, (found.mean(), error, expected)


def test_the_model_is_mitsubas(llvm):
    """The reference integrates what `path` renders: 2 % more than the faces alone would send."""
    x = points()
    image = mi.render(scene(), integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=1 << 16)
    assert radiance(x, *corners()).mean() == pytest.approx(float(np.mean(image)), rel=2e-3)


def test_noise_stays_small(llvm):
    """Faces seen edge-on are met by few rays, of infinite variance once: spikes of 100 times the mean."""
    found = rendered({"direction": (0, 0, 1)}, sppc=512, sppd=0, sppp=0, sppi=0)
    assert found.std(ddof=1) < 0.1 * abs(found.mean())


@pytest.mark.parametrize("form", ["spatial", "material"])
def test_forward_and_backward_are_transposes(variant, form):
    rough = {"type": "roughconductor", "alpha": 0.3}
    spec = {"type": "psdr_path", "max_depth": 3, "form": form, "sppc": 64, "sppp": 64, "sppd": 64, "sppi": 64}
    ahead, back, w, Jv = adjoint_identity(scene(rough), "lamp.vertex_positions", mi.load_dict(spec))
    assert abs(ahead - back) < 1e-4 * w * Jv


@pytest.mark.slow
@pytest.mark.parametrize("how", [{"direction": (0, 0, 1)}, {"rotate": (1, 0, 0)}], ids=["up", "turned"])
def test_a_rough_floor(llvm, how):
    """Whose density depends on where the path goes on to."""
    motion = perturb(scene({"type": "roughconductor", "alpha": 0.3}), "lamp.vertex_positions", **how)
    spec = {"type": "psdr_path", "max_depth": 2, "sppc": 8192, "sppd": 1 << 17, "sppp": 0, "sppi": 0}
    differences = fd(motion, {"type": "path", "max_depth": 2}, 0.01, 64, 1 << 16)
    slope = gain(forward(motion, spec, 32, 8192), differences[0::2], differences[1::2])
    assert slope.stderr < 0.06
    assert abs(slope.value - 1) < 3 * slope.stderr + 0.01, slope


def assert_as_differences(motion, seeds: int, known: float) -> None:
    """By one bounce, all terms, against central differences: to 3 times what is to be `known` of the gain."""
    ours = forward(motion, {"type": "psdr_path", "max_depth": 2}, 8, 4096)
    differences = fd(motion, {"type": "path", "max_depth": 2}, STEP / 2, seeds, 4096)
    slope = gain(ours, differences[0::2], differences[1::2])
    assert slope.stderr < known
    assert abs(slope.value - 1) < 3 * known, slope


def from_aside() -> dict:
    """A sensor that sees the floor right beneath, where rays find as much of the light as its samples do."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "luminance"}
    view = mi.ScalarTransform4f().look_at([4, -0.5, 2.2], [0.55, 0.1, 0], [0, 0, 1])
    return {"type": "perspective", "fov": 12, "to_world": view, "film": film}


@pytest.mark.slow
def test_shadows(llvm):
    """Their steps are those of the image: samples of the light and rays that meet it. Samples alone were 1.6 % off."""
    card = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0.35, 0.1, 0.12]).scale(0.12)}
    motion = perturb(scene(camera=from_aside(), card=card), "card.to_world", (0.2, 1, 0))
    assert_as_differences(motion, 384, 0.004)


@pytest.mark.slow
def test_horizons_of_what_is_lit(llvm):
    """A body that is bent as much: its faces turn through the light. As if that shone as its faces are, 4.5 % off."""
    p, n = corners()
    body = smooth_mesh(0.3 * (p - [0, 0, HEIGHT]) + [0.65, 0.1, 0.15], n, FACES, bsdf={"type": "diffuse"})
    motion = perturb(scene(camera=from_aside(), body=body), "body.vertex_positions", np.eye(6)[:, 4:5] * [0.3, 0.2, 1])
    assert_as_differences(motion, 64, 0.008)
