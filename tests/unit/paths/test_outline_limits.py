"""What walks from beside the outline of a sphere or cylinder meet: the outline's limit, whatever its material."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.paths.edge_on import GRAZING, EdgeOn
from psdr_jit.scene.facts import analyse

RADIUS, INSIDE = 0.5, 1e-4  # of the radius: where walks begin
BLACK = {"type": "diffuse", "reflectance": 0.0}


def scene_of(shape: str, bsdf: dict) -> mi.Scene:
    pose = mi.ScalarTransform4f().scale([RADIUS] * 3)
    return mi.load_dict({"type": "scene", "body": {"type": shape, "to_world": pose, "bsdf": bsdf},
                         "camera": {"type": "perspective"}}, optimize=False)  # fmt: skip


def edge_on_of(scene: mi.Scene) -> EdgeOn | None:
    return EdgeOn.of(scene, analyse(scene, scene.sensors()[0]))


@pytest.mark.parametrize("bsdf", [{"type": "diffuse"}, {"type": "dielectric"}], ids=lambda bsdf: bsdf["type"])
@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_normals_beside_an_outline_are_those_of_the_outline(llvm, shape, bsdf):
    """Without, they are turned by √(2 · INSIDE)."""
    scene = scene_of(shape, bsdf)
    d = mi.Vector3f(0, 1, 0)
    ray = mi.Ray3f(mi.Point3f(RADIUS * (1 - INSIDE), -5, 0.0 if shape == "sphere" else 0.2), d)
    si = scene.ray_intersect(ray)
    assert abs(float(si.sh_frame.n.y[0])) == pytest.approx(np.sqrt(2 * INSIDE), rel=0.03)  # rounding
    seen = edge_on_of(scene).at_limit(si, d, mi.Bool(True))
    assert np.array(seen.p)[:2].ravel() == pytest.approx([RADIUS, 0], abs=5e-6)
    assert np.array(seen.sh_frame.n)[:, 0] == pytest.approx([1, -GRAZING, 0], abs=5e-6)


@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_frames_beside_an_outline_are_turned_as_they_were(llvm, shape):
    """About the normal: what is brushed along a tangent, or bent by a map, was another thing at outlines."""
    scene, d = scene_of(shape, {"type": "diffuse"}), mi.Vector3f(0.6, 0.8, 0)
    beside = RADIUS * (1 - INSIDE) * mi.Vector3f(0.8, -0.6, 0)
    ray = mi.Ray3f(mi.Point3f(beside - 5 * d) + [0, 0, 0 if shape == "sphere" else 0.2], d)
    si = scene.ray_intersect(ray)
    s = np.array(si.sh_frame.s)[:, 0]
    frame = edge_on_of(scene).at_limit(si, d, mi.Bool(True)).sh_frame
    n, s_there, t = (np.array(v)[:, 0] for v in (frame.n, frame.s, frame.t))
    assert n[:2] @ [0.8, -0.6] == pytest.approx(1, abs=1e-5)
    assert s_there == pytest.approx(s, abs=0.03) and t == pytest.approx(np.cross(n, s_there), abs=1e-6)


@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_an_inner_wall_stays_as_it_is(llvm, shape):
    """Next to a rim it is met edge-on as well, but has no outline there: moved to one, it lay behind the outer wall."""
    scene = scene_of(shape, {"type": "twosided", "bsdf": {"type": "diffuse"}})
    d = mi.Vector3f(0, 1, 0)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(RADIUS * (1 - INSIDE), 0, 0.0 if shape == "sphere" else 0.2), d))
    assert float(si.p.y[0]) == pytest.approx(RADIUS * np.sqrt(2 * INSIDE), rel=0.03)
    place, normal = np.array(si.p), np.array(si.sh_frame.n)
    seen = edge_on_of(scene).at_limit(si, d, mi.Bool(True))
    assert np.array_equal(seen.p, place) and np.array_equal(seen.sh_frame.n, normal)


def test_a_surface_that_scatters_nothing_has_no_such_limit(llvm):
    assert edge_on_of(scene_of("sphere", BLACK)) is None
    assert edge_on_of(scene_of("rectangle", {"type": "diffuse"})) is None
