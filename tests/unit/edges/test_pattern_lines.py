"""Where patterns step: every line that is listed is one, and no step of the texture lies elsewhere."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.edges.pattern_rows import BLOCK, End, Patches, parallel_lines, rows_on, sides_on_lines
from psdr_jit.edges.surface_points import Surface, surface_point
from psdr_jit.scene.patterns import StepFamily, pattern_textures, step_families

SQUARE = np.array([[-1.3, -0.8], [2.1, -0.8], [-1.3, 1.9], [2.1, 1.9]])
BESIDE = 1e-4  # how far beside a line a texture is looked at


def texture(kind: str, **options) -> mi.Texture:
    transform = mi.ScalarTransform4f().rotate([0, 0, 1], 25).translate([0.3, -0.2, 0]).scale([2.3, 1.4, 1])
    if kind == "checkerboard":
        return mi.load_dict({"type": kind, "to_uv": transform})
    data = np.random.default_rng(0).random((3, 5, 3)).astype(np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest", "to_uv": transform}
    return mi.load_dict({**bitmap, "wrap_mode": kind, **options})


def look_up(of: mi.Texture, uv: np.ndarray) -> np.ndarray:
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(uv.T.astype(np.float32))
    try:
        return np.array(of.eval_3(si)).T
    except RuntimeError:
        return np.array(of.eval(si)).T


def lines_of(of: mi.Texture, uv: np.ndarray = SQUARE, ends: tuple[End, ...] = ()):
    return parallel_lines(step_families(of), uv, ends)


@pytest.mark.parametrize("kind", ["checkerboard", "repeat", "mirror", "clamp"])
def test_every_line_is_a_step_and_every_step_is_on_a_line(llvm, kind):
    of, rng = texture(kind), np.random.default_rng(1)
    families = lines_of(of)
    assert len(families) == 2
    uv = rng.uniform(SQUARE.min(0), SQUARE.max(0), (4000, 2))
    ahead = np.clip(uv + rng.uniform(-0.1, 0.1, uv.shape), SQUARE.min(0), SQUARE.max(0))
    crossed = np.zeros(len(uv), bool)
    for lines in families:
        assert 0 < len(lines.s) < 100 and (np.diff(lines.s) > 0).all()
        along = np.array([-lines.n[1], lines.n[0]])
        for s in lines.s:  # somewhere along the line, the texture steps
            points = s * lines.n + rng.uniform(-3, 3, (400, 1)) * along
            assert (look_up(of, points - BESIDE * lines.n) != look_up(of, points + BESIDE * lines.n)).any()
        crossed |= np.searchsorted(lines.s, uv @ lines.n) != np.searchsorted(lines.s, ahead @ lines.n)
    differs = (look_up(of, uv) != look_up(of, ahead)).any(1)
    assert differs.sum() > 100 and not (differs & ~crossed).any()


def test_equal_texels_are_no_lines(llvm):
    stripes = np.zeros((4, 6, 3), np.float32)
    stripes[:, 3:] = 1
    of = mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(stripes), "raw": True, "filter_type": "nearest"})
    (family,) = lines_of(of, np.array([[0.1, 0.1], [0.9, 0.9]]))
    assert np.allclose(family.s, [0.5]) and np.allclose(np.abs(family.n), [1, 0])
    grey = {"type": "rgb", "value": 0.5}
    assert not step_families(mi.load_dict({"type": "checkerboard", "color0": grey, "color1": grey}))
    assert step_families(mi.load_dict({"type": "checkerboard", "color0": grey}))


def test_a_line_of_two_textures_is_one(llvm):
    everywhere = np.ones(1, bool)
    halves, thirds = (StepFamily(np.array([k, 0.0]), 0.0, everywhere) for k in (2.0, -6.0))
    (lines,) = parallel_lines([halves, thirds], np.array([[0.0, 0.0], [1.0, 1.0]]))
    assert np.allclose(np.abs(lines.s), np.arange(7) / 6) or np.allclose(lines.s, -np.arange(7)[::-1] / 6)


def test_coordinates_end_in_a_seam_or_a_rim(llvm):
    family = StepFamily(np.array([4.0, 0.0]), 1e-9, np.ones(1, bool))
    u = np.array([1.0, 0.0])
    for seam, expected in ((True, [0, 0.25, 0.5, 0.75]), (False, [0.25, 0.5, 0.75])):
        (lines,) = parallel_lines([family], np.array([[0.0, 0], [1, 1]]), (End(u, 0.0, seam), End(u, 1.0, False)))
        assert np.allclose(lines.s, expected, atol=1e-6)


def test_patches_side_by_side_share_no_line_and_lose_none(llvm):
    """The lengths of all pieces add up to the lines in the unit square, also where they run along its diagonals."""
    n = 4
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    corner = np.stack([i, j], 1)[:, None]
    uv = np.concatenate([corner + np.array(h) for h in ([[0, 0], [1, 0], [0, 1]], [[1, 1], [0, 1], [1, 0]])]) / n
    patches = Patches(uv, uv, np.zeros(len(uv), int))
    for a, expected in (([8.0, 0.0], 8.0), ([100.0, 0.0], 100.0), ([4.0, 4.0], np.sqrt(2) * (16 / 4))):
        family = StepFamily(np.array(a), 0.0, np.ones(1, bool))
        (lines,) = parallel_lines([family], uv.reshape(-1, 2))
        rows = rows_on(patches, None, lines, np.broadcast_to(lines.n, (len(uv), 2)))
        last = rows["line"] + rows["count"] - 1
        assert rows["count"].max() <= BLOCK and (rows["line"] // BLOCK == last // BLOCK).all()
        total = 0.0
        for k in range(BLOCK):
            has = rows["count"] > k
            s0, s1, s2 = (rows[f"s{m}"][has] for m in range(3))
            q0, q1, q2 = (rows[f"q{m}"][has] for m in range(3))
            index = rows["line"][has] + k
            s = lines.s[index] - lines.s[index // BLOCK * BLOCK]
            with np.errstate(divide="ignore", invalid="ignore"):
                long = q0 + np.nan_to_num((s - s0) / (s2 - s0))[:, None] * (q2 - q0)
                below = q0 + np.nan_to_num((s - s0) / (s1 - s0))[:, None] * (q1 - q0)
                above = q1 + np.nan_to_num((s - s1) / (s2 - s1))[:, None] * (q2 - q1)
            short = np.where((s < s1)[:, None], below, above)
            total += np.linalg.norm(short - long, axis=1).sum()
        assert total == pytest.approx(expected, rel=1e-6)  # the left border counts: it belongs to these patches


def test_sides_along_lines_are_left_to_mesh_edges(llvm):
    face = np.array([[[0.0, 0.0], [0.5, 0.0], [0.0, 0.3]], [[0.1, 0.1], [0.4, 0.2], [0.2, 0.4]]])
    family = [StepFamily(np.array(a), 0.0, np.ones(1, bool)) for a in ([2.0, 0.0], [0.0, 2.0])]
    lines = parallel_lines(family, np.array([[0.0, 0.0], [1.0, 1.0]]))
    assert sides_on_lines(face, lines).tolist() == [[False, True, True], [False, False, False]]
    patches = Patches(face, face, np.arange(2))
    for direction in lines:
        assert len(rows_on(patches, face, direction, np.zeros((2, 2)))["line"]) == 0


@pytest.mark.parametrize("plugin, surface", [
    ("disk", Surface.DISK), ("cylinder", Surface.CYLINDER), ("sphere", Surface.SPHERE),
])  # fmt: skip
def test_analytic_shapes_are_parametrised_as_by_mitsuba(llvm, plugin, surface):
    uv = mi.Point2f(np.random.default_rng(0).uniform(0.05, 0.95, (2, 50)).astype(np.float32))
    x, du, dv = surface_point(mi.UInt32(int(surface)), uv)
    shape, n = mi.load_dict({"type": plugin}), dr.normalize(dr.cross(du, dv))
    for side in (1, -1):
        si = shape.ray_intersect(mi.Ray3f(x + 0.01 * side * n, -side * n))
        assert np.allclose(np.array(si.uv), np.array(uv), atol=1e-5) and np.allclose(np.array(si.t), 0.01, atol=1e-5)
        assert np.allclose(np.array(si.dp_du), np.array(du), atol=1e-4)
        assert np.allclose(np.array(si.dp_dv), np.array(dv), atol=1e-4)


def test_textures_are_found_wherever_they_are_nested(llvm):
    nearest, smooth = texture("repeat"), texture("repeat", filter_type="bilinear")
    inner = {"type": "checkerboard", "color0": nearest, "color1": smooth}
    bsdf = {"type": "twosided", "b": {"type": "blendbsdf", "weight": smooth, "a": {"type": "diffuse"},
            "b": {"type": "diffuse", "reflectance": inner}}}  # fmt: skip
    shape = mi.load_dict({"type": "sphere", "bsdf": bsdf, "emitter": {"type": "area", "radiance": nearest}})
    assert sorted(found.class_name().split("[")[0] for found in pattern_textures(shape)) == [
        "BitmapTextureImpl", "Checkerboard",
    ]  # fmt: skip


def test_smooth_textures_have_no_lines_while_derivatives_are_suspended(llvm):
    """As terms ask: a bilinear bitmap beside a checkerboard steps nowhere, as heights of a bump map its slopes do."""
    data = mi.Bitmap(np.random.default_rng(0).random((4, 6, 1)).astype(np.float32))
    smooth = {"type": "bitmap", "bitmap": data, "raw": True}
    blend = {"type": "blendbsdf", "weight": smooth, "a": {"type": "diffuse"},
             "b": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}}  # fmt: skip
    bump = {"type": "bumpmap", "heights": smooth, "of": {"type": "diffuse"}}
    with dr.suspend_grad():
        shapes = [mi.load_dict({"type": "rectangle", "bsdf": bsdf}) for bsdf in (blend, bump)]
        assert [len(pattern_textures(shape)) for shape in shapes] == [1, 1]
        across, down = step_families(pattern_textures(shapes[1])[0])
    assert np.allclose((across.within(0, 2) - across.b) / across.a[0] * 6, [0.5, 1.5, 2.5])
    assert np.allclose((down.within(0, 1) - down.b) / down.a[1] * 4, [0.5, 1.5])
