"""Boundary segments along the planes of coarse smooth-shaded faces: how they are drawn, and what they end at.

`edges/horizons.py` derives them. A segment starts at its receiver x_D, a point of the face, and two rays from just
above and just below the face look for its source. Particles that arrive at x_D along the face carry no flux and have
infinite importance: they are taken a small angle off the plane, with the cosine as a factor, which cancels.

Where a face cuts into another surface, its plane meets that surface in the line of contact. There 1/r goes to infinity,
and in the material form the interior term goes to the opposite infinity, up to the height at which Mitsuba lifts its
rays. So rays are lifted as much here, and r is cut off as there (`per_length`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.compaction import compact
from ..core.line_guide import Drawn
from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.streams import Stream, stream_seed
from ..edges.followed_lights import is_followed
from ..edges.horizons import HorizonPoint
from ..edges.kind import Sight
from ..edges.location import EdgeLocation
from ..paths.smooth_lights import has_smooth_lights
from ..paths.surface_at import surface_at
from ..plan.job import Job
from ..sampling.horizons import SampledHorizons, sampled_horizons
from ..sampling.rows import edge_samples
from .edge_lines import EdgeView
from .indirect_material import Background
from .segment_motion import BoundarySamples, SecondaryTerm
from .sensor_subpath import Receivers, longest_from_light, subpaths
from .towards_sensor import share_towards_sensor

#: Sine of the angle to its plane at which a face is met: far above rounding, far below those between its normals.
TILT = 3e-4

#: Share of the samples of a term: the noise of horizons is a tenth to a half of that of edges, with as many samples.
SHARE = 0.15

#: Two rays that end this close to each other, relative to their length, end at the same point.
SAME_END = 1e-3


@dataclass
class HorizonLine:
    """A point of a face and a direction in its plane; detached, one entry per sample."""

    lane: mi.UInt32
    row: mi.UInt32
    t: mi.Float
    on: HorizonPoint
    pdf: mi.Float  # times the number of samples
    wavelengths: mi.Color0f
    weight: mi.Spectrum  # of the wavelengths


@dataclass
class LitHorizon:
    """x_D and a point x_S of a light in the plane of its face; detached, one entry per kept side."""

    lane: mi.UInt32
    at: EdgeLocation  # x_S as a point of the plane; of a sky, some point on the way
    ω: mi.Vector3f  # from x_D to x_S
    n_perp: mi.Vector3f  # the face's normal on the side that is lit
    source: Hit  # x_S as the end of a ray beside the face; no shape under a sky
    receiver: Hit
    ratio: mi.Float  # r_B / r_S: 1, or 0 under a sky
    value: mi.Spectrum  # over the density
    wavelengths: mi.Color0f


def shared_out(job: Job, horizons: SecondaryTerm, others: list[SecondaryTerm]) -> list[tuple[SecondaryTerm, Job]]:
    """The parts of a term that have anything to sample, each with its share of the samples."""
    with dr.suspend_grad():
        there = horizons.edges(job) is not None
        others = [part for part in others if part.edges(job) is not None]
    ours = max(1, round(job.spp * (SHARE if others else 1))) if there else 0
    each = max(1, (job.spp - ours) // max(1, len(others)))
    found = [(part, replace(job, spp=each)) for part in others]
    return [(horizons, replace(job, spp=ours)), *found] if there else found


def sample_lights(job: Job, horizons: SampledHorizons) -> HorizonLine:
    """Towards lights."""
    return sample_lines(job, horizons, 1, Stream.HORIZON)


def sample_views(job: Job, horizons: SampledHorizons) -> HorizonLine:
    """For the indirect term, of which a sample takes two paths."""
    return sample_lines(job, horizons, 2, Stream.HORIZON_VIEW)


def sample_lines(job: Job, horizons: SampledHorizons, paths: int, stream: Stream) -> HorizonLine:
    """As many as a term has samples that take `paths` paths each."""
    count = edge_samples(job, paths=paths)
    lane = dr.arange(mi.UInt32, count)
    rng = lane_sampler(stream_seed(job.seed, stream), lane)
    row, t, pdf_row = horizons.sample_rows(count, rng.next_1d())
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    on = horizons.table.draw(row, t, rng.next_2d())
    return HorizonLine(lane, row, t, on, on.pdf * pdf_row, wavelengths, weight)


def receiver(on: HorizonPoint, towards: mi.Float | float = 1.0) -> tuple[Hit, mi.Float]:
    """The point of the face as the end of a ray that meets it at a small angle, and the cosine of that angle.

    `towards`: 1 from above the face, -1 from below.
    """
    ω = dr.normalize(on.ω + TILT * towards * on.n)
    pi = mi.PreliminaryIntersection3f(on.pi)
    return Hit.of(mi.Ray3f(on.x + on.size * ω, -ω), pi), dr.abs(dr.dot(on.n, ω))


def beside(on: HorizonPoint, which: mi.UInt32, wavelengths) -> mi.Ray3f:
    """The ray just below (0) or above (1) the face."""
    return mi.Ray3f(on.x + dr.select(which == 0, -1.0, 1.0) * on.offset * on.n, on.ω, 0, wavelengths)


@dataclass
class HorizonSides:
    """Both sides of lines, one after the other, and what lies there; detached."""

    line: HorizonLine
    which: mi.UInt32  # 0: below the face, 1: above it
    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f


def sides(job: Job, line: HorizonLine) -> HorizonSides | None:
    """Both sides of the valid lines; None if there are none."""
    line = compact(line, line.on.valid)
    if line is None:
        return None
    index = dr.arange(mi.UInt32, 2 * dr.width(line.lane))
    which, both = index & 1, dr.gather(HorizonLine, line, index >> 1)
    ray = beside(both.on, which, both.wavelengths)
    return HorizonSides(both, which, ray, job.scene.ray_intersect_preliminary(ray, coherent=False))


def per_length(on: HorizonPoint, r: mi.Float) -> mi.Float:
    """1/r_B of a source at the distance r along a lifted ray: r²/ρ³, ρ its distance from x_D itself."""
    far2 = dr.square(r) + dr.square(on.offset)
    return dr.square(r) / (far2 * dr.sqrt(far2))


def partner_agrees(pi: mi.PreliminaryIntersection3f) -> mi.Bool:
    """Do both sides end at the same point? Then nothing steps there. Lanes as of `sides`. Evaluates."""
    t, code = dr.select(pi.is_valid(), pi.t, 0), Hit.of(mi.Ray3f(0, 0), pi).shape
    dr.eval(t, code)
    other = dr.arange(mi.UInt32, dr.width(t)) ^ 1
    same = dr.gather(mi.UInt32, code, other) == code
    return same & (dr.abs(dr.gather(mi.Float, t, other) - t) <= SAME_END * t)


def trace_lights(job: Job, horizons: SampledHorizons, line: HorizonLine) -> LitHorizon | None:
    """The sides on which the light is seen that was asked for."""
    found = sides(job, line)
    if found is None:
        return None
    line, which, ray, pi = found.line, found.which, found.ray, found.pi
    on = line.on
    si = surface_at(job.surfaces, pi, ray, mi.RayFlags.All)
    emitter = si.emitter(job.scene)
    wanted = dr.gather(mi.UInt32, horizons.table.targets.emitter, on.target)
    met = dr.reinterpret_array(mi.UInt32, emitter)
    active = ~is_followed(job, emitter, met != 0)
    active &= (met != 0) & ((wanted == 0) | (met == wanted)) & ~partner_agrees(pi)
    L = dr.select(active, emitter.eval(si, active), 0)
    finite = pi.is_valid()
    r = dr.select(finite, pi.t, on.size)
    end, cos = receiver(on)
    if has_smooth_lights(job.facts):
        L *= share_towards_sensor(job, end, si, on.ω, active)[0]
    lit = LitHorizon(
        lane=line.lane,
        at=EdgeLocation(line.row, line.t, on.x + r * on.ω, mi.Point3f(0), mi.Float(0)),
        ω=on.ω,
        n_perp=on.n * dr.select(which == 0, -1.0, 1.0),
        source=Hit.of(ray, pi),
        receiver=end,
        ratio=dr.select(finite, 1.0, 0.0),
        value=-L * line.weight * (cos * per_length(on, r) / line.pdf),
        wavelengths=line.wavelengths,
    )
    return compact(lit, active & dr.any(L != 0))


def evaluate_lights(job: Job, horizons: SampledHorizons, lit: LitHorizon) -> BoundarySamples:
    """What they are worth at the sensor: their subpaths are recorded."""
    a, still = -(1 - lit.ratio) * lit.n_perp, mi.Vector3f(0)
    receivers = Receivers(lit.lane, lit.receiver, lit.wavelengths, lit.value, a, still)
    records = subpaths(job, Stream.HORIZON_SUBPATH, receivers, longest_from_light(job))
    value = records.left_by_smooth_lobes(records.data.W)
    return BoundarySamples.of(
        lit, records, value, lambda moving: -lit.ratio * dr.dot(lit.n_perp, moving.of_surface(lit.source))
    )


def view(line: HorizonLine, r: mi.Float) -> EdgeView:
    """The lines as those through edge points at the distance r from x_D, for the indirect term."""
    on = line.on
    end, cos = receiver(on)
    at = EdgeLocation(line.row, line.t, on.x + r * on.ω, mi.Point3f(0), mi.Float(0))
    # with the distance as lead, rays beside the edge start at x_D
    sight = Sight(at, on.ω, r, on.n, on.offset, lead=r)
    value = line.weight * (cos * per_length(on, r))
    return EdgeView(line.lane, sight, end, value, line.pdf, line.wavelengths, Drawn.otherwise())


def trace_views(job: Job, horizons: SampledHorizons, line: HorizonLine) -> EdgeView | None:
    """Spatial form: all of them; their sides are traced once it is known that the sensor sees them."""
    return compact(view(line, line.on.size), line.on.valid)


def trace_backgrounds(job: Job, horizons: SampledHorizons, line: HorizonLine) -> Background | None:
    """Material form: the surfaces that end above or below a face."""
    s = sides(job, line)
    if s is None:
        return None
    r = dr.select(s.pi.is_valid(), s.pi.t, s.line.on.size)
    found = Background(view(s.line, r), Hit.of(s.ray, s.pi), mi.Float(1), dr.select(s.which == 0, 1.0, -1.0))
    return compact(found, s.pi.is_valid() & ~partner_agrees(s.pi))


#: Horizons before lights.
LIGHTS = SecondaryTerm(
    edges=lambda job: sampled_horizons(job, "direct", direct=True),
    longest=longest_from_light,
    sample=sample_lights,
    trace=trace_lights,
    evaluate=evaluate_lights,
)
