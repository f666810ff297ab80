"""`psdr_dielectric` and `psdr_plastic` are Mitsuba's `dielectric` and `plastic`, and their η can be differentiated."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.errors import ParameterError

PINK = {"type": "rgb", "value": [0.9, 0.2, 0.5]}
TEXTURE = {"type": "checkerboard", "color0": 0.3, "color1": 0.8}
GLASS = [
    {},
    {"int_ior": "diamond", "specular_transmittance": TEXTURE},
    {"int_ior": 1.0, "ext_ior": "water", "specular_reflectance": PINK, "specular_transmittance": 0.7},
]
PLASTIC = [
    {},
    {"int_ior": 1.9, "ext_ior": 1.0, "nonlinear": True, "diffuse_reflectance": PINK, "specular_reflectance": 0.6},
    {"diffuse_reflectance": TEXTURE},
]
KINDS = [("dielectric", options) for options in GLASS] + [("plastic", options) for options in PLASTIC]
ROUNDING = 1e-6  # of the weight of a lobe that is not there
LOBES = ("all", "first", "second")

pytestmark = pytest.mark.usefixtures("llvm")


def room(bsdf: dict) -> mi.Scene:
    """A ball in front of a wall, between a lamp and the sky."""
    T = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    return mi.load_dict({
        "type": "scene",
        "camera": {"type": "perspective", "fov": 40, "film": film,
                   "to_world": T.look_at(origin=[0, 1, 5], target=[0, 0, 0], up=[0, 1, 0])},
        "ball": {"type": "sphere", "bsdf": bsdf},
        "wall": {"type": "rectangle", "to_world": T.translate([0, 0, -2]).scale(4), "bsdf": {"type": "diffuse"}},
        "lamp": {"type": "sphere", "center": [1.5, 3, 1], "radius": 0.5,
                 "emitter": {"type": "area", "radiance": 9.0}},
        "sky": {"type": "constant", "radiance": 0.3},
    }, optimize=False)  # fmt: skip


def image(bsdf: dict) -> np.ndarray:
    path = mi.load_dict({"type": "path", "max_depth": 8})
    return np.array(mi.render(room(bsdf), integrator=path, spp=16, seed=3))


@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_the_image_is_that_of_mitsuba(kind, options):
    ours, known = ({"type": name, **options} for name in (f"psdr_{kind}", kind))
    if kind == "plastic":
        ours, known = ({"type": "twosided", "bsdf": bsdf} for bsdf in (ours, known))
    expected = image(known)
    assert np.abs(image(ours) - expected).max() < 1e-5 * expected.max()


def answers(bsdf: mi.BSDF, lobe: str, mode: mi.TransportMode) -> list[np.ndarray]:
    """Everything a BSDF says, for directions on both sides."""
    ctx = mi.BSDFContext(mode)
    if lobe != "all":
        ctx.component = LOBES.index(lobe) - 1
    rng = np.random.default_rng(0)
    wi, wo = (mi.Vector3f(*(v / np.linalg.norm(v, axis=0)).astype(np.float32)) for v in rng.normal(size=(2, 3, 512)))
    u, v, w = (mi.Float(x.astype(np.float32)) for x in rng.random((3, 512)))
    si = dr.zeros(mi.SurfaceInteraction3f, 512)
    si.wi, si.uv = wi, mi.Point2f(v, u)
    bs, weight = bsdf.sample(ctx, si, u, mi.Point2f(v, w), mi.Bool(True))
    found = [weight, bs.pdf, *bsdf.eval_pdf(ctx, si, wo, mi.Bool(True)), bsdf.eval(ctx, si, wo, mi.Bool(True))]
    found += [bsdf.pdf(ctx, si, wo, mi.Bool(True)), bsdf.eval_diffuse_reflectance(si, mi.Bool(True))]
    chosen = (bs.pdf > 0) & dr.any(weight > ROUNDING)  # what is not sampled says nothing about where it leads
    found += [dr.select(chosen, x, 0) for x in (bs.wo, bs.eta, bs.sampled_component, bs.sampled_type)]
    return [np.array(x) + np.zeros(512) for x in found]


@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
@pytest.mark.parametrize("lobe", LOBES)
@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_so_is_every_answer(kind, options, lobe, mode):
    ours, known = (mi.load_dict({"type": name, **options}) for name in (f"psdr_{kind}", kind))
    assert ours.flags() == known.flags() and ours.component_count() == known.component_count()
    mode = getattr(mi.TransportMode, mode)
    for found, expected in zip(*(answers(bsdf, lobe, mode) for bsdf in (ours, known)), strict=True):
        assert np.abs(found - expected).max() < 2e-6 * max(1, np.abs(expected).max())


@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_so_are_its_parameters_and_eta_has_a_derivative(kind, options):
    ours, known = (mi.traverse(mi.load_dict({"type": name, **options})) for name in (f"psdr_{kind}", kind))
    assert set(ours.keys()) == set(known.keys())
    assert float(ours["eta"][0]) == known["eta"]
    info = {p.name: p for p in psdr_jit.differentiable_params(room({"type": f"psdr_{kind}", **options}))}
    assert info["ball.bsdf.eta"].differentiable and info["ball.bsdf.eta"].kind == "material"


@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_a_new_eta_is_as_good_as_one_from_the_start(kind, options):
    changed = mi.load_dict({"type": f"psdr_{kind}", **options})
    params = mi.traverse(changed)
    params["eta"] = 1.7
    params.update()
    fresh = mi.load_dict({"type": kind, **options, "int_ior": 1.7, "ext_ior": 1.0})
    for found, expected in zip(*(answers(b, "all", mi.TransportMode.Radiance) for b in (changed, fresh)), strict=True):
        assert np.abs(found - expected).max() < 2e-6 * max(1, np.abs(expected).max())


def test_every_part_of_plastic_follows_eta():
    """The diffuse lobe's derivative, of which the reflections inside of the coat are a part, is its slope."""
    plastic = mi.load_dict({"type": "psdr_plastic", "nonlinear": True, "diffuse_reflectance": PINK})
    params = mi.traverse(plastic)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0.6, 0, 0.8)

    def value() -> mi.Float:
        return plastic.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0.28, 0.96), mi.Bool(True)).x

    ends = []
    for eta in (1.5 - 0.01, 1.5 + 0.01):
        params["eta"] = eta
        params.update()
        ends.append(value()[0])
    params["eta"] = mi.Float(1.5)
    dr.enable_grad(params["eta"])
    params.update()
    dr.backward(value())
    slope = (ends[1] - ends[0]) / 0.02
    assert abs(dr.grad(params["eta"])[0] - slope) < 2e-3 * abs(slope)


