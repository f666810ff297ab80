"""Steps of AOVs along the edges that the sensor sees directly: `primary` with another integrand.

The derivative of the image receives (A_− − A_+) · s·(v_B − u) · |dx/dt × ω| / J_px / pdf(t), where A_∓ is the AOV of
what lies on the side −s and +s of the edge; 0 of nothing. Lines inside a surface at which only what it sends steps,
those of patterns and of shading normals, are left out: no AOV steps there, but each would differ by the distance of
the two points at which the sides are looked at.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, backpropagate, tangents
from ..edges.scene_table import scene_edges
from ..edges.table import look_beside
from ..paths.aovs import Aovs
from ..paths.surface_at import surface_at
from ..plan.job import Job
from ..sampling.film_edges import FilmEdges, film_edges, film_weights
from . import primary


def _edges(job: Job) -> FilmEdges | None:
    """Those of the primary term without those at which no more than the shade of one surface steps."""
    kinds = scene_edges(job).kinds
    if not any(kind.shades_only for kind in kinds):
        return film_edges(job, primary.NAME, lambda: film_weights(job))
    return film_edges(job, f"{primary.NAME}/surfaces", lambda: [
        dr.zeros(mi.Float, kind.count) if kind.shades_only else weights
        for kind, weights in zip(kinds, film_weights(job), strict=True)
    ])  # fmt: skip


def _jumps(job: Job, aovs: Aovs, edges: FilmEdges, sample: primary.EdgeSample) -> list[mi.Float]:
    """A_− − A_+ of every sample, by channel."""
    n = dr.width(sample.row)
    index = dr.arange(mi.UInt32, 2 * n)
    which, s = index & 1, dr.gather(primary.EdgeSample, sample, index >> 1)
    seen = primary.seen_edge(job, edges, s)
    ray, pi, differs = look_beside(job.scene, edges.table, seen.sight, which, dr.zeros(mi.Color0f), coherent=True)
    si = surface_at(job.surfaces, pi, ray, mi.RayFlags.All, differs)
    values = [dr.select(differs, value, 0) for value in aovs.values(si, seen.view.o)]
    dr.eval(values)
    even = 2 * dr.arange(mi.UInt32, n)
    return [dr.gather(mi.Float, value, even) - dr.gather(mi.Float, value, even + 1) for value in values]


def _steps(job: Job, aovs: Aovs) -> tuple[FilmEdges, primary.Steps, list[mi.Float]] | None:
    """Samples, and their contributions per unit of motion by channel; None if there are none."""
    edges = _edges(job)
    sample = None if edges is None else primary.sample_visible(job, edges)
    if sample is None:
        return None
    jumps = _jumps(job, aovs, edges, sample)
    seen = primary.seen_edge(job, edges, sample)
    scale = primary.per_motion(seen, sample)
    steps = primary.steps_at(job, edges, seen, sample, (mi.Spectrum(0), mi.Float(0), dr.zeros(mi.Color0f)))
    values = [jump * scale for jump in jumps]
    sound = dr.all([dr.isfinite(value) for value in values])
    job.call.counters.rejected.count(~sound)
    return edges, steps, [dr.select(sound, value, 0) for value in values]


def _splat(job: Job, aovs: Aovs, steps: primary.Steps, values: list[mi.Float], motion: mi.Float) -> mi.TensorXf:
    moved = [value * motion for value in values]
    return films.develop_boundary_channels(job.film, aovs.channels, steps.p, moved, steps.valid)


def forward(job: Job, aovs: Aovs) -> mi.TensorXf | float:
    """Derivative image (H, W, K) along the tangents set on the scene's parameters; 0 without edges."""
    with dr.suspend_grad():
        found = _steps(job, aovs)
        if found is None:
            return 0.0
        edges, steps, values = found
        with job.motion.attached() as moving:
            motion = tangents(primary.motion_across(job, edges, steps, moving))
        return _splat(job, aovs, steps, values, motion)


def backward(job: Job, aovs: Aovs, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters."""
    with dr.suspend_grad():
        found = _steps(job, aovs)
        if found is None:
            return
        edges, steps, values = found
        with dr.resume_grad():
            motion = dr.zeros(mi.Float, dr.width(steps.p))
            dr.enable_grad(motion)
            backpropagate(_splat(job, aovs, steps, values, motion), grad_in)
            λ = dr.grad(motion)
        dr.eval(λ, steps)
        with job.motion.attached() as moving:
            accumulate(λ * primary.motion_across(job, edges, steps, moving))
