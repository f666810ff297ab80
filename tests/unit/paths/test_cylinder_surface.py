"""Where attached rays meet cylinders: against the tangent plane, and against Mitsuba where its quadratic is sound."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.ad import tangents
from psdr_jit.core.memory import Memory
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.paths.surface_at import surface_at
from psdr_jit.scene.facts import analyse
from psdr_jit.scene.surfaces import surfaces_of

RADIUS, LANES = 0.02, 20_000
SHIFT = (0.6, 0.3, -0.5)
GRAZING = 3e-3  # cosine down to which directions of single precision mean something from 100 radii away
FIELDS = ("t", "p", "n", "uv", "dp_du", "dp_dv", "wi")


def thin_cylinder(flip: bool = False) -> mi.Scene:
    """About the x axis."""
    rod = {"type": "cylinder", "radius": RADIUS, "p0": [-1, 0, 0], "p1": [1, 0, 0], "flip_normals": flip}
    return mi.load_dict({"type": "scene", "rod": rod, "camera": {"type": "perspective"}})


def rays(distance: float) -> mi.Ray3f:
    """Rays from this far to all of the cylinder's width; from within it, if that is 0."""
    rng = np.random.default_rng(1)
    x, b = mi.Float(rng.uniform(-0.8, 0.8, LANES)), mi.Float(RADIUS * np.sin(rng.uniform(-np.pi, np.pi, LANES)))
    if distance == 0:
        o, d = mi.Point3f(x, 0.3 * b, 0.5 * b), mi.Vector3f(0.3, x, 0.5)
    else:
        o = mi.Point3f(0.1, 0.8 * distance, 0.6 * distance)
        d = mi.Point3f(x, 0.6 * b, -0.8 * b) - o
    return mi.Ray3f(mi.Point3f(o), mi.Vector3f(dr.normalize(d)), 0, [])


def of_both(scene: mi.Scene, ray: mi.Ray3f, how: dict, ray_moves: bool) -> tuple[list, np.ndarray]:
    """`([(values, tangents) of ours, of Mitsuba's], cosines of arrival)`: of `FIELDS`, where something is met."""
    pi = scene.ray_intersect_preliminary(ray)
    dr.eval(pi)  # before the scene changes: with CUDA it is built anew
    found = []
    for ours in (True, False):
        perturb(scene, "rod.to_world", **how).attach()
        surfaces = surfaces_of(scene, analyse(scene), Memory()) if ours else None
        with dr.resume_grad():
            o, d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
            dr.enable_grad(o, d)
            if ray_moves:
                dr.set_grad(o, mi.Vector3f(0.2, -0.1, 0.4))
                dr.set_grad(d, dr.cross(mi.Vector3f(-0.3, 0.2, 0.1), ray.d))
            si = surface_at(surfaces, pi, mi.Ray3f(o, d, 0, []), mi.RayFlags.All)
            values = [getattr(si, name) for name in FIELDS]
            grads = tangents(*values)
        found.append([(np.atleast_2d(np.array(dr.detach(v))), np.atleast_2d(np.array(g)))
                      for v, g in zip(values, grads, strict=True)])  # fmt: skip
    hit = np.array(pi.is_valid())
    found = [[(v[:, hit], g[:, hit]) for v, g in of] for of in found]
    return found, (found[0][FIELDS.index("n")][0] * np.array(ray.d)[:, hit]).sum(0)


def test_distances_are_those_of_the_tangent_plane(llvm):
    """Down to small cosines; Mitsuba's own would not pass."""
    (ours, mitsuba), cos_θ = of_both(thin_cylinder(), rays(100 * RADIUS), {"direction": SHIFT}, False)
    along = (ours[FIELDS.index("n")][0] * np.array(SHIFT)[:, None]).sum(0)  # the normal
    error, power = (np.abs(cos_θ * of[0][1][0] - along) for of in (ours, mitsuba))
    edge_on = (np.abs(cos_θ) > GRAZING) & (np.abs(cos_θ) < 0.03)
    assert edge_on.sum() > 100
    assert error[np.abs(cos_θ) > GRAZING].max() < 1e-3
    assert power[edge_on].max() > 0.1


@pytest.mark.parametrize("distance", [10 * RADIUS, 0], ids=["outside", "inside"])
@pytest.mark.parametrize("flip", [False, True], ids=["", "flipped"])
@pytest.mark.parametrize("how", [{"direction": SHIFT}, {"rotate": (0.2, 1.0, 0.3)}], ids=["shifted", "turned"])
def test_all_that_is_known_of_a_place_is_mitsubas(llvm, distance, flip, how):
    """Values and derivatives, where the ray meets it well; while it moves, and the ray with it."""
    (ours, mitsuba), cos_θ = of_both(thin_cylinder(flip), rays(distance), how, True)
    well = np.abs(cos_θ) > 0.5
    assert well.sum() > LANES / 10
    for name, of, theirs in zip(FIELDS, ours, mitsuba, strict=True):
        if name == "uv":  # where the angle jumps from 1 to 0, single precision may not agree on the side
            well = well & (np.abs(of[0][0] - 0.5) < 0.49)
        scale = np.abs(theirs[1][:, well]).max(0) + 0.1
        assert np.abs(of[0] - theirs[0])[:, well].max() < 2e-5, name
        assert (np.abs(of[1] - theirs[1])[:, well] / scale).max() < 2e-3, name
