"""The channels beside radiance that an integrator was asked for: their image, and their derivatives."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi

from ..boundary import primary_aovs
from ..errors import UnsupportedError
from ..interior import aovs as interior_aovs
from ..options import Options, samples_per_pixel
from ..paths.aovs import Aovs
from ..plan.call import Call
from .prepare import Prepared


class AovChannels:
    """Of one integrator; with an empty list every method hands on what it is given."""

    def __init__(self, options: Options) -> None:
        self.aovs = Aovs.parse(options.aovs)

    @cached_property
    def _primal(self) -> mi.Integrator:
        return mi.load_dict({"type": "aov", "aovs": self.aovs.text})

    def beside(self, image: Any, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> Any:
        """`image` (H, W, C) with the channels of the AOVs, as Mitsuba's `aov` renders them."""
        if not self.aovs.entries:
            return image
        if len(image.shape) < 3:
            raise UnsupportedError("aovs: there is no render with develop=False; leave it out, or leave the AOVs out")
        found = self._primal.render(scene, sensor, seed, spp)
        first = found.shape[2] - len(self.aovs.channels)
        return _side_by_side(image, found[:, :, first : found.shape[2]])

    def require_one_view(self) -> None:
        """Raise for batch sensors."""
        if self.aovs.entries:
            raise UnsupportedError("aovs: there are none by a batch sensor; render its sensors one by one")

    def shape(self, image: mi.TensorXf) -> tuple[int, ...]:
        """That of `image` with the AOVs."""
        height, width, channels = image.shape
        return height, width, channels + len(self.aovs.channels)

    def forward(self, call: Call, prepared: Prepared, image: mi.TensorXf) -> mi.TensorXf:
        """The derivative `image` with those of the AOVs."""
        if not self.aovs.entries:
            return image
        found = sum((part.forward(job, self.aovs) for part, job in self._parts(call, prepared)), 0.0)
        height, width, count = *image.shape[:2], len(self.aovs.channels)
        return _side_by_side(image, found + dr.zeros(mi.TensorXf, (height, width, count)))

    def backward(self, call: Call, prepared: Prepared, grad_in: Any) -> Any:
        """Accumulate what the AOVs have to say; the rest of `grad_in`, which is for radiance."""
        if not self.aovs.entries:
            return grad_in
        grad_in = mi.TensorXf(grad_in)
        first = grad_in.shape[2] - len(self.aovs.channels)
        for part, job in self._parts(call, prepared):
            part.backward(job, self.aovs, grad_in[:, :, first : grad_in.shape[2]])
        return grad_in[:, :, 0:first]

    def _parts(self, call: Call, prepared: Prepared) -> list[tuple[Any, Any]]:
        """What has to be computed, with its job: as for radiance, a budget of 0 switches it off."""
        self.aovs.require_edges(call.scene)
        sampler = call.sensor.sampler().sample_count()
        found = []
        for part, budget in ((interior_aovs, "sppc"), (primary_aovs, "sppp")):
            spp = samples_per_pixel(call.options.budget(budget), call.spp, sampler)
            job = prepared.plain(spp)
            moves = job.facts.shapes_move or job.facts.camera_moves
            shades = part is interior_aovs and any(shape.shading for shape in job.facts.shapes)
            if spp > 0 and (moves or shades):
                found.append((part, _seeing_emitters(job)))
        return found


def _seeing_emitters(job: Any) -> Any:
    """Mitsuba's `aov` shows emitters, whether they are hidden in the image or not."""
    return replace(job, call=replace(job.call, options=replace(job.call.options, hide_emitters=False)))


def _side_by_side(one: mi.TensorXf, other: mi.TensorXf) -> mi.TensorXf:
    return dr.concat([one, other], axis=2)


def require_no_derivative(scene: mi.Scene, ray: mi.Ray3f) -> None:
    """Raise where an integrator around ours differentiates what it computes by itself.

    Mitsuba's `aov` leaves edges out of its channels, and uses up the graph that ours needs after it.
    """
    if dr.grad_enabled(ray) or dr.grad_enabled(scene.ray_intersect(ray).p):
        raise UnsupportedError(
            "derivatives of an integrator around this one, such as `aov`, would lack outlines and radiance; give "
            "this one the AOVs themselves: aovs = \"dd:depth, nn:sh_normal\""
        )
