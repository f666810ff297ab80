"""What a term needs to know to do its share of one derivative render."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import filter_reach
from ..core.film_samples import FilmDensity
from ..core.line_guide import LineGuide, LineTally
from ..core.memory import Memory, Slot
from ..core.sensor_frame import SensorFrame, sensor_frame
from ..core.varying import varying
from ..options import Options, of_vertices
from ..paths.close_by import CloseBy
from ..paths.critical_angle import CriticalAngle, critical_angle
from ..paths.edge_on import EdgeOn
from ..paths.light_technique import LightTechnique
from ..paths.orbits import Orbits
from ..paths.rough_plastic import RoughPlastic, rough_plastic
from ..paths.walk import PathLimits
from ..scene.facts import SceneFacts
from ..scene.mesh_tables import CallVariables
from ..scene.surfaces import Surfaces, surfaces_of
from .call import Call
from .film_flow import FilmFlow, FilmMotion
from .light_plan import light_technique
from .motion import Motion
from .plan import Plan

#: Of one render call: the geometry of its sensor.
FRAME: Slot[SensorFrame | None] = Slot(lambda: None)

#: Of one render call: the surfaces of its scene that Mitsuba does not evaluate.
SURFACES: Slot[Surfaces | None] = Slot(lambda: None)

#: Of one render call: spheres that carry directions along.
ORBITS: Slot[Orbits | None] = Slot(lambda: None)

#: Of one render call: spheres and cylinders of mirror or glass.
EDGE_ON: Slot[EdgeOn | None] = Slot(lambda: None)

#: Of one render call: light subpaths.
LIGHT: Slot[LightTechnique | None] = Slot(lambda: None)

#: Of one render call: rough glass whose index is differentiated.
CRITICAL: Slot[CriticalAngle | None] = Slot(lambda: None)

#: Of one render call: rough plastic whose tables depend on a parameter.
ROUGH_PLASTIC: Slot[RoughPlastic | None] = Slot(lambda: None)


#: Passes from which on memory is given back after a term: of fewer it would be asked for again in the next call, which
#: then takes a fifth longer (128 x 128, 64 spp: two passes).
MANY_PASSES = 4


@dataclass(frozen=True)
class Job:
    """One term's share of a render call. Host data only; `spp` is the term's own budget."""

    call: Call
    facts: SceneFacts
    plan: Plan
    motion: Motion  # the scene's own, or a probe in its place (forward mode only)
    shared: Memory  # of all terms of one render call
    spp: int
    density: FilmDensity | None = None  # where on the film samples of this term are wanted; None: everywhere
    guide: LineGuide | None = None  # which lines through edges are; None: all alike
    tally: LineTally | None = None  # wants to know what lines bring
    probe: Motion | None = None  # where there is a tally: the motion that backward mode, which knows none, tells of
    effort: list[np.ndarray] | None = None  # gets what is traced for each pixel of the sampled window [segments]

    @property
    def scene(self) -> mi.Scene:
        return self.call.scene

    @property
    def sensor(self) -> mi.Sensor:
        return self.call.sensor

    @property
    def film(self) -> mi.Film:
        return self.call.film

    @property
    def options(self) -> Options:
        return self.call.options

    @property
    def sky_is_seen(self) -> bool:
        """Does every camera ray end somewhere, if only in the sky?"""
        return self.scene.environment() is not None and not self.options.hide_emitters

    @property
    def seed(self) -> int | mi.UInt32:
        return self.call.seed

    @property
    def form(self) -> str:
        """What path vertices do while θ changes, "spatial", "material" or "mixed"."""
        return of_vertices(self.plan.form)

    @property
    def film_flow(self) -> FilmFlow | None:
        """Where places on the film go, if they do."""
        return self.motion.flow if isinstance(self.motion, FilmMotion) else None

    def with_film_at_rest(self) -> Job:
        """The same for what does not begin at places on the film, and so does not know where they go."""
        return replace(self, motion=self.motion.base) if isinstance(self.motion, FilmMotion) else self

    @property
    def learns(self) -> bool:
        """Do samples of this job tell about the scene's own motion, and not about a probe's?"""
        return self.motion.of_scene

    @property
    def frame(self) -> SensorFrame:
        """Geometry of the sensor, read once per render call."""
        return self.shared.once(FRAME, lambda: sensor_frame(self.sensor))

    @property
    def surfaces(self) -> Surfaces | None:
        """The surfaces of the scene that Mitsuba does not evaluate, read once per render call."""
        return surfaces_of_call(self.call, self.facts, self.shared)

    @property
    def light(self) -> LightTechnique | None:
        """Light subpaths, if the plan has any, set up once per render call."""
        if self.plan.light is None or not self.plan.light.runs:
            return None
        return self.shared.once(LIGHT, self._light_technique)

    @property
    def critical(self) -> CriticalAngle | None:
        """Rough glass whose index of refraction is differentiated, read once per render call."""
        if not any(name.endswith(".eta") for shape in self.facts.shapes for name in shape.material):
            return None
        return self.shared.once(CRITICAL, lambda: critical_angle(self.scene))

    @property
    def rough_plastic(self) -> RoughPlastic | None:
        """Rough plastic whose roughness or index is differentiated, read once per render call."""
        if not any(name.endswith((".alpha", ".eta")) for shape in self.facts.shapes for name in shape.material):
            return None
        return self.shared.once(ROUGH_PLASTIC, lambda: rough_plastic(self.scene, self.call.memory))

    @property
    def close_by(self) -> CloseBy | None:
        """Tells behind which vertices paths slide, in the mixed form; None in the others."""
        return CloseBy(self.scene, self.frame, self.surfaces) if self.form == "mixed" else None

    @property
    def orbits(self) -> Orbits | None:
        """Spheres that carry directions along, read once per render call. None in other forms than the spatial one."""
        if self.form != "spatial":
            return None
        return self.shared.once(ORBITS, lambda: Orbits.of(self.scene, self.facts))

    def _light_technique(self) -> LightTechnique | None:
        plan = self.plan
        technique = light_technique(self.scene, self.facts, self.frame, self.options, plan.light, plan.prunes)
        if technique is None or not technique.delta_lobes:
            return technique
        return replace(technique, margin=varying(mi.Float, filter_reach(self.film)))

    @property
    def limits(self) -> PathLimits:
        own_frames = any(shape.sees_frame for shape in self.facts.shapes)
        depth, roulette = self.options.depth_limit, self.options.rr_depth
        return PathLimits(depth, roulette, own_frames=own_frames, surfaces=self.surfaces)

    @property
    def limits_beside(self) -> PathLimits:
        """Limits of walks from beside an edge, which are compared."""
        edge_on = self.shared.once(EDGE_ON, lambda: EdgeOn.of(self.scene, self.facts))
        limits = self.limits if edge_on is None else replace(self.limits, edge_on=edge_on)
        return replace(limits, aligned=True) if self.facts.has_delta_lobes else limits


def surfaces_of_call(call: Call, facts: SceneFacts, shared: Memory) -> Surfaces | None:
    """The surfaces of the scene that Mitsuba does not evaluate, read once per render call."""
    return shared.once(SURFACES, lambda: surfaces_of(call.scene, facts, call.memory))


def in_motion(shared: Memory) -> list[CallVariables]:
    """Variables that stand for what moves, in what the terms of a render call share."""
    surfaces = shared[SURFACES]
    return [] if surfaces is None or surfaces.meshes is None else surfaces.meshes.in_motion()


def passes(job: Job, bytes_per_sample: int, pixels: int | None = None) -> Iterator[tuple[float, Job]]:
    """Split a job so that one part's samples fit into `record_mib`: `(share of the samples, part)`.

    `pixels`: samples per spp, by default those of the crop window. Parts have seeds of their own; the split depends on
    host data only, so forward and backward mode agree on it. Where there are many, Dr.Jit's cache of freed arrays is
    emptied after the last one: the next term has arrays of other sizes, and would need as much once more.
    """
    if pixels is None:
        pixels = int(job.film.crop_size()[0]) * int(job.film.crop_size()[1])
    fitting = job.options.record_mib * 2**20 // (bytes_per_sample * pixels)
    per_pass = max(1, min(job.spp, fitting))
    done = 0
    while done < job.spp:
        spp = min(per_pass, job.spp - done)
        seed = job.seed if done == 0 else mi.sample_tea_32(mi.UInt32(job.seed), mi.UInt32(done))[0]
        yield spp / job.spp, replace(job, call=replace(job.call, seed=seed), spp=spp)
        done += spp
    if done > (MANY_PASSES - 1) * per_pass:
        dr.flush_malloc_cache()
