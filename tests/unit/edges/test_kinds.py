"""What `edges.kind` promises, checked for every kind of edge that the shipped scenes have."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from benchmarks import meshes
from psdr_jit.core.ad import tangents
from psdr_jit.core.low_discrepancy import lane_sampler
from psdr_jit.core.memory import Memory
from psdr_jit.derivative import integrator_specs
from psdr_jit.driver.prepare import prepare
from psdr_jit.edges.kind import ContourKind, EdgeKind, FixedKind, Sight, Use
from psdr_jit.edges.kind_analytic import AnalyticCurves
from psdr_jit.edges.kind_bent import BentOutlines
from psdr_jit.edges.kind_curve_pattern import RodPatterns, TubePatterns
from psdr_jit.edges.kind_ellipsoid import EllipsoidOutlines
from psdr_jit.edges.kind_grid import GridEdges
from psdr_jit.edges.kind_grid_shading import GridShadingOutlines
from psdr_jit.edges.kind_junction import Junctions
from psdr_jit.edges.kind_mesh import MeshEdges
from psdr_jit.edges.kind_mirror_horizon import MirrorHorizons
from psdr_jit.edges.kind_pattern import AnalyticPatterns, MeshPatterns
from psdr_jit.edges.kind_rod import RodEdges
from psdr_jit.edges.kind_shading import ShadingOutlines
from psdr_jit.edges.kind_tube import TubeOutlines
from psdr_jit.edges.scene_table import scene_edges
from psdr_jit.edges.table import traced
from psdr_jit.scene import io as scene_io
from psdr_jit.scene.params import also_enabled
from psdr_jit.scene.surfaces import surfaces_of

COUNT = 4096
RADIUS, DISTANCE = 0.6, 4.0
SHIFT = (0.48, 0.6, 0.64)
PLACED = ("vertex_positions", "to_world", "control_points", "data")
STRIDES = {"control_points": 4, "data": 10}


def mirror_ball() -> mi.Scene:
    """A smooth-shaded ball that mirrors a sky."""
    mesh = scene_io.shipped_scene("smooth_mesh.xml").parent / "meshes" / "smooth_sphere.obj"
    ball = {"type": "obj", "filename": str(mesh), "bsdf": {"type": "conductor"}}
    pose = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "to_world": pose}
    return mi.load_dict({"type": "scene", "ball": ball, "sky": {"type": "constant"}, "sensor": sensor}, optimize=False)


def blended_grid() -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene("grid_shadow.xml"), res=16, normals="smooth")


def bent_ball() -> mi.Scene:
    """A ball with a normal map."""
    bent = np.random.default_rng(1).uniform(0.3, 0.7, (5, 5, 3)).astype(np.float32) + np.array([0, 0, 0.3], np.float32)
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(bent), "raw": True}
    ball = {"type": "sphere", "bsdf": {"type": "normalmap", "normalmap": picture, "bsdf": {"type": "diffuse"}}}
    pose = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "to_world": pose}
    return mi.load_dict({"type": "scene", "ball": ball, "sky": {"type": "constant"}, "sensor": sensor}, optimize=False)


PLACES = {  # kind: a scene that has it, and what moves there
    MeshEdges: ("lit_box", ["box.vertex_positions"]),
    Junctions: ("sunk_box", ["box.vertex_positions", "floor.vertex_positions"]),
    AnalyticCurves: ("ball_shadow", ["blocker.to_world"]),
    ShadingOutlines: ("smooth_mesh", ["ball.vertex_positions"]),
    BentOutlines: (bent_ball, ["ball.to_world"]),
    MirrorHorizons: (mirror_ball, ["ball.vertex_positions"]),
    MeshPatterns: ("patterns", ["floor.to_world"]),
    AnalyticPatterns: ("patterns", ["ball.to_world"]),
    TubePatterns: ("painted_curves", ["spline.control_points"]),
    RodPatterns: ("painted_curves", ["rods.control_points"]),
    TubeOutlines: ("curve_shadow", ["blocker.control_points"]),
    RodEdges: ("rod_shadow", ["blocker.control_points"]),
    EllipsoidOutlines: ("ellipsoids_shadow", ["blocker.data"]),
    GridEdges: ("grid_shadow", ["blocker.to_world"]),
    GridShadingOutlines: (blended_grid, ["blocker.to_world"]),
}


def subclasses(base: type) -> set[type]:
    found = {c for child in base.__subclasses__() for c in {child, *subclasses(child)}}
    return {c for c in found if not getattr(c, "__abstractmethods__", None)}


def test_every_kind_is_looked_at():
    assert subclasses(EdgeKind) == set(PLACES)


@pytest.fixture(params=PLACES, ids=lambda kind: kind.__name__)
def found(request, llvm):
    """`(job, kind)`: a kind of edge in a scene where something moves."""
    name, moving = PLACES[request.param]
    if callable(name):
        scene = name()
    else:
        scene = scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), res=16)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3, "form": "spatial", "sppc": 1})
    with also_enabled(scene, [name for name in moving if name in set(mi.traverse(scene).keys())]):
        job = prepare(integrator.call(scene, scene.sensors()[0], 0, 1)).jobs[0][1]
        (kind,) = (k for k in scene_edges(job).kinds if isinstance(k, request.param))
    return job, kind


def lines(kind: EdgeKind, row: mi.UInt32, t: mi.Float, rng):
    """Random lines through edge points: `(OnEdge, ω)`."""
    if not isinstance(kind, (FixedKind, ContourKind)):
        line = kind.line(row, t, rng.next_2d(), None, mi.Bool(True))
        return line.on, line.ω
    ω = mi.warp.square_to_uniform_sphere(rng.next_2d())
    return kind.on(row, t, mi.Vector4f(-ω.x, -ω.y, -ω.z, 0), mi.Bool(True)), ω


def rows_of(kind: EdgeKind, seed: int = 1, count: int = COUNT):
    rng = lane_sampler(mi.UInt32(seed), dr.arange(mi.UInt32, count))
    row = mi.UInt32(rng.next_1d() * kind.count)
    return row, rng.next_1d(), rng


def test_columns_have_the_width_of_the_rows(found):
    job, kind = found
    assert kind.count > 0
    assert dr.width(kind.places()) == kind.count
    moving = np.broadcast_to(np.array(kind.moving()), kind.count)
    assert moving.any()
    for weights in (kind.film_weights(job.frame, 1), *(kind.line_weights(use) for use in Use)):
        values = np.broadcast_to(np.array(weights), kind.count)
        assert np.isfinite(values).all() and (values >= 0).all()
    assert (np.array(kind.line_weights(Use.STEP)) > 0).any()


def test_points_lie_on_the_edge_and_know_its_tangent(found):
    """x(t) and dx/dt agree by finite differences, for one line at a time."""
    _, kind = found
    if not isinstance(kind, (FixedKind, ContourKind)):
        pytest.skip("its lines are drawn otherwise: dx is the length of edge that a line stands for")
    row, t, rng = rows_of(kind)
    h = 1e-2
    t = 0.1 + 0.8 * t
    a, ω = lines(kind, row, t - h, lane_sampler(mi.UInt32(5), dr.arange(mi.UInt32, COUNT)))
    b, _ = lines(kind, row, t + h, lane_sampler(mi.UInt32(5), dr.arange(mi.UInt32, COUNT)))
    middle, _ = lines(kind, row, t, lane_sampler(mi.UInt32(5), dr.arange(mi.UInt32, COUNT)))
    valid = np.array(a.valid & b.valid & middle.valid & dr.full(mi.Bool, True, COUNT))
    slope = np.array((b.x - a.x) / (2 * h)).T[valid]
    dx = np.array(middle.dx + dr.zeros(mi.Vector3f, COUNT)).T[valid]
    assert len(dx) > COUNT / 4
    assert np.abs(slope - dx).max() < 2e-3 * np.abs(dx).max() + 1e-4


def test_what_is_across_is_across(found):
    _, kind = found
    row, t, rng = rows_of(kind)
    on, ω = lines(kind, row, t, rng)
    n_perp, across = on.across(ω)
    seen = np.array(on.valid & (across > 1e-4))
    assert seen.any()
    for other in (ω, on.dx):
        assert np.abs(np.array(dr.dot(n_perp, other)))[seen].max() < 1e-4 * max(1, np.abs(np.array(on.dx)).max())
    assert np.allclose(np.array(dr.norm(n_perp))[seen], 1, atol=1e-5)
    assert np.allclose(np.array(across)[seen], np.array(dr.norm(dr.cross(on.dx, ω)))[seen], rtol=1e-5)


def test_everything_shifted_shifts_the_edge(found):
    """Across the edge, the displacement of whatever moves along SHIFT is SHIFT's own part."""
    job, kind = found
    row, t, rng = rows_of(kind)
    on, ω = lines(kind, row, t, rng)
    n_perp, across = on.across(ω)
    sight = Sight.of(on, row, t, ω, mi.Float(1), n_perp)
    params, θ = mi.traverse(job.scene), mi.Float(0)
    dr.enable_grad(θ)
    still = ("camera", "light", "lamp")
    for name in [k for k in params.keys() if k.endswith(PLACED) and not k.startswith(still) and "bsdf" not in k]:
        params[name] = moved(params[name], θ, STRIDES.get(name.split(".")[-1], 3))
    params.update()
    dr.forward(θ, dr.ADFlag.ClearEdges)
    if isinstance(kind, Junctions):  # what it knows of meshes is of a call in which nothing moves
        kind = replace(kind, surfaces=surfaces_of(job.scene, job.facts, Memory()))
        for moving in kind.surfaces.meshes.in_motion() if kind.surfaces is not None else ():
            moving.take_tangents()
    motion = kind.displacement(row, sight.at, sight.ω, mi.Bool(True))
    assert np.abs(np.array(motion)).max() == 0
    speed = dr.dot(n_perp, tangents(motion))
    expected = np.array(dr.dot(n_perp, mi.Vector3f(SHIFT)) + dr.zeros(mi.Float, COUNT))
    moving = np.array(dr.gather(mi.Bool, kind.moving(), row) & on.valid & (across > 1e-3))
    assert moving.any()
    assert np.abs(np.array(speed) - expected)[moving].max() < 1e-3