def test_in_a_scene_file():
    xml = """<scene version="3.0.0"> <shape type="sphere" id="ball"> <bsdf type="psdr_dielectric">
             <string name="int_ior" value="water"/> <float name="ext_ior" value="1.0"/> </bsdf> </shape> </scene>"""
    params = mi.traverse(mi.load_string(xml))
    assert abs(params["ball.bsdf.eta"][0] - 1.333) < 1e-6


@pytest.mark.parametrize("kind", ["dielectric", "plastic"])
def test_in_other_variants(kind):
    for variant in ("llvm_ad_mono", "llvm_ad_spectral"):
        mi.set_variant(variant)
        expected = image({"type": kind})
        assert np.abs(image({"type": f"psdr_{kind}"}) - expected).max() < 1e-5 * expected.max()
    for variant, words in (("scalar_rgb", "does not track"), ("llvm_ad_spectral_polarized", "polarised light")):
        mi.set_variant(variant)
        with pytest.raises(RuntimeError, match=words):
            mi.load_dict({"type": f"psdr_{kind}"})


def test_impossible_indices_are_named():
    for options, words in (({"int_ior": -1.5}, "int_ior = -1.5"), ({"ext_ior": 0.0}, "ext_ior = 0")):
        with pytest.raises(RuntimeError, match=f"{words}.* positive"):
            mi.load_dict({"type": "psdr_dielectric", **options})
    with pytest.raises(RuntimeError, match="unobtainium"):
        mi.load_dict({"type": "psdr_plastic", "int_ior": "unobtainium"})
    assert issubclass(ParameterError, ValueError)
