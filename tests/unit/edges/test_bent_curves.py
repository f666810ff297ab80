"""Where bent normals turn from a viewpoint: points of these curves, and what they weigh."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from edge_oracle import icosphere
from helpers import mesh_of
from variants import also

from psdr_jit.core.sensor_frame import viewpoint
from psdr_jit.derivative import integrator_specs
from psdr_jit.driver.prepare import prepare
from psdr_jit.edges import bent_cells, bent_rows, bent_texels
from psdr_jit.edges.bent_rows import BentRows
from psdr_jit.edges.kind_bent import BentOutlines
from psdr_jit.edges.scene_table import scene_edges
from psdr_jit.scene.params import also_enabled

GRID = 24  # of the midpoint rule, on every patch
BAND = 0.01  # of h around the curve
PER_ROW = 64  # samples of a patch

pytestmark = pytest.mark.usefixtures("llvm")


def normal_map(texels: int) -> dict:
    n = np.random.default_rng(2).uniform(-0.3, 0.3, (texels, texels, 3)) * [1, 1, 0] + [0.5, 0.5, 0.9]
    return {"type": "normalmap", "normalmap": picture(n), "bsdf": {"type": "diffuse"}}


def bump_map(texels: int) -> dict:
    heights = picture(np.random.default_rng(2).random((texels, texels, 1)))
    return {"type": "bumpmap", "heights": heights, "scale": 1 / texels, "bsdf": {"type": "diffuse"}}


def picture(values: np.ndarray) -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(values.astype(np.float32)), "raw": True}


def below(bsdf: dict, plugin: str) -> dict:
    return {"type": plugin, "bsdf": {"type": "twosided", "of": bsdf}}


def outlines(body: dict | mi.Mesh) -> tuple[BentOutlines, mi.Vector4f]:
    """Of a shape below a map, and where it is seen from."""
    pose = mi.ScalarTransform4f().look_at([2.4, 0.3, 1.2], [0, 0, 0], [0, 0, 1])
    sensor = {"type": "perspective", "to_world": pose, "film": {"type": "hdrfilm", "width": 16, "height": 16}}
    scene = mi.load_dict({"type": "scene", "body": body, "sky": {"type": "constant"}, "sensor": sensor}, optimize=False)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "sppc": 1})
    moved = "vertex_positions" if isinstance(body, mi.Mesh) else "to_world"
    with also_enabled(scene, [f"body.{moved}"]):
        job = prepare(integrator.call(scene, scene.sensors()[0], 0, 1)).jobs[0][1]
        (kind,) = (k for k in scene_edges(job).kinds if isinstance(k, BentOutlines))
    return kind, viewpoint(job.frame, mi.Point2f(0.5))


def inside_band(kind: BentOutlines, view: mi.Vector4f, grid: int, band: float) -> float:
    """∫ δ(h) dA over all patches, as the area of |h| < `band` divided by 2 `band`; of what faces the viewer."""
    i = dr.arange(mi.UInt32, kind.count * grid**2)
    row, k = i // grid**2, i % grid**2
    b = mi.warp.square_to_uniform_triangle((mi.Point2f(k % grid, k // grid) + 0.5) / grid)
    rows, everywhere = dr.gather(BentRows, kind.rows, row), mi.Bool(True)
    h = kind.surface.height(rows, kind.surface.bent(rows, b, everywhere), view)
    place = kind.surface.place(rows, rows.q(b), everywhere)
    area = dr.norm(dr.cross(place.towards(rows.q1 - rows.q0), place.towards(rows.q2 - rows.q0))) / (2 * grid**2)
    towards = mi.Vector3f(view.x, view.y, view.z) - view.w * mi.Vector3f(place.x)
    faces = dr.dot(kind.surface.normal(rows, place), towards) > 0
    inside = (dr.abs(h) < band) & (faces & rows.front | ~faces & rows.back)
    return float(dr.sum(dr.select(inside, area, 0))[0]) / (2 * band)


def assert_weights(
    kind: BentOutlines, view: mi.Vector4f, per_row: int = PER_ROW, grid: int = GRID, band: float = BAND
) -> None:
    """Points lie on the curve, and the sum of their weights is ∫ δ(h) dA."""
    i = dr.arange(mi.UInt32, kind.count * per_row)
    row, t = i // per_row, (mi.Float(i % per_row) + mi.PCG32(dr.width(i)).next_float32()) / per_row
    on = kind.on(row, t, view, mi.Bool(True))
    rows, b = dr.gather(BentRows, kind.rows, row), mi.Point2f(on.local.x, on.local.y)
    h = kind.surface.height(rows, kind.surface.bent(rows, b, on.valid), view)
    assert np.abs(np.array(dr.select(on.valid, h, 0))).max() < 1e-3
    towards = mi.Vector3f(view.x, view.y, view.z) - view.w * mi.Vector3f(on.x)
    m = kind.surface.at(rows, b, on.local.z, on.valid).gradient(-dr.normalize(towards))
    weight = dr.select(on.valid, dr.norm(on.dx) / dr.norm(m), 0)
    found, expected = float(dr.sum(weight)[0]) / per_row, inside_band(kind, view, grid, band)
    assert expected > 0.05 and found == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(("plugin", "texels"), [
    ("rectangle", 3), also("rectangle", 150), ("sphere", 5), also("sphere", 100), also("cylinder", 4), also("disk", 5),
])  # fmt: skip
def test_points_and_what_they_weigh(plugin, texels):
    """Patches are small against texels, or about as large."""
    assert_weights(*outlines(below(normal_map(texels), plugin)))


@pytest.mark.parametrize(("plugin", "texels", "most"), [
    ("sphere", 30, bent_cells.MOST_CELLS), also("rectangle", 100, 1000), also("cylinder", 60, bent_cells.MOST_CELLS),
])  # fmt: skip
def test_patches_of_many_texels(plugin, texels, most, monkeypatch):
    """Blocks of texels, which may be large themselves, are picked as they are crossed."""
    monkeypatch.setattr(bent_rows, "LEAST_PATCHES", 32)
    monkeypatch.setattr(bent_rows, "MOST_PATCHES", 64)
    monkeypatch.setattr(bent_cells, "LEAST_CELLS", 0)
    monkeypatch.setattr(bent_cells, "MOST_CELLS", most)
    kind, view = outlines(below(normal_map(texels), plugin))
    assert dr.all(bent_texels.Texels.of(kind.rows).all.number.x > 4)
    assert_weights(kind, view, 4096, 128)


@pytest.mark.parametrize(("plugin", "texels", "grid"), [("sphere", 20, 64), also("rectangle", 100, 32)])
def test_normals_that_step(plugin, texels, grid):
    """Those of a bump map do from texel to texel: with no regard to them, 8 to 30 % of the curves are lost."""
    assert_weights(*outlines(below(bump_map(texels), plugin)), 256, grid, 0.001)


def test_normals_that_are_not_bent_have_no_curve():
    """Where those turn from the viewer is an outline, or that of smooth shading, which are edges already."""
    flat = np.full((4, 4, 3), [0.5, 0.5, 1])
    bsdf = {"type": "normalmap", "normalmap": picture(flat), "bsdf": {"type": "diffuse"}}
    kind, view = outlines(mesh_of(*icosphere(3), normals=True, mesh_bsdf=bsdf))
    t = mi.PCG32(kind.count).next_float32()
    assert dr.none(kind.on(dr.arange(mi.UInt32, kind.count), t, view, mi.Bool(True)).valid)