def moved(value, θ, stride):
    if "Transform" in type(value).__name__:
        return mi.Transform4f().translate(mi.Vector3f(SHIFT) * θ) @ dr.detach(value)
    # a curve's points with their radius, an ellipsoid's centre with its shape
    count = dr.width(value) // stride
    return dr.detach(value) + dr.tile(mi.Float(*[[*SHIFT, *[0.0] * (stride - 3)]]), count) * θ


def test_rays_pass_beside(found):
    """The rays of both sides run parallel to the line, on their sides of it."""
    _, kind = found
    row, t, rng = rows_of(kind)
    on, ω = lines(kind, row, t, rng)
    n_perp, across = on.across(ω)
    sight = Sight.of(on, row, t, ω, mi.Float(2), n_perp)
    for which, sign in ((0, -1), (1, 1)):
        ray = sight.beside(mi.UInt32(which))
        height = np.array(dr.dot(ray.o - on.x, n_perp))[np.array(on.valid & (across > 1e-4))]
        assert (np.sign(height) == sign).all()
        side = kind.side(row, sight, mi.UInt32(which), mi.Bool(True))
        assert np.array(side.traced | side.pi.valid).all()  # never a silent nothing


def test_directions_of_fixed_edges_have_the_density_they_say(found):
    _, kind = found
    if isinstance(kind, ContourKind):
        assert np.isfinite(np.array(kind.inside(rows_of(kind)[0], mi.Bool(True)))).all()
        return
    row, t, rng = rows_of(kind)
    if not isinstance(kind, FixedKind):
        line = kind.line(row, t, rng.next_2d(), None, mi.Bool(True))
        assert np.isfinite(np.array(line.pdf_sa)).all() and (np.array(line.pdf_sa) > 0).all()
        return
    for use in (Use.STEP, Use.BACKGROUND):
        w = kind.wedges(row, use, mi.Bool(True))
        ω, pdf = w.sample(rng.next_2d())
        drawn = np.array((pdf > 0) & dr.full(mi.Bool, True, COUNT))
        assert drawn.any()
        agree = np.isclose(np.array(w.pdf(ω)), np.array(pdf), rtol=1e-3)[drawn]
        assert agree.mean() > 0.99  # rounding may put a sample on the other side of a wedge's border


