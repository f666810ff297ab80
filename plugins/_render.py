"""What every integrator plugin shares: parse, analyse, run the terms, add up their images."""

from __future__ import annotations

from functools import cached_property

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import ADIntegrator

from psdr_jit.core import film as films
from psdr_jit.core.ad import leftovers_named
from psdr_jit.core.collection import nothing_collected
from psdr_jit.core.counters import Counters
from psdr_jit.core.memory import Memory
from psdr_jit.core.spilling import spill_to_local_memory
from psdr_jit.core.threads import alone
from psdr_jit.driver.aovs import AovChannels, require_no_derivative
from psdr_jit.driver.prepare import Prepared, prepare
from psdr_jit.driver.primal import image_plugin
from psdr_jit.driver.terms import TERMS
from psdr_jit.errors import ParameterError, PsdrError
from psdr_jit.options import Options, require_known
from psdr_jit.plan.call import Call
from psdr_jit.plan.plan import Plan
from psdr_jit.scene.batch_sensor import is_uniform, parts_of, share, side_by_side, splits
from psdr_jit.scene.guard import require_integrator
from psdr_jit.scene.io import find_sensor
from psdr_jit.scene.late_tangents import tangents_arrived


class TermIntegrator(ADIntegrator):
    """An integrator whose derivative is a sum of terms; its primal image is Mitsuba's (`image_plugin`), unless it says
    more.
    """

    bidirectional = False  # can it trace light subpaths?

    def __init__(self, props):
        self.options = Options.from_properties(props, [term.budget for term in TERMS], self.bidirectional)
        if self.options.plan_is_given:
            Plan.from_json(self.options.plan)  # raises now what would be found at the first derivative
        super().__init__(props)
        self.memory = Memory()
        self.plan: Plan | None = None  # of the latest derivative
        self.aovs = AovChannels(self.options)
        self.counters = Counters()
        self.stats = {"rejected": self.counters.rejected, "grazing": self.counters.grazing}  # dropped, or cut short

    @cached_property
    def _images(self) -> dict[str, mi.Integrator]:
        """Mitsuba's own, which make the image. Not made with the plugin: Mitsuba loads the parts of a scene file side
        by side, and one that loads others meanwhile now and then makes it fail.
        """
        options = self.options
        depths = {"max_depth": options.max_depth, "rr_depth": options.rr_depth, "hide_emitters": options.hide_emitters}
        return {name: mi.load_dict({"type": name, **depths}) for name in ("path", "prb")}

    @nothing_collected()
    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        require_integrator(self)
        view = find_sensor(scene, sensor)
        films.require_samples(view, spp)
        if not splits(view):
            return self.aovs.beside(self.primal(scene, view, seed, spp, develop, evaluate), scene, view, seed, spp)
        self.aovs.require_one_view()
        if not is_uniform(view):
            return self._image_of(scene).render(scene, view, seed, spp, develop, evaluate)
        parts = parts_of(view, seed, spp)
        return side_by_side([self.primal(scene, p.sensor, p.seed, p.spp, True, evaluate) for p in parts])

    def primal(self, scene, sensor, seed, spp, develop=True, evaluate=True):
        """The image itself, by one sensor."""
        return self._image_of(scene).render(scene, sensor, seed, spp, develop, evaluate)

    def _image_of(self, scene):
        spill_to_local_memory()
        return self._images[image_plugin(scene, self.options.hide_emitters)]

    def call(self, scene, sensor, seed, spp, mode="forward", film=None) -> Call:
        """A render call of this integrator as data; `film`: in place of the sensor's own."""
        sensor = find_sensor(scene, sensor)
        film = film or sensor.film()
        spill_to_local_memory()
        return Call(self, scene, sensor, film, self.options, self.memory, self.counters, seed, spp, mode)

    def _prepared(self, call: Call) -> Prepared:
        prepared = prepare(call)
        self.plan = prepared.plan
        return prepared

    @nothing_collected()
    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        require_integrator(self)
        view = find_sensor(scene, sensor)
        if not splits(view):
            return self._forward(self.call(scene, view, seed, spp))
        self.aovs.require_one_view()
        parts = [self.call(scene, p.sensor, p.seed, p.spp, "forward", p.film) for p in parts_of(view, seed, spp)]
        return side_by_side([self._forward(part) for part in parts])

    def _forward(self, call: Call):
        with alone(), leftovers_named():
            prepared = self._prepared(call)
            with tangents_arrived(call.scene, call.sensor, prepared.facts):
                for moving in prepared.moving:
                    moving.take_tangents()
                images = {term.name: term.forward(job) for term, job in prepared.jobs}
                prepared.observe(call.seed, images)
                return self.aovs.forward(call, prepared, sum(images.values(), films.black(call.film)))

    @nothing_collected()
    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        require_integrator(self)
        view = find_sensor(scene, sensor)
        if not splits(view):
            self._backward(self.call(scene, view, seed, spp, "backward"), grad_in)
            return
        self.aovs.require_one_view()
        _require_gradient_image(grad_in, films.black(view.film()).shape)
        parts = parts_of(view, seed, spp)
        for k, p in enumerate(parts):
            call = self.call(scene, p.sensor, p.seed, p.spp, "backward", p.film)
            self._backward(call, share(grad_in, k, len(parts)))

    def _backward(self, call: Call, grad_in) -> None:
        with alone():
            prepared = self._prepared(call)
            _require_gradient_image(grad_in, self.aovs.shape(films.black(call.film)))
            grad_in = self.aovs.backward(call, prepared, grad_in)
            for term, job in prepared.jobs:
                term.backward(job, grad_in)
            for moving in reversed(prepared.moving):
                moving.hand_on()
            dr.eval()

    def sample(self, mode, scene, sampler, ray, *args, **kwargs):
        """Radiance of one ray, for integrators around this one, such as Mitsuba's `aov`; not for derivatives."""
        require_no_derivative(scene, ray)
        active = kwargs.get("active", True)
        ray = mi.RayDifferential3f(dr.detach(ray))
        value, valid, _ = self._images["path"].sample(scene, sampler, ray, None, active)
        return value, valid, [], None

    def to_string(self):
        return f"{type(self).__name__}[{self.options}]"


def register(name: str, integrator: type[TermIntegrator]) -> None:
    """Let Mitsuba load `integrator` as the plugin `name`."""

    def make(props: mi.Properties) -> TermIntegrator:
        """Mitsuba prints all frames that an error has passed through: as few as possible."""
        try:
            made = integrator(props)
            require_known(props)
            return made
        except PsdrError as error:
            raise error.with_traceback(None) from None

    mi.register_integrator(name, make)


def _require_gradient_image(grad_in, expected) -> None:
    """Raise unless `grad_in` is a finite derivative of the loss by an image of shape `expected`."""
    shape = tuple(getattr(grad_in, "shape", ()))
    if shape != tuple(expected):
        raise ParameterError(
            f"grad_in has the shape {shape}, but the image has {tuple(expected)}: give the derivative of the loss by "
            "every pixel and channel"
        )
    # NaN would end up as a gradient of 0: the sweeps mask what is not finite
    if not dr.all(dr.isfinite(mi.TensorXf(grad_in)), axis=None):
        raise ParameterError(
            "grad_in is not finite: the loss or its derivative overflowed; look for logarithms and divisions by pixels "
            "that are 0"
        )
