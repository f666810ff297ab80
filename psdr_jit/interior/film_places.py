"""What paths bring next to film positions that move: the second integral of the *film* form (`plan/film_flow.py`),

    ∫ f (∇h·w + h div w) dp ≈ (1/n) Σ_i f_i (∇h·w + h div w)(p_i)

over the n samples p_i of the interior term, uniform in their pixels, whose radiance f_i its sweeps know. It is the
derivative of Σ f_i h(p_i + θ w) (1 + θ div w), which is how it is computed, so that both modes share it. What the film
divides by is a constant here, the mass of the filter (`films.develop_boundary`). A box filter has a slope at borders of
pixels alone, which is `film_borders`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import backpropagate, tangents
from ..core.varying import varying
from ..paths.recording import PathRecords
from ..plan.job import Job
from .camera_pass import CameraPass


def turned(job: Job, p: CameraPass) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Displacements `(of the origin, of the direction)` of a pass's camera rays as their places move, attached."""
    shift, _ = job.film_flow.at(p.p)
    return p.per_px.moved(shift)


def _image(job: Job, p: CameraPass, records: PathRecords, L: mi.Spectrum) -> mi.TensorXf:
    """Image of the radiance `L` of the paths of a pass, attached to where they are on the film."""
    shift, div = job.film_flow.at(p.p)
    share = p.at.weight * (1 + div) / varying(mi.Float, p.samples.spp)
    seen = records.vertex(mi.UInt32(0), records.count > 0).hit.shape != 0
    alpha = share if job.sky_is_seen else dr.select(seen, share, 0)
    return films.develop_boundary(
        job.film, p.at.p + shift, L * p.weight * share, alpha, records.wavelengths, mi.Bool(True)
    )


def forward(job: Job, p: CameraPass, records: PathRecords, L: mi.Spectrum) -> mi.TensorXf:
    """Derivative image. Detached."""
    with dr.resume_grad(job.film_flow.nodes):
        return tangents(_image(job, p, records, L))


def backward(job: Job, p: CameraPass, records: PathRecords, L: mi.Spectrum, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the flow."""
    with dr.resume_grad(job.film_flow.nodes):
        backpropagate(_image(job, p, records, L), grad_in)