def cut_ball(ball, places: str, base: type) -> tuple[mi.Scene, EdgeKind]:
    """A ball about the origin that a wall cuts into, and its outlines."""
    T = mi.ScalarTransform4f
    wall = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], 20).translate([0, 0, -0.9 * RADIUS]).scale(3)}
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    sensor = {"type": "perspective", "to_world": T().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]), "film": film}
    scene = mi.load_dict({"type": "scene", "ball": ball, "wall": wall, "light": {"type": "constant"}, "sensor": sensor,
                          "integrator": {"type": "psdr_path", "max_depth": 2, "sppc": 1}})  # fmt: skip
    with also_enabled(scene, [f"ball.{places}"]):
        job = prepare(scene.integrator().call(scene, scene.sensors()[0], 0, 1)).jobs[0][1]
        (kind,) = (k for k in scene_edges(job).kinds if isinstance(k, base))
    return scene, kind


def starts_behind(scene: mi.Scene, side, sight: Sight, active) -> np.ndarray:
    """Distance from the origin at which rays start from what `side` meets on the wall's front (N,)."""
    ray, pi = traced(scene, side, sight, active, [])
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    met = np.array(active & si.is_valid() & (dr.dot(si.n, ray.d) < 0))
    return np.array(dr.norm(si.spawn_ray(si.n).o))[met]


