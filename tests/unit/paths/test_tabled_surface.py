"""Surfaces by tables are Mitsuba's: values, tangents, adjoints, of all kinds of meshes and spheres, moving or not."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from benchmarks import meshes
from psdr_jit.core.ad import tangents
from psdr_jit.core.memory import Memory
from psdr_jit.paths.tabled_surface import tabled_surface
from psdr_jit.scene.mesh_tables import KEPT, TABLES, mesh_tables

pytestmark = pytest.mark.usefixtures("llvm")

LANES = 20_000
FLOOR, CHARTED, BALL = "floor.to_world", "charted.vertex_texcoords", "ball.vertex_positions"
ORB, MARBLE = "orb.to_world", "marble.to_world"
#: What moves: nothing, poses, texture coordinates, vertices with the normals that follow them, several at once.
MOTIONS = {"rests": (), "pose": (FLOOR,), "chart": (CHARTED,), "smooth": (BALL,), "flat": ("cube.vertex_positions",),
           "sphere": (ORB,), "several": (BALL, FLOOR, "charted.vertex_positions", CHARTED, ORB, MARBLE)}  # fmt: skip


def tetrahedron(name: str, x: float, textured: bool) -> mi.Mesh:
    mesh = mi.Mesh(name, 4, 4, has_vertex_texcoords=textured)
    params = mi.traverse(mesh)
    points = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0, 0.5, 0], [0, 0, 1]]) + (x, 0, 0.1)
    params["vertex_positions"] = points.astype(np.float32).ravel()
    params["faces"] = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.uint32).ravel()
    if textured:  # one face has no area in texture space
        params["vertex_texcoords"] = np.array([[0, 0], [1, 0], [2, 0], [0.3, 0.8]], np.float32).ravel()
    params.update()
    return mesh


def scene_of() -> mi.Scene:
    T = mi.ScalarTransform4f()
    grey = mi.load_dict({"type": "diffuse"})
    return mi.load_dict({
        "type": "scene", "camera": {"type": "perspective"},
        "floor": {"type": "rectangle", "to_world": T.rotate([0, 1, 0], 8).scale([3, 2, 1])},
        "lamp": {"type": "rectangle", "flip_normals": True, "emitter": {"type": "area"},
                 "to_world": T.translate([0, 0, 2]).rotate([1, 0, 0], 50).scale(0.5)},
        "ball": meshes.smooth_mesh("ball", *meshes.ball(8, 12), grey),
        "orb": {"type": "sphere", "to_world": T.translate([0.6, 1, 0.8]).rotate([0.6, 0, 0.8], 50).scale(0.4)},
        "marble": {"type": "sphere", "radius": 0.3, "center": [-0.7, -0.9, 0.5], "flip_normals": True},
        "bare": tetrahedron("bare", -2, False), "charted": tetrahedron("charted", -1.2, True),
        "cube": {"type": "cube", "face_normals": True, "flip_normals": True,
                 "to_world": T.translate([1.6, 0, 0.5]).rotate([1, 1, 0], 30).scale(0.4)},
    }, optimize=False)  # fmt: skip


def rays(scene: mi.Scene) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
    rng = np.random.default_rng(0)
    d = rng.normal(size=(3, LANES)).astype(np.float32)
    target = rng.uniform(-1, 1, (3, LANES)) * np.array([[2.5], [1.5], [1.2]])
    o = mi.Point3f(*(5 * d / np.linalg.norm(d, axis=0)))
    ray = mi.Ray3f(o, dr.normalize(mi.Point3f(*target.astype(np.float32)) - o), 0, [])
    pi = scene.ray_intersect_preliminary(ray)
    dr.eval(ray, pi)
    return ray, pi


def put_in_motion(scene: mi.Scene, names: tuple[str, ...], tangent: bool) -> mi.SceneParameters:
    """Attached parameters, each with a tangent of its own if one is wanted."""
    params, rng, moved = mi.traverse(scene), np.random.default_rng(1), []
    for name in names:
        if name.endswith("to_world"):
            θ = mi.Float(0)
            dr.enable_grad(θ)
            turn = mi.Transform4f().translate([0.3 * θ, 0.1 * θ, -0.2 * θ]).rotate([0.8, 0.6, 0], 20 * θ)
            params[name] = turn @ params[name] @ mi.Transform4f().scale(1 + 0.2 * θ)
            given = θ
        else:
            given = mi.Float(params[name])
            dr.enable_grad(given)
            params[name] = given
        if tangent:
            dr.set_grad(given, mi.Float(rng.normal(size=dr.width(given)).astype(np.float32)))
        moved.append(given)
    params.update()
    if tangent and moved:
        dr.enqueue(dr.ADMode.Forward, moved)
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
    return params


def values_of(si: mi.SurfaceInteraction3f) -> list:
    return [si.t, si.p, si.n, si.uv, si.dp_du, si.dp_dv, si.wi, si.sh_frame.s, si.sh_frame.n]


def columns(values: list) -> list[np.ndarray]:
    return [np.atleast_2d(np.array(dr.detach(v))) + np.zeros((1, LANES)) for v in values]


def attached(ray: mi.Ray3f, moves: bool) -> mi.Ray3f:
    o, d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
    if moves:
        dr.enable_grad(o, d)
        dr.set_grad(o, mi.Vector3f(0.2, -0.1, 0.4))
        dr.set_grad(d, dr.cross(mi.Vector3f(-0.3, 0.2, 0.1), ray.d))
    return mi.Ray3f(o, d, 0, [])


def seen(names: tuple[str, ...], flags: int, ray_moves: bool, ours: bool) -> tuple[list, list, np.ndarray]:
    """`(values, tangents, where something was met)`. Mitsuba's calls reach scenes that are alive: none is left."""
    scene = scene_of()
    ray, pi = rays(scene)
    put_in_motion(scene, names, tangent=True)
    tables = mesh_tables(scene, Memory())
    assert bool(tables.in_motion()) == bool(names)
    for moving in tables.in_motion() if ours else ():
        moving.take_tangents()
    of_ray = attached(ray, ray_moves)
    si = tabled_surface(tables, pi, of_ray, flags) if ours else pi.compute_surface_interaction(of_ray, flags)
    assert dr.all(si.shape == pi.shape)
    values = values_of(si)
    speeds = tangents(*values) if names or ray_moves else [v * 0 for v in values]
    return columns(values), columns(speeds), np.array(pi.is_valid())


