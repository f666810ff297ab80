"""Steps inside surfaces: checkerboards, texels and faces of their own colours, moved, turned, and seen by a camera
that moves. Without their edges, gains are between 0.1 and 0.95.
"""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity, assert_grad_close, fd, forward, kernels_compiled

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain

slow = pytest.mark.slow
TOLERANCE, MAX_STDERR = 0.02, 0.01
STEP, TURN = 0.005, 0.002  # of finite differences [scene units, rad]: a twentieth of a pixel
TURNED_UV = {"turn": 25, "scale": (2.3, 1.7)}
MOVED, TURNED = {"direction": (1, 0, 0)}, {"rotate": (0.3, 0.2, 1)}


def to_uv(turn: float = 0, scale: tuple = (1, 1), shift: tuple = (0, 0)):
    return mi.ScalarTransform4f().translate([*shift, 0]).rotate([0, 0, 1], turn).scale([*scale, 1])


def checkerboard(cells: float = 6) -> dict:
    return {"type": "checkerboard", "to_uv": to_uv(scale=(cells / 2, cells / 2))}


def texels(height: int = 5, width: int = 3, mode: str = "repeat", **transform) -> dict:
    data = np.random.default_rng(0).random((height, width, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest", "wrap_mode": mode,
            "to_uv": to_uv(**transform)}  # fmt: skip


def scene_of(thing, eye: tuple = (0.3, -3, 2.5), target: tuple = (0, 0, 0), fov: float = 30, **others) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    pose = mi.ScalarTransform4f().look_at(origin=eye, target=target, up=[0, 0, 1])
    camera = {"type": "perspective", "fov": fov, "to_world": pose, "film": film}
    lamp = {"type": "point", "position": [1, -2, 4], "intensity": 40.0}
    return mi.load_dict({"type": "scene", "thing": thing, "camera": camera, "lamp": lamp, **others}, optimize=False)


def painted(texture: dict, plugin: str = "rectangle", size: float = 1) -> dict:
    bsdf = {"type": "twosided", "of": {"type": "diffuse", "reflectance": texture}}
    return {"type": plugin, "bsdf": bsdf, "to_world": mi.ScalarTransform4f().scale(size)}


def sheet(texture: dict, uv, segments: int = 2, colours: bool = False) -> mi.Mesh:
    """A bent sheet of `segments`² · 2 faces; `uv(p)`: texture coordinates at (V, 2) points of [−1, 1]², or None."""
    g = np.linspace(-1, 1, segments + 1)
    x, y = (a.ravel() for a in np.meshgrid(g, g, indexing="ij"))
    points = np.stack([x, y, 0.15 * np.sin(2 * x) + 0.1 * y * y], -1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(segments), np.arange(segments), indexing="ij"))
    a = i * (segments + 1) + j
    b, c, d = a + segments + 1, a + segments + 2, a + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(painted(texture)["bsdf"])
    mesh = mi.Mesh("thing", len(points), len(faces), has_vertex_texcoords=uv is not None, props=props)
    if colours:
        mesh.add_attribute("face_color", 3, np.random.default_rng(1).random(3 * len(faces)).astype(np.float32))
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = points.ravel().astype(np.float32), faces.ravel().astype(np.uint32)
    if uv is not None:
        params["vertex_texcoords"] = uv(points[:, :2]).ravel().astype(np.float32)
    params.update()
    return mesh


def assert_gain(scene: mi.Scene, param: str, how: dict, seeds: int = 8, spp: int = 1024, **options):
    motion = perturb(scene, param, **how)
    spec = {"type": "psdr_path", "max_depth": 2, **options}
    reference = fd(motion, spec, STEP if "direction" in how else TURN, 4 * seeds, 2 * spp)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slope = gain(forward(motion, spec, seeds, spp), reference[0::2], reference[1::2])
    assert slope.stderr < MAX_STDERR, slope
    assert abs(slope.value - 1) < TOLERANCE + 2 * slope.stderr, slope


