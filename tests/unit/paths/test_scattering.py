"""The defensive mixture: its density is what is sampled, and its weight is f cosθ over that density."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

COUNT = 1 << 16
BSDFS = {
    "diffuse": {"type": "diffuse"},
    "two-sided": {"type": "twosided", "bsdf": {"type": "diffuse"}},
    "rough conductor": {"type": "roughconductor", "alpha": 0.3},
    "rough dielectric": {"type": "roughdielectric", "alpha": 0.3},
    "mirror": {"type": "conductor"},
    "plastic": {"type": "plastic"},
}


def interaction(below: bool) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    si.wi = dr.normalize(mi.Vector3f(0.5, 0.2, -0.7 if below else 0.7))
    si.t = dr.full(mi.Float, 1, COUNT)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    return si


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("name", BSDFS)
def test_mixture(variant, name, below):
    from psdr_jit.paths.scattering import PLAIN, UNIFORM_SHARE, Mixture, mixture_pdf, sample_scattering

    bsdf = mi.load_dict(BSDFS[name])
    si, ctx = interaction(below), mi.BSDFContext()
    rng = np.random.default_rng(0)
    u_lobe, u = mi.Float(rng.random(COUNT)), mi.Point2f(rng.random(COUNT), rng.random(COUNT))
    pointer = mi.BSDFPtr(bsdf)
    s = sample_scattering(ctx, si, pointer, u_lobe, u, Mixture(UNIFORM_SHARE), False, mi.Bool(True))
    plain = sample_scattering(ctx, si, pointer, u_lobe, u, PLAIN, False, mi.Bool(True))

    # both estimate the albedo
    estimate, expected = (np.array(x.weight.x, dtype=float) * np.ones(COUNT) for x in (s, plain))
    error = np.hypot(estimate.std(), expected.std()) / np.sqrt(COUNT)
    assert abs(estimate.mean() - expected.mean()) < 6 * error + 1e-6

    smooth = ~np.array(s.delta) & (np.array(s.pdf) > 0)
    f, pdf = bsdf.eval_pdf(ctx, si, s.wo)
    mixed = np.array(mixture_pdf(si, pointer, s.wo, pdf, Mixture(UNIFORM_SHARE))) * np.ones(COUNT)
    assert np.allclose(mixed[smooth], np.array(s.pdf)[smooth], rtol=1e-4)
    assert np.allclose((np.array(f.x) * np.ones(COUNT))[smooth] / mixed[smooth], estimate[smooth], rtol=1e-3, atol=1e-6)
    # the density integrates to one over the directions that it can give
    if "mirror" not in name and "plastic" not in name and estimate.any():
        sphere = mi.warp.square_to_uniform_sphere(u)
        _, pdf = bsdf.eval_pdf(ctx, si, sphere)
        mass = np.array(mixture_pdf(si, pointer, sphere, pdf, Mixture(UNIFORM_SHARE))) * 4 * np.pi
        assert abs(mass.mean() - 1) < 6 * mass.std() / np.sqrt(COUNT) + 0.03  # microfacet sampling loses a little


@pytest.mark.parametrize("share", [0.0, 0.25])
def test_refused_directions_do_not_go_on(variant, share):
    """From inside at 45 degrees a rough dielectric refuses a part of what it samples: f / pdf is not its weight."""
    from psdr_jit.paths.scattering import Mixture, sample_scattering

    bsdf = mi.load_dict({"type": "roughdielectric", "alpha": 0.3})
    si, ctx = interaction(below=True), mi.BSDFContext()
    si.wi = dr.normalize(mi.Vector3f(0.7, 0, -0.7))
    rng = np.random.default_rng(1)
    u_lobe, u = mi.Float(rng.random(COUNT)), mi.Point2f(rng.random(COUNT), rng.random(COUNT))
    pointer = mi.BSDFPtr(bsdf)
    _, weight = bsdf.sample(ctx, si, u_lobe, u)
    expected = np.array(weight.x, dtype=float)
    s = sample_scattering(ctx, si, pointer, u_lobe, u, Mixture(share), True, mi.Bool(True))
    f = np.array(bsdf.eval(ctx, si, s.wo).x, dtype=float)
    pdf = np.array(s.pdf)
    ratio = np.divide(f, pdf, out=np.zeros(COUNT), where=pdf > 0)  # what a path that goes on makes of it
    error = np.hypot(ratio.std(), expected.std()) / np.sqrt(COUNT)
    assert abs(ratio.mean() - expected.mean()) < 6 * error
    refused = (expected == 0) & (np.array(bsdf.eval(ctx, si, bsdf.sample(ctx, si, u_lobe, u)[0].wo).x) > 0)
    assert refused.mean() > 0.01, "the case does not occur, the test shows nothing"


def test_frames_of_triangles_in_one_plane_agree(variant):
    """Equal random numbers must lead into equal directions on either side of an edge that one does not see."""
    from psdr_jit.paths.bounce import PathLimits
    from psdr_jit.paths.rays import interaction

    def at(pi, ray, own: bool) -> mi.SurfaceInteraction3f:
        return interaction(pi, ray, PathLimits(2, 5, own_frames=own))

    mesh = mi.Mesh("square", 4, 2)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0]
    params["faces"] = [0, 1, 2, 3, 0, 2]
    params.update()
    scene = mi.load_dict({"type": "scene", "square": mesh})
    ray = mi.Ray3f(mi.Point3f([0.7, 0.3], [0.3, 0.7], [1, 1]), mi.Vector3f(0, 0, -1))
    pi = scene.ray_intersect_preliminary(ray)
    tangents = [np.array(at(pi, ray, own).sh_frame.s).T for own in (True, False)]
    assert not np.allclose(tangents[0][0], tangents[0][1]), "Mitsuba's frames agree: the test shows nothing"
    assert np.allclose(tangents[1][0], tangents[1][1])
    for own in (True, False):
        si = at(pi, ray, own)
        assert np.allclose(np.array(si.to_world(si.wi)).T, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("kind", ["dielectric", "thindielectric"])
@pytest.mark.parametrize("grazing", [False, True])
def test_two_delta_lobes_share_even_choices(variant, kind, grazing):
    """Each is chosen as often as is said; both are worth what they are; in total reflection there is one."""
    from psdr_jit.paths.scattering import UNIFORM_SHARE, Mixture, sample_scattering

    si, ctx = interaction(below=grazing), mi.BSDFContext()
    if grazing:  # from inside, beyond the critical angle of glass
        si.wi = dr.normalize(mi.Vector3f(0.9, 0.2, -0.3))
    rng = np.random.default_rng(0)
    u_lobe, u = mi.Float(rng.random(COUNT)), mi.Point2f(rng.random(COUNT), rng.random(COUNT))
    bsdf = mi.load_dict({"type": kind})
    pointer = mi.BSDFPtr(bsdf)
    s = sample_scattering(ctx, si, pointer, u_lobe, u, Mixture(UNIFORM_SHARE), False, mi.Bool(True))
    same_side = np.array(s.wo.z * si.wi.z) > 0
    pdf, weight = np.array(s.pdf), np.array(s.weight)[0]
    assert np.array(s.delta).all()
    plain, worth = pointer.sample(ctx, si, mi.Float(0.0), mi.Point2f(0.5))
    F = float(np.array(plain.pdf)[0])
    for lobe, value in ((same_side, F * float(np.array(worth)[0][0])), (~same_side, None)):
        if not lobe.any():
            assert F == 1
            continue
        assert lobe.mean() == pytest.approx(pdf[lobe][0], abs=0.01)
        assert pdf[lobe].min() >= UNIFORM_SHARE / 2
        if value is not None:
            np.testing.assert_allclose(weight[lobe] * pdf[lobe], value, rtol=1e-5)
    expected = np.array(pointer.sample(ctx, si, u_lobe, u)[1])[0].mean()
    assert weight.mean() == pytest.approx(expected, rel=0.02)