def both(names: tuple[str, ...], flags: int, ray_moves: bool) -> tuple[list, list, list, list, np.ndarray]:
    """`(values and tangents of ours, of Mitsuba's, where something was met)`."""
    own = seen(names, flags, ray_moves, True)[:2]
    gc.collect()
    return *own, *seen(names, flags, ray_moves, False)


@pytest.mark.parametrize("names", MOTIONS.values(), ids=MOTIONS)
@pytest.mark.parametrize("follow", [False, True], ids=["", "follow"])
@pytest.mark.parametrize("ray_moves", [False, True], ids=["", "ray"])
def test_all_that_is_known_of_a_place_is_mitsubas(names, follow, ray_moves):
    flags = mi.RayFlags.All | mi.RayFlags.FollowShape if follow else mi.RayFlags.All
    own, own_speed, known, speed, hit = both(names, flags, ray_moves)
    assert 0.5 < hit.mean() < 1
    for k, (a, b) in enumerate(zip(own, known, strict=True)):
        assert np.abs(a[:, hit] - b[:, hit]).max() < 2e-5 * np.abs(b[:, hit]).max(), k
        assert k == 0 or np.isfinite(a).all()
    for k, (a, b) in enumerate(zip(own_speed, speed, strict=True)):
        scale = 1 + np.abs(b[:, hit]).max(0)  # at grazing angles, all is large
        off = np.abs(a[:, hit] - b[:, hit]) / scale
        assert np.quantile(off, 0.999) < 1e-3 and off.max() < 1e-2, k
        assert np.isfinite(a[:, ~hit]).all()


def test_what_backward_mode_gathers_is_handed_on():
    """Adjoints of vertices, texture coordinates and a pose, as of Mitsuba's own."""
    gradients = []
    for ours in (True, False):
        gc.collect()
        scene = scene_of()
        ray, pi = rays(scene)
        names = MOTIONS["several"]
        params, given = mi.traverse(scene), []
        for name in names:
            given.append(mi.Float(0) if name.endswith("to_world") else mi.Float(params[name]))
            dr.enable_grad(given[-1])
            step = mi.Transform4f().translate([0.3 * given[-1], 0, -0.2 * given[-1]])
            params[name] = step @ params[name] if name.endswith("to_world") else given[-1]
        params.update()
        tables = mesh_tables(scene, Memory())
        si = tabled_surface(tables, pi, ray, mi.RayFlags.All) if ours else pi.compute_surface_interaction(ray)
        weight = mi.Float(np.random.default_rng(2).normal(size=LANES).astype(np.float32))
        value = dr.sum(dr.select(pi.is_valid(), weight * (si.p.x + si.uv.y + si.sh_frame.n.y + si.t), 0))
        dr.backward_from(value, flags=dr.ADFlag.ClearVertices)
        for moving in tables.in_motion() if ours else ():
            moving.hand_on()
        gradients.append([np.array(dr.grad(x)) for x in given])
    for a, b in zip(*gradients, strict=True):
        assert np.abs(b).max() > 0 and np.abs(a - b).max() < 1e-4 * np.abs(b).max()


def test_tables_are_made_again_only_when_a_resting_mesh_has_changed():
    scene, memory = scene_of(), Memory()
    first = mesh_tables(scene, memory)
    assert mesh_tables(scene, memory).faces is first.faces
    put_in_motion(scene, (BALL,), tangent=False)
    moving = mesh_tables(scene, memory)
    put_in_motion(scene, (BALL,), tangent=False)
    assert mesh_tables(scene, memory).faces is moving.faces
    params = mi.traverse(scene)
    params["bare.vertex_positions"] = mi.Float(params["bare.vertex_positions"]) + 1
    params.update()
    changed = mesh_tables(scene, memory)
    assert changed.faces is not moving.faces
    ray, pi = rays(scene)
    own, known = (columns(values_of(si)) for si in (
        tabled_surface(changed, pi, ray, mi.RayFlags.All), pi.compute_surface_interaction(ray)))  # fmt: skip
    assert np.abs(own[1] - known[1])[:, np.array(pi.is_valid())].max() < 1e-5


def test_few_tables_are_kept():
    memory, scenes = Memory(), [scene_of() for _ in range(KEPT + 2)]
    for scene in scenes:
        mesh_tables(scene, memory)
    assert len(memory[TABLES]) == KEPT


def test_other_shapes_are_left_to_mitsuba():
    scene = mi.load_dict({"type": "scene", "rod": {"type": "cylinder"}, "floor": {"type": "rectangle"}})
    assert mesh_tables(scene, Memory()) is None
