"""What changes of AOVs along fixed viewing rays: ∫ f ∂A/∂θ dx, with the surface that a ray meets attached."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import backpropagate, tangents
from ..paths.aovs import Aovs
from ..paths.surface_at import surface_at
from ..plan.job import Job
from .camera_pass import camera_passes


def _images(job: Job, aovs: Aovs) -> Iterator[mi.TensorXf]:
    """Images (H, W, K) of passes, attached to the scene's parameters; their sum is the image."""
    for p in camera_passes(job):
        with dr.resume_grad():
            pi = job.scene.ray_intersect_preliminary(p.ray, coherent=True)
            si = surface_at(job.surfaces, pi, p.ray, mi.RayFlags.All)
            values = [value * p.share for value in aovs.values(si, p.ray.o)]
            yield films.develop_channels(job.film, aovs.channels, p.at, values)


def forward(job: Job, aovs: Aovs) -> mi.TensorXf:
    """Derivative image (H, W, K) along the tangents set on the scene's parameters. Detached."""
    total = 0.0
    with dr.suspend_grad():
        for image in _images(job, aovs):
            with dr.resume_grad():
                total = total + dr.detach(tangents(image))
    return total


def backward(job: Job, aovs: Aovs, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters; `grad_in` is (H, W, K)."""
    with dr.suspend_grad():
        for image in _images(job, aovs):
            with dr.resume_grad():
                if dr.grad_enabled(image):
                    backpropagate(image, grad_in)
