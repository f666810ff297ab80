"""What instances show: rays find it again from their records, and copies of it are where it is."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.records import Hit
from psdr_jit.edges.copies import copied
from psdr_jit.errors import UnsupportedError
from psdr_jit.scene.instances import group_of, shape_groups

RAYS = 64  # along each side of the film
POSE = {"translate": [0.3, 0.1, -0.2], "rotate": ([0.6, 0.8, 0], 40)}


PAINT = {"type": "checkerboard"}
MIRRORED = {"mirrored sphere": "sphere", "mirrored tube": "cylinder"}


def pose(scale=(1, 1, 1)) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate(POSE["translate"]).rotate(*POSE["rotate"]).scale(scale)


def scene_of(scale, **shapes) -> mi.Scene:
    """An instance of a group in front of a wall."""
    return mi.load_dict({
        "type": "scene",
        "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -4]).scale(5)},
        "group": {"type": "shapegroup", **shapes},
        "shown": {"type": "instance", "to_world": pose(scale), "of": {"type": "ref", "id": "group"}},
    }, optimize=False)  # fmt: skip


def rays() -> mi.Ray3f:
    x, y = dr.meshgrid(dr.linspace(mi.Float, -2, 2, RAYS), dr.linspace(mi.Float, -2, 2, RAYS))
    return mi.Ray3f(mi.Point3f(x, y, 6), mi.Vector3f(0, 0, -1))


def points_of(si: mi.SurfaceInteraction3f) -> np.ndarray:
    columns = (si.p, si.n, si.sh_frame.n, si.uv)
    return np.concatenate([np.array(dr.select(si.is_valid(), c, 0)) for c in columns])


def smooth() -> mi.Mesh:
    """A tetrahedron with texture coordinates, and normals that are not those of its faces."""
    points = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float32)
    props = mi.Properties()
    props["flip_normals"] = True
    mesh = mi.Mesh("bent", 4, 4, props, has_vertex_normals=True, has_vertex_texcoords=True)
    mesh.add_attribute("vertex_color", 3, points.ravel())
    params = mi.traverse(mesh)
    params["vertex_positions"] = points.ravel()
    params["faces"] = np.array([0, 1, 2, 0, 3, 1, 0, 2, 3, 1, 3, 2], np.uint32)
    params["vertex_normals"] = (points / np.sqrt(3)).ravel()
    params["vertex_texcoords"] = points[:, :2].ravel()
    params.update()
    return mesh


def test_a_record_finds_its_surface_again(llvm):
    scene = scene_of((1, 1, 1), ball={"type": "sphere", "center": [1, 0, 0]}, box={"type": "cube"})
    ray = rays()
    pi = scene.ray_intersect_preliminary(ray)
    direct, again = (p.compute_surface_interaction(ray) for p in (pi, Hit.of(ray, pi).intersection()))
    assert dr.all(direct.shape == again.shape) and dr.all(direct.instance == again.instance)
    assert len(set(np.array(dr.reinterpret_array(mi.UInt32, direct.shape)))) == 3  # the wall, the ball, the box
    np.testing.assert_array_equal(points_of(direct), points_of(again))


@pytest.mark.parametrize("scale", [(1, 1, 1), (1, 0.6, 1.4), (-1, 1, 1)], ids=["rigid", "stretched", "mirrored"])
@pytest.mark.parametrize("kind", ["cube", "smooth", "disk", "sphere", "cylinder", "mirrored sphere", "mirrored tube"])
def test_a_copy_is_what_the_instance_shows(llvm, kind, scale):
    kind, own = MIRRORED.get(kind, kind), mi.ScalarTransform4f().scale((-1, 1, 1) if kind in MIRRORED else (1, 1, 1))
    part = smooth() if kind == "smooth" else mi.load_dict({"type": kind, "to_world": own, "paint": PAINT})
    scene = scene_of(scale, part=part)
    (shown,) = [s for s in scene.shapes() if s.id() == "shown"]
    (child,) = shape_groups(mi.traverse(scene).hierarchy)[group_of(shown)]
    if kind in ("sphere", "cylinder") and scale[1] != 1:
        with pytest.raises(UnsupportedError, match=f"stretches or shears a {kind}"):
            copied(child, kind, shown, "copy")
        return
    copy = copied(child, kind, shown, "copy")
    assert copy.id() == "copy" and copy.bsdf() is child.bsdf()
    alone = mi.load_dict({"type": "scene", "wall": [s for s in scene.shapes() if s is not shown][0], "copy": copy})
    a, b = (points_of(s.ray_intersect(rays())) for s in (scene, alone))
    agree = np.abs(a - b).max(0) < 1e-4
    assert np.mean(agree) > 0.995  # rays past an outline may go either way
    if kind != "smooth":
        assert copy.texture_attribute("paint") is child.texture_attribute("paint")
    else:
        np.testing.assert_array_equal(copy.attribute_buffer("vertex_color"), child.attribute_buffer("vertex_color"))