@pytest.mark.slow
def test_a_crop_window_sees_the_same_steps(llvm):
    """The camera is farther away than the film has pixels: depths must not be taken for places on the film."""
    scenes = (mi.load_dict(crop_scene(crop), optimize=False) for crop in ({}, CROP))
    spec = {"type": "psdr_path", "max_depth": 1}
    whole, part = (forward(perturb(scene, "thing.to_world", **MOVED), spec, 8, 64) for scene in scenes)
    x, y = CROP["crop_offset_x"], CROP["crop_offset_y"]
    assert_grad_close(part, whole[:, y : y + CROP["crop_height"], x : x + CROP["crop_width"]])


CROP = {"crop_offset_x": 2, "crop_offset_y": 6, "crop_width": 5, "crop_height": 4}


def crop_scene(crop: dict) -> dict:
    film = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}, **crop}
    pose = mi.ScalarTransform4f().look_at(origin=[0.3, -3, 2.5], target=[0, 0, 0], up=[0, 0, 1])
    floor = {"type": "rectangle", "emitter": {"type": "area", "radiance": checkerboard(12)}}
    camera = {"type": "perspective", "fov": 30, "to_world": pose, "film": film}
    return {"type": "scene", "thing": floor, "camera": camera}


@pytest.mark.parametrize("texture, param, how", [
    pytest.param(checkerboard, "thing.to_world", MOVED, id="checkerboard-moved", marks=slow),
    pytest.param(checkerboard, "thing.to_world", TURNED, id="checkerboard-turned", marks=slow),
    pytest.param(checkerboard, "camera.to_world", {"rotate": (0, 0, 1)}, id="checkerboard-camera-turned", marks=slow),
    pytest.param(checkerboard, "camera.x_fov", {"direction": 5.0}, id="checkerboard-zoomed", marks=slow),
    pytest.param(texels, "thing.to_world", MOVED, id="texels-moved", marks=slow),
    pytest.param(texels, "camera.to_world", MOVED, id="texels-camera-moved", marks=slow),
])  # fmt: skip
def test_a_plane(llvm, texture, param, how):
    assert_gain(scene_of(painted(texture())), param, how)


@slow
@pytest.mark.parametrize("mode", ["repeat", "mirror", "clamp"])
def test_turned_texture_coordinates(llvm, mode):
    """They leave the unit square on all sides."""
    texture = texels(4, 3, mode, turn=25, scale=(2.3, 1.7), shift=(-0.4, -0.6))
    assert_gain(scene_of(painted(texture)), "thing.to_world", TURNED)


@slow
@pytest.mark.parametrize("plugin, size", [("sphere", 1), ("cylinder", 0.7), ("disk", 2)])
@pytest.mark.parametrize("texture, how", [
    pytest.param(lambda: texels(6, 7, **TURNED_UV), TURNED, id="texels-turned"),
    pytest.param(lambda: checkerboard(8), MOVED, id="checkerboard-moved"),
])  # fmt: skip
def test_shapes_without_triangles(llvm, plugin, size, texture, how):
    """The disk is larger than the picture."""
    assert_gain(scene_of(painted(texture(), plugin, size)), "thing.to_world", how, spp=2048)


MAPS = {
    "as-it-is": lambda p: (p + 1) / 2,
    "folded": np.abs,  # four quarters share the coordinates, two of them mirrored
    "outside": lambda p: p * [1.7, -2.3] - [1.3, 0.4],
    "skewed": lambda p: p @ [[0.9, 0.4], [-0.5, 1.1]] + 0.1 * np.sin(5 * p),
    "none": None,  # every face has the whole unit square
}


@pytest.mark.parametrize("name", [pytest.param(m, marks=slow) for m in MAPS])
def test_a_mesh(llvm, name):
    mesh = sheet(texels(3, 5, "mirror"), MAPS[name], 2 if name in ("folded", "none") else 3)
    assert_gain(scene_of(mesh), "thing.vertex_positions", TURNED)


@slow
def test_lines_along_edges_of_a_mesh(llvm):
    """Every other line of the checkerboard is one: it counts once."""
    assert_gain(scene_of(sheet(checkerboard(8), MAPS["as-it-is"], 4)), "thing.vertex_positions", MOVED)


