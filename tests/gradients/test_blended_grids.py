"""Grids of signed distances shaded with blended normals: the curves on which these turn away."""

from __future__ import annotations

from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fd, forward
from test_distance_grids import blob, grid, torus
from test_linear_curves import EYE
from variants import also

from psdr_jit import make_plan
from psdr_jit.core.memory import Memory
from psdr_jit.core.sdf_octant import REACH, Octant
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain
from psdr_jit.edges.edge_shapes import GridPlace
from psdr_jit.edges.grid_set import grid_set
from psdr_jit.edges.kind import Use
from psdr_jit.edges.kind_grid_shading import GridShadingOutlines
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.scene.facts import analyse

LINES = 1500  # along which sign changes are counted
WINDOW = 0.05  # side of the square that they cover [m]


def test_the_gradient_of_blended_normals(llvm):
    """Against differences, away from and at the end of the grid."""
    rng, q, h = np.random.default_rng(1), mi.Vector3f(0.3, -0.5, 0.8), 1e-3
    for end in (False, True):
        values = {step: mi.Float(rng.normal(size=50)) for step in product((-1, 0, 1), repeat=3)}
        octant = Octant(values, [mi.Bool(end), mi.Bool(False), mi.Bool(False)])
        p = mi.Vector3f(*(mi.Float(rng.uniform(0, REACH, 50)) for _ in range(3)))
        n, gradient = octant.ascent(p, q)
        assert np.abs(np.array(n - octant.blended(p))).max() < 1e-6
        for axis in range(3):
            step = mi.Vector3f(*(h * (k == axis) for k in range(3)))
            slope = (dr.dot(octant.blended(p + step), q) - dr.dot(octant.blended(p - step), q)) / (2 * h)
            assert np.quantile(np.abs(np.array(slope - gradient[axis])), 0.9) < 2e-3


def alone(values: np.ndarray) -> mi.Scene:
    return mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "thing": grid(values, "smooth")})


def outlines_of(scene: mi.Scene) -> GridShadingOutlines:
    (facts,) = analyse(scene).shapes
    places = (GridPlace(scene.shapes()[0], facts, None, 0),)
    return GridShadingOutlines.of(grid_set(places), Memory(), mi.Point3f(0))


def crossings(scene: mi.Scene, d: mi.Vector3f, right: mi.Vector3f, up: mi.Vector3f, corner: list[float]) -> float:
    """Length [m] across `up` of the curve that parallel rays along d see in a square, by changes of sign along `right`.

    Bands in which normals are turned away are narrow: rays are close.
    """
    i, j = dr.meshgrid(dr.arange(mi.Float, LINES), dr.arange(mi.Float, LINES))
    x, y = (corner[k] + (at + 0.5) / LINES * WINDOW for k, at in enumerate((i, j)))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(right * x + up * y - 5 * d), d))
    h = np.where(np.array(si.is_valid()), np.array(dr.dot(si.sh_frame.n, d)), np.nan).reshape(LINES, LINES)
    one_surface = np.abs(np.diff(np.array(si.t).reshape(LINES, LINES), axis=1)) < 0.05
    return float(((h[:, 1:] * h[:, :-1] < 0) & one_surface).sum() * WINDOW / LINES)