def test_rays_from_what_an_outline_hides_start_outside_of_the_shape(llvm):
    """Also close to where a wall cuts into it: Mitsuba lifts their starts, towards the shape."""
    scene, kind = cut_ball({"type": "sphere", "radius": RADIUS}, "to_world", AnalyticCurves)
    row, t, rng = rows_of(kind)
    on, ω = lines(kind, row, t, rng)
    sight = Sight.of(on, row, t, ω, mi.Float(DISTANCE), on.across(ω)[0])
    start = starts_behind(scene, kind.side(row, sight, mi.UInt32(1), on.valid), sight, on.valid)
    assert len(start) > COUNT / 100 and (start > RADIUS).all()


def test_rays_from_what_a_fine_mesh_hides_start_outside_of_it(llvm):
    segments, count = 128, 1 << 17
    points, faces = meshes.ball(segments, 2 * segments)
    ball = mi.Mesh("ball", len(points), len(faces))
    params = mi.traverse(ball)
    params["vertex_positions"] = (RADIUS / meshes.RADIUS * (points - meshes.CENTRE)).ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    scene, kind = cut_ball(ball, "vertex_positions", MeshEdges)
    row, t, rng = rows_of(kind, count=count)
    ω, pdf = kind.wedges(row, Use.STEP, mi.Bool(True)).sample(rng.next_2d())
    on = kind.on(row, t, mi.Vector4f(-ω.x, -ω.y, -ω.z, 0), pdf > 0)
    sight = Sight.of(on, row, t, ω, mi.Float(DISTANCE), on.across(ω)[0])
    sides = [kind.side(row, sight, mi.UInt32(which), on.valid) for which in (0, 1)]
    start = np.concatenate([starts_behind(scene, side, sight, on.valid & side.traced & side.differs) for side in sides])
    inside = RADIUS * np.cos(np.pi / (2 * segments)) ** 2  # where the facets are nearest to the centre
    assert len(start) > count / 100 and (start > inside).all()