@slow
def test_faces_of_their_own_colours(llvm):
    mesh = sheet({"type": "mesh_attribute", "name": "face_color"}, None, 3, colours=True)
    assert_gain(scene_of(mesh), "thing.vertex_positions", MOVED)


def patchwork(lookup: str, emits: bool = False) -> mi.Mesh:
    """A flat sheet of 3 × 3 squares that share no vertices: each has its own place in a smooth bitmap, or own colours.

    Nothing but texture coordinates (`lookup` is "bitmap") or colours (it is "vertex_color") steps between them. The
    places do not overlap.
    """
    n, rng = 3, np.random.default_rng(2)
    squares = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), -1).reshape(-1, 1, 2)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    flat = ((squares + corners) * 2 / n - 1).reshape(-1, 2)
    faces = (4 * np.arange(n * n)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    smooth = {**texels(4, 4), "filter_type": "bilinear"}
    texture = smooth if lookup == "bitmap" else {"type": "mesh_attribute", "name": lookup}
    props, owner = mi.Properties(), painted(texture)["bsdf"]
    if emits:
        owner = {"type": "area", "radiance": texture}
    props["of"] = mi.load_dict(owner)
    mesh = mi.Mesh("thing", len(flat), len(faces), has_vertex_texcoords=True, props=props)
    mesh.add_attribute("vertex_color", 3, rng.random(3 * len(flat)).astype(np.float32))
    params, place = mi.traverse(mesh), rng.permutation(squares[:, 0])[:, None]
    places = (place + 0.9 * corners) / n
    params["vertex_positions"] = np.concatenate([flat, np.zeros((len(flat), 1))], 1).ravel().astype(np.float32)
    params["vertex_texcoords"], params["faces"] = places.ravel().astype(np.float32), faces.ravel().astype(np.uint32)
    params.update()
    return mesh


@pytest.mark.parametrize("lookup, param, how", [
    pytest.param("vertex_color", "thing.vertex_positions", MOVED, id="colours-moved"),
    pytest.param("bitmap", "thing.vertex_positions", MOVED, marks=slow, id="bitmap-moved"),
    pytest.param("vertex_color", "camera.to_world", {"rotate": (1, 0, 0.5)}, marks=slow, id="colours-camera-turned"),
    pytest.param("bitmap", "camera.to_world", {"rotate": (1, 0, 0.5)}, marks=slow, id="bitmap-camera-turned"),
])  # fmt: skip
def test_seams_inside_a_plane(llvm, lookup, param, how):
    assert_gain(scene_of(patchwork(lookup)), param, how, seeds=4, spp=512)


@slow
@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("lookup", ["vertex_color", "bitmap"])
def test_seams_inside_a_plane_seen_in_a_mirror(llvm, lookup, form):
    view = {"eye": (0.3, -1.5, 1.2), "target": (0, 1.2, 0.85), "fov": 35}
    mirror = glossy_wall() | {"bsdf": {"type": "conductor"}}
    scene = scene_of(patchwork(lookup), **view, wall=mirror)
    assert_gain(scene, "thing.vertex_positions", MOVED, spp=2048, max_depth=3, form=form)


@slow
def test_seams_inside_a_light(llvm):
    """It is seen, and lights a floor close to it; squares do not overlap in the texture, of which Mitsuba takes one."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.3]).scale(3)}
    light = patchwork("bitmap", emits=True)
    params = mi.traverse(light)
    params["faces"] = mi.UInt32(np.array(params["faces"]).reshape(-1, 3)[:, ::-1].ravel())  # turned towards the floor
    params.update()
    scene = scene_of(light, eye=(0.3, -3, 0.5), target=(0, 0, -0.3), floor=floor)
    assert_gain(scene, "thing.vertex_positions", {"direction": (0.5, 0.3, 0.2)}, spp=2048)


@slow
def test_a_light_with_texels(llvm):
    light = {"type": "rectangle", "emitter": {"type": "area", "radiance": texels()}}
    assert_gain(scene_of(light), "thing.to_world", MOVED, max_depth=1)


def bumpy(plugin: str, depth: float, size: float) -> dict:
    data = np.random.default_rng(1).random((5, 7, 1)).astype(np.float32)
    heights = {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "to_uv": to_uv(**TURNED_UV)}
    bsdf = {"type": "bumpmap", "heights": heights, "scale": depth, "of": {"type": "diffuse"}}
    return {"type": plugin, "bsdf": bsdf, "to_world": mi.ScalarTransform4f().scale(size)}


@pytest.mark.parametrize("thing, param, how", [
    pytest.param(("rectangle", 0.05, 2.5), "thing.to_world", MOVED, marks=slow, id="moved"),
    pytest.param(("rectangle", 0.05, 2.5), "camera.to_world", {"rotate": (0, 0, 1)}, marks=slow, id="camera-turned"),
    pytest.param(("sphere", 0.1, 1), "thing.to_world", MOVED, marks=slow, id="sphere"),
])  # fmt: skip
def test_the_slopes_of_a_bump_map(llvm, thing, param, how):
    """They step at texel centres; without these lines the gains are 0.006, 0.78 and 0.98."""
    assert_gain(scene_of(bumpy(*thing)), param, how)


def glossy_wall() -> dict:
    pose = mi.ScalarTransform4f().translate([0, 1.2, 0.5]).rotate([1, 0, 0], 90)
    bsdf = {"type": "twosided", "of": {"type": "roughconductor", "alpha": 0.12}}
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf}


@slow
@pytest.mark.parametrize("param, how", [
    ("thing.to_world", MOVED), ("wall.to_world", {"rotate": (1, 0, 0.5)}), ("camera.to_world", {"rotate": (1, 0, 0.5)}),
], ids=["moved", "wall-turned", "camera-turned"])  # fmt: skip
@pytest.mark.parametrize("form", ["spatial", "material"])
def test_seen_by_way_of_a_glossy_wall(llvm, form, param, how):
    view = {"eye": (0.3, -1.5, 1.2), "target": (0, 1.2, 0.85), "fov": 35}
    scene = scene_of(painted(checkerboard()), **view, wall=glossy_wall())
    assert_gain(scene, param, how, spp=4096, max_depth=3, form=form)


@slow
@pytest.mark.parametrize("camera", ["thinlens", "orthographic"])
def test_other_cameras(llvm, camera):
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    pose = mi.ScalarTransform4f().look_at(origin=[0.3, -3, 2.5], target=[0, 0, 0], up=[0, 0, 1])
    lens = {"to_world": pose, "fov": 30, "aperture_radius": 0.1, "focus_distance": 3.0}
    if camera == "orthographic":
        lens = {"to_world": pose @ mi.ScalarTransform4f().scale([0.9, 0.9, 1])}
    lamp = {"type": "point", "position": [1, -2, 4], "intensity": 40.0}
    lens |= {"type": camera, "film": film}
    scene = mi.load_dict({"type": "scene", "thing": painted(texels()), "camera": lens, "lamp": lamp}, optimize=False)
    assert_gain(scene, "thing.to_world", MOVED)


@slow
@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("plugin, param", [
    ("rectangle", "thing.to_world"),
    ("sphere", "thing.to_world"),
    ("cube", "thing.vertex_positions"),
])  # fmt: skip
def test_forward_and_backward_mode_are_transposes(llvm, plugin, param, form):
    scene = scene_of(painted(texels(), plugin, 0.6), wall=glossy_wall())
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3, "form": form})
    wJv, JTwv, w, Jv = adjoint_identity(scene, param, integrator)
    assert Jv > 0 and abs(wJv - JTwv) <= 1e-5 * w * Jv


def test_later_calls_compile_nothing(llvm):
    scene = scene_of(painted(texels(40, 50)))
    motion = perturb(scene, "thing.to_world", **MOVED)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3, "form": "spatial"})
    compiled = kernels_compiled(motion, integrator)
    assert compiled[0] > 0 and not any(compiled[4:]), compiled
