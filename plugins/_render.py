"""What every integrator plugin shares: parse, analyse, run the terms, add up their images."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import ADIntegrator

from psdr_jit import film as films
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.job import Job
from psdr_jit.options import Options, require_runtime, samples_per_pixel
from psdr_jit.rejected import Rejected
from psdr_jit.scene_analysis import analyse
from psdr_jit.scene_checks import require_supported, warn_about_missing_terms
from psdr_jit.scene_io import find_sensor
from psdr_jit.terms import TERMS


class TermIntegrator(ADIntegrator):
    """An integrator whose derivative is a sum of terms; its primal image is Mitsuba's `path`."""

    def __init__(self, props):
        self.options = Options.from_properties(props)
        super().__init__(props)
        self.cache: dict = {}
        self.stats = {"rejected": Rejected()}
        self._path = mi.load_dict(
            {
                "type": "path",
                "max_depth": self.options.max_depth,
                "rr_depth": self.options.rr_depth,
                "hide_emitters": self.options.hide_emitters,
            }
        )

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        return self._path.render(scene, sensor, seed, spp, develop, evaluate)

    def jobs(self, scene, sensor, seed, spp):
        """The terms that will run, with their budgets: `[(term, job)]`. Empty if the derivative is 0 everywhere."""
        sensor = find_sensor(scene, sensor)
        film = sensor.film()
        films.require_film(film)
        sampler_spp = sensor.sampler().sample_count()
        budgets = [samples_per_pixel(self.options.budget(t.budget), spp, sampler_spp) for t in TERMS]
        require_runtime(seed, max(budgets) * int(film.crop_size()[0]) * int(film.crop_size()[1]))
        if not any(budgets):
            names = ", ".join(dict.fromkeys(term.budget for term in TERMS))
            raise OptionError(f"every term is switched off ({names} are 0): give one of them samples per pixel")
        facts = analyse(scene, sensor)
        require_supported(facts)
        warn_about_missing_terms(facts, [term.name for term in TERMS], self.options.depth_limit, self.cache)
        rejected = self.stats["rejected"]
        if self.options.depth_limit == 0:
            return []
        shared: dict = {}
        return [
            (term, Job(self, scene, sensor, facts, self.options, self.cache, shared, rejected, seed, budget))
            for term, budget in zip(TERMS, budgets, strict=True)
            # boundaries only count while they move: without motion, their terms are not asked for sensors they lack
            if budget > 0 and (facts.geometry_moves or term.name == "interior")
        ]

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        jobs = self.jobs(scene, sensor, seed, spp)
        images = [term.forward(job) for term, job in jobs] or [films.black(find_sensor(scene, sensor).film())]
        return sum(images[1:], images[0])

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        jobs = self.jobs(scene, sensor, seed, spp)
        _require_gradient_image(grad_in, films.black(find_sensor(scene, sensor).film()).shape)
        for term, job in jobs:
            term.backward(job, grad_in)
        dr.eval()

    def to_string(self):
        return f"{type(self).__name__}[{self.options}]"


def _require_gradient_image(grad_in, expected) -> None:
    """Raise unless `grad_in` is a finite derivative of the loss by an image of shape `expected`."""
    shape = tuple(getattr(grad_in, "shape", ()))
    if shape != tuple(expected):
        raise ParameterError(
            f"grad_in has the shape {shape}, but the image has {tuple(expected)}: give the derivative of the loss by "
            "every pixel and channel"
        )
    # NaN would end up as a gradient of 0: the sweeps mask what is not finite
    if not dr.flag(dr.JitFlag.FreezingScope) and not dr.all(dr.isfinite(mi.TensorXf(grad_in)), axis=None):
        raise ParameterError(
            "grad_in is not finite: the loss or its derivative overflowed; look for logarithms and divisions by pixels "
            "that are 0"
        )
