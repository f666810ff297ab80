"""What chains take for one surface."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from psdr_jit.boundary.chain_surface import ChainSurfaces


def hit(scene: mi.Scene, x: float, y: float) -> mi.SurfaceInteraction3f:
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 2), mi.Vector3f(0, 0, -1)))


@pytest.mark.parametrize("broken", ["shading normal", "normal", None])
def test_a_face_without_normals_is_one_surface(llvm, broken):
    """Scanned meshes have such faces: a point of theirs is not apart from itself."""
    scene = mi.load_dict({"type": "scene", "sheet": {"type": "rectangle"}})
    none, d = dr.zeros(mi.UInt32, 4), mi.Vector3f(0, 0, -1)
    surfaces = ChainSurfaces(None, none, none, none, horizons=True)
    a, b = hit(scene, 0.1, 0.2), hit(scene, 0.1, 0.2)
    for si in (a, b):
        if broken == "shading normal":
            si.sh_frame.n = mi.Normal3f(dr.nan)
        elif broken == "normal":
            si.n = mi.Normal3f(0)
    assert dr.all(surfaces.same(a, b, d, d, mi.UInt32(1)))
    assert not dr.any(surfaces.same(a, hit(scene, 2, 2), d, d, mi.UInt32(1)))
    assert broken or not dr.any(surfaces.same(a, b, d, -d, mi.UInt32(1)))
