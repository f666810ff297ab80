"""What paths bring across borders of pixels as film positions move: of a *box* filter, most of the second integral of
the *film* form (`plan/film_flow.py`).

The filter h of a pixel P is 1 inside of it, and ∇h = −n δ at its border, n pointing outwards. So

    ∫ f (∇h·w + h div w) dp = ∫_P f div w dp − ∮_∂P f w·n dl,

of which `film_places` has the first. As to the second, neighbours share their border: with e across it, from the one to
the other, one loses and the other gains ∫ f w·e dl. That is estimated by samples stratified along every border that may
move, f being the radiance of paths of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import backpropagate, tangents
from ..core.camera_rays import RayNumbers, rays_at
from ..core.low_discrepancy import lane_sampler
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from ..paths.walk import NoSink, first_hit, walk
from ..plan.job import Job, passes

#: Samples of a border, relative to those of a pixel; a pixel has two borders of its own.
BORDER_SHARE = 0.25

#: Memory of a sample: its ray, place and radiance.
BYTES = 64


@dataclass
class Crossings:
    """Samples on borders of pixels. Detached."""

    p: mi.Point2f  # [px]
    across: mi.Vector2f  # unit, from one pixel to the other
    value: mi.Spectrum  # radiance, by the number of samples of a border
    alpha: mi.Float  # the same of the coverage
    wavelengths: mi.Color0f


def matter(job: Job) -> bool:
    """Do film positions move, under a filter whose only slope is at borders of pixels?"""
    return job.film_flow is not None and job.film.rfilter().is_box_filter()


def _borders(job: Job) -> tuple[mi.UInt32, mi.Bool]:
    """`(first corner, upright?)` of the borders that may move, the film's own left out, which rests."""
    flow = job.film_flow
    lower, upper = films.sampled_window(job.film)
    columns, rows = (int(n) for n in upper - lower)
    n = (columns + 1) * (rows + 1)
    k = dr.arange(mi.UInt32, 2 * n) % varying(mi.UInt32, n)
    upright = dr.arange(mi.UInt32, 2 * n) < n
    x, y = k % flow.columns, k // flow.columns
    x_end, y_end = varying(mi.UInt32, columns), varying(mi.UInt32, rows)
    inner = dr.select(upright, (x > 0) & (x < x_end) & (y < y_end), (y > 0) & (y < y_end) & (x < x_end))
    last = k + dr.select(upright, flow.columns, 1)
    moves = dr.gather(mi.Bool, flow.follows, k, inner) | dr.gather(mi.Bool, flow.follows, last, inner)
    chosen = dr.compress(inner & moves)
    return dr.gather(mi.UInt32, k, chosen), dr.gather(mi.Bool, upright, chosen)


def _crossings(job: Job) -> Crossings | None:
    """None where no border may move."""
    first, upright = _borders(job)
    borders = dr.width(first)
    if borders == 0:
        return None
    per_border = max(1, round(BORDER_SHARE * job.spp))
    count, lane = varying(mi.UInt32, per_border), dr.arange(mi.UInt32, borders * per_border)
    border, step = lane // count, lane % count
    k, upright = dr.gather(mi.UInt32, first, border), dr.gather(mi.Bool, upright, border)
    across = mi.Vector2f(dr.select(upright, 1, 0), dr.select(upright, 0, 1))

    flow, sensor = job.film_flow, job.sensor
    rng = lane_sampler(stream_seed(job.seed, Stream.FILM_BORDER), lane)
    t = (step + rng.next_1d()) / mi.Float(count)
    p = mi.Point2f(k % flow.columns, k // flow.columns) + flow.corner + t * (1 - across)
    ray, weight = rays_at(sensor, p, RayNumbers.draw(sensor, rng))
    ray, weight = mi.Ray3f(dr.detach(ray)), dr.detach(weight) / mi.Float(count)
    ray, pi, emission = first_hit(job.scene, ray, job.options.hide_emitters)
    L, _, surface = walk(job.scene, rng, ray, pi, job.limits, NoSink(), emission, mi.Bool(True))
    alpha = mi.Float(1) if job.sky_is_seen else dr.select(surface, mi.Float(1), 0)
    value = job.call.counters.rejected.keep_finite(L) * weight
    found = Crossings(p, across, value, alpha / mi.Float(count), ray.wavelengths)
    dr.eval(found)
    return found


def _image(job: Job, c: Crossings) -> mi.TensorXf:
    """Image of what is on either side of the borders, attached to how they move, of value 0."""
    shift, _ = job.film_flow.at(c.p)
    crossed = dr.dot(c.across, shift)

    def gained(side: int) -> mi.TensorXf:
        beside, share = c.p + 0.5 * side * c.across, side * crossed
        return films.develop_boundary(
            job.film, beside, c.value * share, c.alpha * share, c.wavelengths, mi.Bool(True)
        )

    return gained(1) + gained(-1)


def forward(job: Job) -> mi.TensorXf:
    """Derivative image. Detached."""
    image = films.black(job.film)
    for share, part in passes(job, BYTES):
        found = _crossings(part)
        if found is not None:
            with dr.resume_grad(job.film_flow.nodes):
                image += share * tangents(_image(part, found))
    return image


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the flow."""
    for share, part in passes(job, BYTES):
        found = _crossings(part)
        if found is not None:
            with dr.resume_grad(job.film_flow.nodes):
                backpropagate(_image(part, found), share * grad_in)
