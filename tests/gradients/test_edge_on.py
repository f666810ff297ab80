"""Faces exactly in line with the viewer or the light: rounding must not decide which of their edges is the outline.

Under parallel projection two edges of such a face cover each other, before and after the box has moved.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from fuzz.build import build
from helpers import assert_grad_close, fd, forward
from variants import also

from benchmarks import meshes
from benchmarks.check_lists.caustics import UP
from benchmarks.check_lists.caustics import scene as below_a_lamp
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.sampler import DerivativeSampler

SPEC = {"type": "psdr_path", "max_depth": 2}
DIRECTION = (1, 0.3, 0.7)
STEP = 0.01  # of finite differences: less than a tenth of a pixel
FURTHER = 1e-4  # past the position at which a face is in line: far beyond rounding, not to be seen in an image
CENTRE, HALF = np.array([0.03, 0.02, 0]), np.array([0.5, 0.4, 0.6])  # of the box
QUICK = {"samples": 32, "max_stderr": 0.02}  # a wrong side of the box is off by more
RIGHT, LEFT = CENTRE[0] + HALF[0], CENTRE[0] - HALF[0]


def T():
    return mi.ScalarTransform4f()


def film() -> dict:
    return {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}


def orthographic(axis, angle) -> dict:
    """Along an axis, up to the rounding of sine and cosine."""
    return {"type": "orthographic", "to_world": T().rotate(axis, angle).translate([0, 0, -4]), "film": film()}


def perspective(origin, target) -> dict:
    pose = T().look_at(origin=list(origin), target=list(target), up=[0, 1, 0])
    return {"type": "perspective", "fov": 30, "to_world": pose, "film": film()}


def scene_of(camera: dict, shift: float = 0.0, **objects) -> mi.Scene:
    """The box, moved along x by `shift`; by default under two lamps that light all but its lower and far side."""
    pose = T().translate(list(CENTRE + [shift, 0, 0])).scale(list(HALF))
    objects.setdefault("box", {"type": "cube", "to_world": pose, "bsdf": {"type": "diffuse"}})
    if "lamp" not in objects:
        objects["lamp"] = {"type": "point", "position": [-3, 2, 4], "intensity": 30.0}
        objects["fill"] = {"type": "point", "position": [4, 3, 1], "intensity": 15.0}
    return mi.load_dict({"type": "scene", "camera": camera, **objects}, optimize=False)


def open_box() -> mi.Mesh:
    """The box without its face at +z."""
    corners = CENTRE + HALF * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4)]
    faces = np.array([t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))])
    return meshes.flat_mesh("box", corners, faces, mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse"}}))


def assert_right(scene: mi.Scene, samples: int = 256, max_stderr: float = 0.007):
    """Derivatives of the moving box are those of finite differences, up to 1 %."""
    motion = perturb(scene, "box.vertex_positions", DIRECTION)
    reference = fd(motion, SPEC, STEP, 64, 8 * samples)
    gain, error = assert_grad_close(forward(motion, SPEC, 16, samples), reference, max_stderr)
    assert abs(gain - 1) < 0.01 + error


def assert_alike(scene: mi.Scene, nearby: mi.Scene):
    """One derivative where a face is in line, as the limit of where it is not.

    The face appears on one side only: finite differences would mix two derivatives.
    """
    image, other = (
        forward(perturb(s, "box.vertex_positions", DIRECTION), SPEC, 4, 1024).mean(0) for s in (scene, nearby)
    )
    assert np.linalg.norm(image - other) < 0.01 * np.linalg.norm(other)


@pytest.mark.parametrize(
    "axis, angle, precision",
    [
        pytest.param((0, 1, 0), 90, QUICK, marks=pytest.mark.slow),
        pytest.param((0, 1, 0), 90, {}, marks=pytest.mark.slow),
        pytest.param((0, 1, 0), 180, {}, marks=pytest.mark.slow),
        pytest.param((1, 0, 0), 90, {}, marks=pytest.mark.slow),
    ],
)
def test_a_box_seen_along_its_faces(llvm, axis, angle, precision):
    assert_right(scene_of(orthographic(axis, angle)), **precision)


@pytest.mark.slow
@pytest.mark.parametrize("x, y", [(RIGHT, 0.3), (RIGHT, 1.3), (LEFT, 0.3)])
def test_a_perspective_camera_in_the_plane_of_a_face(llvm, x, y):
    """The face turns away: the derivative is that of the box a little further, when the face has turned indeed."""
    camera = perspective((x, y, 4), (x / 2, 0, 0))
    assert_alike(scene_of(camera), scene_of(camera, FURTHER * np.sign(x)))


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_face_that_is_barely_seen(llvm, smooth):
    """A ball one face of which turns to the viewer by 2e-5: lines of sight to its far side are as good as in its plane.

    A random scene, of which all is left out that does not matter.
    """
    place, axis = np.array([0.398, 0.144, 0.618]), [-0.411, -0.744, -0.527]
    images = []
    for shift in (0.0, 10 * FURTHER):
        pose = [["translate", list(place + [0, shift, 0])], ["rotate", axis, 49.1], ["scale", 0.505]]
        ball = {"type": "mesh", "mesh": "ball", "segments": 16, "smooth": smooth, "to_world": pose}
        view = {"type": "perspective", "fov": 41.4, "film": film() | {"rfilter": {"type": "box"}},
                "to_world": [["look_at", [-0.871, 1.976, 3.367], [0.195, 0.3, 0], [0, 1, 0]]]}  # fmt: skip
        scene = build({"type": "scene", "camera": view, "ball": ball | {"emitter": {"type": "area"}}})
        motion = perturb(scene, "camera.to_world", rotate=(-0.209, 0.603, 0.77))
        images.append(forward(motion, SPEC, 4, 256).mean(0))
    assert np.linalg.norm(images[0] - images[1]) < 0.02 * np.linalg.norm(images[1])


def test_a_face_that_parallel_rays_meet_nearly_edge_on(llvm):
    """It is a thousandth of a pixel of other films, where what changes along it is a step; here it fills the film.

    Tilted by a slope against the rays and lit by a lamp at unit distance, it shows I ρ / (π r³) at x = slope · z.
    """
    slope, height, half_film = 3e-4, -0.3, 1e-4
    corners = np.array([[slope * z, y, z] for z in (-0.5, 0.5) for y in (-1e-3, 1e-3)])
    sheet = meshes.flat_mesh("sheet", corners, np.array([[0, 1, 3], [0, 3, 2]]), mi.load_dict({"type": "diffuse"}))
    pose = T().translate([0, 0, -4]).scale([half_film, half_film, 1])
    camera = {"type": "orthographic", "to_world": pose, "film": film() | {"rfilter": {"type": "box"}}}
    lamp = {"type": "point", "position": [1, 0, height], "intensity": 10.0}
    scene = mi.load_dict({"type": "scene", "camera": camera, "sheet": sheet, "lamp": lamp}, optimize=False)
    estimate = forward(perturb(scene, "sheet.vertex_positions", (1, 0, 0)), SPEC | {"form": "spatial"}, 8, 256)
    x = np.linspace(half_film, -half_film, 17)  # the camera's x axis points the other way
    radiance = 10 * 0.5 / np.pi * (1 + (x / slope - height) ** 2) ** -1.5
    exact = -np.diff(radiance) / np.diff(x)
    # Places on the film are rounded: rays begin 4 units away.
    assert_grad_close(estimate, np.tile(exact[None, :, None], (16, 1, 1)), 0.015, 0.006)


@pytest.mark.slow
def test_the_inside_of_an_open_box(llvm):
    """Its walls are borders seen edge-on, and the edges at its bottom the outline; nothing hides them."""
    assert_right(scene_of(orthographic((0, 1, 0), 180), box=open_box()))


@pytest.mark.slow
@pytest.mark.parametrize("lamp", ["sun", "point"])
def test_the_shadow_of_a_box_lit_along_its_faces(llvm, lamp):
    lamps = {
        "sun": {"type": "directional", "to_world": T().rotate([0, 1, 0], 180)},
        "point": {"type": "point", "position": [RIGHT, 0.3, 4], "intensity": 20.0},
    }
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -1.5]).scale(4), "bsdf": {"type": "diffuse"}}
    camera = perspective((3, 2, 4), (0, 0, -1.2))
    scene, nearby = (scene_of(camera, shift, lamp=lamps[lamp], floor=floor) for shift in (0.0, FURTHER))
    if lamp == "sun":
        assert_right(scene)
    else:
        assert_alike(scene, nearby)


@pytest.mark.parametrize("lean", [also(-20), -5, also(0), also(20)])
def test_the_foot_of_a_box_lit_along_its_faces(llvm, lean):
    """The shadow of a face ends where the face cuts into the floor: camera rays see one step there, not two.

    The light turns past the plane of the face, which overhangs, stands upright or leans back.
    """
    camera = perspective((4, 1.5, 1), (0.7, 0, 0))
    floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(3), "bsdf": {"type": "diffuse"}}
    box = {"type": "cube", "to_world": T().rotate([0, 0, 1], lean).scale([0.5, 0.5, 0.4]), "bsdf": {"type": "diffuse"}}
    images = []
    for aside in (-FURTHER, FURTHER):
        sun = T().rotate([0, 0, 1], lean + np.rad2deg(aside)).rotate([1, 0, 0], 90 + 20)
        lamp = {"type": "directional", "to_world": sun}
        scene = scene_of(camera, box=box, floor=floor, lamp=lamp)
        images.append(forward(perturb(scene, "camera.to_world", DIRECTION), SPEC, 4, 256).mean(0))
    assert np.linalg.norm(images[0] - images[1]) < 0.01 * np.linalg.norm(images[1])


@pytest.mark.slow
@pytest.mark.parametrize("heights", [(0.0, -1e-3), (4e-4, 2e-3)])
def test_a_face_of_a_mirror_that_is_barely_seen(llvm, heights):
    """Where it turns away and where it mirrors its own inside lie next to each other; in line, it has neither."""
    vertices, faces = meshes.ball(8, 16)
    corners = vertices[faces[len(faces) // 2 + 5]]
    n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    n /= np.linalg.norm(n)
    images = []
    for height in heights:
        eye = corners.mean(0) + 4 * np.cross(n, [0, 1, 0]) + height * n
        ball = meshes.smooth_mesh("box", vertices, faces, mi.load_dict({"type": "conductor"}))
        camera = perspective(eye, corners.mean(0)) | {"fov": 12}
        description = {"type": "scene", "camera": camera, "box": ball, "sky": {"type": "constant"}}
        scene = mi.load_dict(description, optimize=False)
        images.append(forward(perturb(scene, "box.vertex_positions", DIRECTION), SPEC, 8, 512).mean(0))
    assert np.linalg.norm(images[0] - images[1]) < 0.05 * np.linalg.norm(images[1])


def test_light_that_passes_along_an_outline_is_no_outlier(llvm):
    """Light met the ball at a cosine of 4e-7, which had one pixel at 2094 where none is above 4."""
    ball = {"type": "roughconductor", "alpha": 0.05, "distribution": "ggx"}
    motion = perturb(below_a_lamp("ball", ball, "spot"), "floor.to_world", UP)
    interior = {"form": "spatial", "sppc": 4, "sppp": 0, "sppd": 0, "sppi": 0}
    spec = {"type": "psdr_bdpt", "max_depth": 5, "rr_depth": 1000, **interior}
    assert np.abs(DerivativeSampler(motion, integrator_specs.build(spec), 0, 64).render(23)).max() < 20
