"""What every integrator plugin shares: parse, analyse, run the terms, add up their images."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import ADIntegrator

from psdr_jit import film as films
from psdr_jit.job import Job
from psdr_jit.options import Options, samples_per_pixel
from psdr_jit.rejected import Rejected
from psdr_jit.scene_analysis import analyse
from psdr_jit.scene_checks import require_supported
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
        """The terms that will run, with their budgets: `[(term, job)]`."""
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        films.require_film(sensor.film())
        facts = analyse(scene, sensor)
        require_supported(facts)
        sampler_spp = sensor.sampler().sample_count()
        jobs = []
        for term in TERMS:
            budget = samples_per_pixel(getattr(self.options, term.budget), spp, sampler_spp)
            if budget > 0:
                jobs.append(
                    (
                        term,
                        Job(
                            self,
                            scene,
                            sensor,
                            facts,
                            self.options,
                            self.cache,
                            self.stats["rejected"],
                            seed,
                            budget,
                        ),
                    )
                )
        return jobs

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        jobs = self.jobs(scene, sensor, seed, spp)
        images = [term.forward(job) for term, job in jobs]
        return sum(images[1:], images[0])

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        for term, job in self.jobs(scene, sensor, seed, spp):
            term.backward(job, grad_in)
        dr.eval()

    def to_string(self):
        return f"{type(self).__name__}[{self.options}]"