@pytest.mark.parametrize("values", [torus(12), also(blob(20))], ids=["torus", "blob"])
def test_curves_are_found_where_shading_turns_away(llvm, values):
    """Points lie on the surface where Mitsuba's normal turns away; the length of what is seen, against counting."""
    scene, samples = alone(values), 256
    outlines = outlines_of(scene)
    row = dr.repeat(dr.arange(mi.UInt32, outlines.count), samples)
    t = (dr.tile(dr.arange(mi.Float, samples), outlines.count) + 0.5) / samples
    d = dr.normalize(mi.Vector3f(0.3, 0.9, -0.35))
    right, up = mi.coordinate_system(d)
    on = outlines.on(row, t, mi.Vector4f(-d.x, -d.y, -d.z, 0), mi.Bool(True))
    ray = mi.Ray3f(on.x - 5 * d, d)
    pi = scene.ray_intersect_preliminary(ray)
    near = dr.abs(pi.t - 5) < 0.005
    pi.t = dr.select(pi.is_valid(), 5, dr.inf)
    si = pi.compute_surface_interaction(ray)
    seen = np.array(on.valid & near & (dr.dot(si.n, d) < 0))
    cos = np.array(dr.dot(si.sh_frame.n, d))[seen]
    assert seen.sum() > 1000 and np.quantile(np.abs(cos), 0.99) < 1e-4
    x, y, length = (np.array(a)[seen] for a in (dr.dot(on.x, right), dr.dot(on.x, up), dr.abs(dr.dot(on.dx, up))))
    bins = np.arange(-1.2, 1.2, WINDOW)
    by_window = np.histogram2d(x, y, bins=[bins, bins], weights=length / samples)[0]
    most = np.unravel_index(by_window.argmax(), by_window.shape)
    expected = crossings(scene, d, right, up, [float(bins[k]) for k in most])
    assert expected > WINDOW / 2 and by_window[most] == pytest.approx(expected, rel=0.03)


def test_lines_from_anywhere_see_as_much(llvm):
    """Over all directions, lines through points of the surface add up to what each direction sees."""
    scene = alone(blob(12))
    outlines, repeats = outlines_of(scene), 64
    row = dr.repeat(dr.arange(mi.UInt32, outlines.count), repeats)
    rng = mi.PCG32(dr.width(row))
    t, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    line = outlines.line(row, t, u, None, mi.Bool(True))
    seen = dr.select(line.on.valid, dr.norm(dr.cross(line.on.dx, line.ω)) / line.pdf_sa, 0)
    d = mi.warp.square_to_uniform_sphere(u)
    on = outlines.on(row, t, mi.Vector4f(-d.x, -d.y, -d.z, 0), mi.Bool(True))
    expected = dr.select(on.valid, dr.norm(dr.cross(on.dx, d)) * 4 * dr.pi, 0)
    assert float(dr.sum(seen)[0]) == pytest.approx(float(dr.sum(expected)[0]), rel=0.03)
    assert (np.array(outlines.line_weights(Use.SHADOW)) == 0).all()


def scene_of(values: np.ndarray) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "gaussian"}, "pixel_format": "luminance"}
    T = mi.ScalarTransform4f
    pose = T().look_at(origin=list(EYE), target=[0, 0, 0], up=[0, 0, 1])
    camera = {"type": "perspective", "fov": 34, "to_world": pose, "film": film}
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -1.4]).scale(5)}
    body, sky = grid(values, "smooth"), {"type": "constant"}
    return mi.load_dict({"type": "scene", "camera": camera, "floor": floor, "sky": sky, "thing": body}, optimize=False)


@pytest.mark.parametrize(("values", "named"), [also(torus(40), False), (torus(12), True)], ids=["fine", "coarse"])
def test_coarse_grids_are_named(llvm, recwarn, values, named):
    make_plan(scene_of(values), "camera.to_world", integrator={"type": "psdr_path", "max_depth": 2})
    said = [str(w.message) for w in recwarn if issubclass(w.category, UnsupportedWarning)]
    assert any("blended normals" in text for text in said) == named


MOTIONS = {"camera": ("camera.to_world", (0.3, 0.8, 0.4)), "pose": ("thing.to_world", (0.3, 0.8, 0.4)),
           "values": ("thing.grid", None)}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("values", [torus(16), blob(32)], ids=["torus", "blob"])
def test_blended_normals_under_a_sky(llvm, values, motion):
    name, direction = MOTIONS[motion]
    moved = perturb(scene_of(values), name, direction=direction)
    spec = {"type": "psdr_path", "max_depth": 2, "rr_depth": 1000}
    reference = fd(moved, spec, 0.005, 32, 4096)
    slope = gain(forward(moved, spec, 24, 512), reference[0::2], reference[1::2])
    assert slope.stderr < 0.01, slope
    assert abs(slope.value - 1) < 0.01 + 2.5 * slope.stderr, slope
