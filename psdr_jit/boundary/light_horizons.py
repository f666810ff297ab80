"""Boundary segments along the planes of the faces of smooth-shaded lights.

Mitsuba samples such a light as if its faces were turned as their shading normals n_s are (`paths/smooth_lights.py`).
What a receiver x_D is lit by from the point y of a face does then not fade with the cosine of the face as x_D sinks
into its plane, from above which it is seen: it steps, by

    L_e(y→x_D) f cos_D |n_s·ω| w_e / r²,        w_e = p_e² / (p_b² + p_e²) the weight of the emitter sample, ρ = ∞.

In the plane of a face, with y uniform on it and the angle φ of the direction ω away from it, the étendue of y and x_D
per height δ of the plane is |n_s·ω| dA dφ δ/r: a line element dl of the receiver across ω spans r dφ = dl |τ·ω_perp|,
and the strip of it that the plane sweeps is dA_D cos_D = r dφ δ. Hence, with n_⊥ = ±n_g towards the side that is lit,

    − ∫dA ∫dφ (1/r) |n_s·ω| w_e L_e · W · n_⊥·[ v_B − u_D ],

v_B the velocity of the plane at x_D (that of the face's corners, extended): the boundary integral of an edge
(`direct.py`) with x_B at x_D. Derived here; for flat shading n_s·ω is 0.

w_e depends on where the path goes on from x_D through p_b, where that is not diffuse. Here it goes to the sensor, as
most do.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.compaction import compact
from ..core.records import Hit
from ..core.streams import Stream
from ..edges.followed_lights import is_followed
from ..edges.horizons import HorizonPoint
from ..edges.location import EdgeLocation
from ..paths.smooth_lights import pdf_of_sample
from ..paths.walk import mis_weight
from ..plan.job import Job
from ..sampling.horizons import SampledHorizons
from ..sampling.light_horizons import sampled_light_horizons
from .horizons import HorizonLine, partner_agrees, per_length, receiver, sample_lines, sides
from .segment_motion import BoundarySamples, SecondaryTerm
from .sensor_subpath import Receivers, longest_from_light, subpaths
from .towards_sensor import facing_sensor


@dataclass
class LitPlane:
    """A point of a light and a receiver x_D in the plane of its face; detached, one entry per kept side."""

    lane: mi.UInt32
    at: EdgeLocation  # x_D as a point of the plane
    ω: mi.Vector3f  # from x_D to the light
    n_perp: mi.Vector3f  # the face's normal on the side that is lit
    receiver: Hit  # x_D as the end of a ray from beside the light
    value: mi.Spectrum  # over the density
    wavelengths: mi.Color0f


def sample(job: Job, horizons: SampledHorizons) -> HorizonLine:
    """Away from lights."""
    return sample_lines(job, horizons, 1, Stream.LIGHT_HORIZON)


def trace(job: Job, horizons: SampledHorizons, line: HorizonLine) -> LitPlane | None:
    """The sides on which something is lit."""
    found = sides(job, line)
    if found is None:
        return None
    line, on = found.line, found.line.on
    towards = dr.select(found.which == 0, -1.0, 1.0)
    light = _light(on, towards)
    active = found.pi.is_valid() & ~partner_agrees(found.pi) & ~is_followed(job, light.emitter(job.scene), True)
    L = light.emitter(job.scene).eval(light, active)
    active &= dr.any(L != 0)
    value = -L * line.weight * (_weighed_cosine(job, found.ray, found.pi, light, active) / line.pdf)
    lit = LitPlane(
        lane=line.lane,
        at=EdgeLocation(line.row, line.t, on.x + found.pi.t * on.ω, mi.Point3f(0), mi.Float(0)),
        ω=-on.ω,
        n_perp=on.n * towards,
        receiver=Hit.of(found.ray, found.pi),
        value=value * per_length(on, found.pi.t),
        wavelengths=line.wavelengths,
    )
    return compact(lit, active & dr.any(value != 0))


def _light(on: HorizonPoint, towards: mi.Float) -> mi.SurfaceInteraction3f:
    """y, as it is met from just beside its plane."""
    hit, _ = receiver(on, towards)
    return hit.intersection().compute_surface_interaction(mi.Ray3f(hit.o, hit.d), mi.RayFlags.All)


def _weighed_cosine(job: Job, ray: mi.Ray3f, pi, light: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
    """|n_s·ω| w_e, the path going on from x_D to the sensor."""
    si = facing_sensor(job, pi.compute_surface_interaction(ray, mi.RayFlags.All, active))
    p_e = pdf_of_sample(job.scene, si, light, -ray.d, active)
    p_b = si.bsdf().pdf(mi.BSDFContext(), si, si.to_local(-ray.d), active)
    return dr.abs_dot(light.sh_frame.n, ray.d) * mis_weight(p_e, p_b)


def evaluate(job: Job, horizons: SampledHorizons, lit: LitPlane) -> BoundarySamples:
    """What they are worth at the sensor: their subpaths are recorded."""
    receivers = Receivers(lit.lane, lit.receiver, lit.wavelengths, lit.value, -lit.n_perp, mi.Vector3f(0))
    records = subpaths(job, Stream.LIGHT_HORIZON_SUBPATH, receivers, longest_from_light(job))
    return BoundarySamples.of(lit, records, records.left_by_smooth_lobes(records.data.W))


#: Planes of the faces of lights.
LIGHT_HORIZONS = SecondaryTerm(
    edges=sampled_light_horizons,
    longest=longest_from_light,
    sample=sample,
    trace=trace,
    evaluate=evaluate,
)
