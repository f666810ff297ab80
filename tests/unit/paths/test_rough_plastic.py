"""The derivative of rough plastic by roughness and index, with that of Mitsuba's tables: differences of the BSDF."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity

from psdr_jit.core.memory import Memory
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.paths.rough_plastic import make_tables, rough_plastic

pytestmark = pytest.mark.usefixtures("llvm")

DIRECTIONS = 8
COLOUR = {"type": "rgb", "value": [0.7, 0.4, 0.2]}
STEP = 0.02  # as the tables have it: with smaller ones, the noise of their sums shows
EVERY_COMPONENT = 0xFFFFFFFF


def scene_of(bsdf: dict) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    sensor = {"type": "perspective", "film": film,
              "to_world": mi.ScalarTransform4f().look_at([0, -2, 2], [0, 0, 0], [0, 0, 1])}  # fmt: skip
    lamp = {"type": "point", "position": [1, 1, 2]}
    return mi.load_dict({"type": "scene", "sensor": sensor, "shape": {"type": "rectangle", "bsdf": bsdf}, "lamp": lamp},
                        optimize=False)  # fmt: skip


def plastic(**options) -> dict:
    return {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": COLOUR, **options}


def directions() -> tuple[mi.Vector3f, mi.Vector3f]:
    rng = np.random.default_rng(2)
    z, φ = rng.uniform(0.05, 0.95, (2, DIRECTIONS)), rng.uniform(0, 2 * np.pi, (2, DIRECTIONS))
    x = np.sqrt(1 - z**2) * np.array([np.cos(φ), np.sin(φ)])
    return tuple(mi.Vector3f(x[0, k], x[1, k], z[k]) for k in (0, 1))


def base_of(bsdf: mi.BSDF, si, wo: mi.Vector3f) -> mi.Spectrum:
    """What the diffuse base sends."""
    flag = int(mi.BSDFFlags.DiffuseReflection)
    return bsdf.eval(mi.BSDFContext(mi.TransportMode.Radiance, flag, EVERY_COMPONENT), si, wo)


@pytest.mark.parametrize("parameter", ["alpha", "eta"])
@pytest.mark.parametrize("nonlinear", [False, True])
@pytest.mark.parametrize("kind, two_sided", [("ggx", False), ("beckmann", True)])
def test_base(parameter, nonlinear, kind, two_sided):
    inner = plastic(nonlinear=nonlinear, distribution=kind)
    scene = scene_of({"type": "twosided", "inner": inner} if two_sided else inner)
    params, shape = mi.traverse(scene), scene.shapes()[0]
    (name,) = [key for key in params.keys() if key.endswith(f".{parameter}")]
    wi, wo = directions()
    si = dr.zeros(mi.SurfaceInteraction3f, DIRECTIONS)
    si.wi, si.shape = wi, mi.ShapePtr(shape)
    centre, h = float(params[name][0]), STEP

    def at(value) -> mi.Spectrum:
        params[name] = value
        params.update()
        return base_of(shape.bsdf(), si, wo)

    above, below = (np.array(at(mi.Float(centre + step))) for step in (h, -h))
    value = mi.Float(centre)
    dr.enable_grad(value)
    f = at(value)
    alone = dr.copy(f)
    whole = f + rough_plastic(scene, Memory()).missing(si, mi.BSDFPtr(shape.bsdf()), wo, mi.Bool(True))
    assert np.array_equal(np.array(dr.detach(whole)), np.array(dr.detach(f)))
    dr.forward(value)
    slope = (above - below) / (2 * h)
    assert np.allclose(np.array(dr.grad(whole)), slope, rtol=0.01, atol=2e-3 * np.abs(slope).max())
    assert not np.allclose(np.array(dr.grad(alone)), slope, rtol=0.1)  # what Mitsuba has


def test_other_sides_and_other_materials_are_left_alone():
    inner = {"type": "twosided", "front": plastic(), "back": {"type": "diffuse"}}
    scene = scene_of(inner)
    params = mi.traverse(scene)
    (name,) = [key for key in params.keys() if key.endswith(".eta")]
    dr.enable_grad(params[name])
    params.update()
    tables = rough_plastic(scene, Memory())
    wi, wo = directions()
    si = dr.zeros(mi.SurfaceInteraction3f, DIRECTIONS)
    si.shape = mi.ShapePtr(scene.shapes()[0])
    found = []
    for side in (1, -1):
        si.wi = mi.Vector3f(wi.x, wi.y, side * wi.z)
        towards = mi.Vector3f(wo.x, wo.y, side * wo.z)
        found.append(tables.missing(si, mi.BSDFPtr(scene.shapes()[0].bsdf()), towards, mi.Bool(True)))
    dr.forward(params[name])
    front, back = (np.abs(np.array(dr.grad(f))).max() for f in found)
    assert front > 0 and back == 0
    assert rough_plastic(scene_of(plastic()), Memory()) is None  # nothing is enabled


def test_coats_inside_of_other_materials_are_named():
    scene = scene_of({"type": "mask", "opacity": 0.5, "inner": plastic()})
    params = mi.traverse(scene)
    (name,) = [key for key in params.keys() if key.endswith(".eta")]
    dr.enable_grad(params[name])
    with pytest.warns(UnsupportedWarning, match="inside of a mask"):
        assert rough_plastic(scene, Memory()) is None


def test_tables_are_made_once_for_a_value():
    scene, memory = scene_of(plastic()), Memory()
    params = mi.traverse(scene)
    dr.enable_grad(params["shape.bsdf.eta"])
    first, second = (rough_plastic(scene, memory)._coats[0].tables for _ in range(2))
    assert first is second and 0 < first.r < 1
    other = make_tables("ggx", 0.3, 1.3)
    assert other.r < make_tables("ggx", 0.3, 1.6).r  # denser coats reflect more inside


@pytest.mark.parametrize("parameter", ["alpha", "eta"])
@pytest.mark.parametrize("moves", [False, True], ids=["rests", "moves"])
def test_forward_and_backward_mode_agree_and_both_have_it(parameter, moves):
    """Along the walk, by recorded paths, and by those of things that move."""
    scene = scene_of(plastic())
    if moves:
        dr.enable_grad(mi.traverse(scene)["lamp.position"])
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2, "sppc": 8, "sppp": 2, "sppi": 2, "sppd": 2})
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnsupportedWarning)
        one, other, w, Jv = adjoint_identity(scene, f"shape.bsdf.{parameter}", integrator)
    assert abs(one - other) < 1e-4 * w * Jv and Jv > 0
