"""What paths bring next to film positions that move: the second integral of the *film* form (`plan/film_flow.py`),

    ∫ f (∇h·w + h div w) dp ≈ (1/n) Σ_i f_i (∇h·w + h div w)(p_i)

over the n samples p_i of the interior term, uniform in their pixels, whose radiance f_i its sweeps know. It is the
derivative of Σ f_i h(p_i + θ w) (1 + θ div w), which is how it is computed, so that both modes share it. What the film
divides by is a constant here, the mass of the filter (`films.develop_boundary`). A box filter has a slope at borders of
pixels alone, which is `film_borders`. Paths that light subpaths find (`light_traced`) are splatted where they land.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import backpropagate, tangents
from ..core.camera_rays import RayPerPixel
from ..core.varying import varying
from ..paths.recording import PathRecords
from ..plan.job import Job
from .camera_pass import CameraPass


def _turned(job: Job, p: mi.Point2f, per_px: RayPerPixel) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Displacements `(of the origin, of the direction)` of the camera rays of the places `p` as these move, attached.

    `per_px`: of these rays.
    """
    shift, _ = job.film_flow.at(p)
    return per_px.moved(shift)


def camera_tangents(
    job: Job, ray: mi.Ray3f, p: mi.Point2f, per_px: RayPerPixel | None
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """`(ȯ, ḋ)` of the attached camera rays of the places `p`, detached. `per_px`: of these, where places move."""
    o_grad, d_grad = job.motion.camera_tangents(ray)
    if job.film_flow is None:
        return o_grad, d_grad
    with dr.resume_grad(job.film_flow.nodes):
        o, d = tangents(*_turned(job, p, per_px))
    return o_grad + o, d_grad + d


def camera_adjoint(
    job: Job, ray: mi.Ray3f, p: mi.Point2f, per_px: RayPerPixel | None, λ: tuple[mi.Vector3f, mi.Vector3f]
) -> mi.Float:
    """⟨λ_o, o⟩ + ⟨λ_d, d⟩ of the same rays, attached: the transpose of `camera_tangents`."""
    λ_o, λ_d = λ
    adjoint = dr.dot(ray.o, λ_o) + dr.dot(ray.d, λ_d)
    if job.film_flow is None:
        return adjoint
    o, d = _turned(job, p, per_px)
    return adjoint + dr.dot(o, λ_o) + dr.dot(d, λ_d)


def of_samples(job: Job, p: CameraPass, records: PathRecords, L: mi.Spectrum) -> mi.TensorXf:
    """Image of the radiance `L` of the paths of a pass, attached to where they are on the film."""
    shift, div = job.film_flow.at(p.p)
    share = p.at.weight * (1 + div) / varying(mi.Float, p.samples.spp)
    seen = records.vertex(mi.UInt32(0), records.count > 0).hit.shape != 0
    alpha = share if job.sky_is_seen else dr.select(seen, share, 0)
    return films.develop_boundary(
        job.film, p.at.p + shift, L * p.weight * share, alpha, records.wavelengths, mi.Bool(True)
    )


def of_splats(job: Job, p: mi.Point2f, value: mi.Spectrum, wavelengths, active: mi.Bool) -> mi.TensorXf:
    """Image of values that are splatted at `p` [px], attached to where that is."""
    shift, div = job.film_flow.at(p)
    return films.develop_boundary(job.film, p + shift, value * (1 + div), mi.Float(0), wavelengths, active)


def forward(job: Job, image: Callable[[], mi.TensorXf]) -> mi.TensorXf:
    """Derivative of an `image` of moving places. Detached."""
    with dr.resume_grad(job.film_flow.nodes):
        return tangents(image())


def backward(job: Job, image: Callable[[], mi.TensorXf], grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the flow."""
    with dr.resume_grad(job.film_flow.nodes):
        backpropagate(image(), grad_in)
