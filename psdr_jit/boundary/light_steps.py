"""Steps of a light itself: the frame of a projector's picture, the lines in it, the rim of a spot's cone.

They are shadow edges that the light brings along (`edges/light_steps.py`): a ray from the light along a step ends at
the first receiver x_D, where the irradiance E steps by ΔE = E(+n_⊥) − E(−n_⊥). With x_B at x_D, where both are one
point of the sheet of such rays, the direct boundary term becomes

    − ΔE · W · |∂x/∂t × ω| · n_⊥·(v_B − u_D) / pdf

ω from x_D to the light, ∂x/∂t along the step, v_B the velocity of the light's own space at x_D, u_D the sliding
velocity of the receiver, W the importance at x_D. Nothing else moves: r_B = 0.

Where light subpaths run, what mirrors and smooth glass send on of a point of light follows its first surface
(`light_chain.py`): if x_D leaves it by a delta lobe, u_D is the velocity of its material, whatever moves behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.compaction import compact
from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from ..edges.location import EdgeLocation
from ..paths.rays import SHADOW_EPSILON
from ..plan.job import Job
from ..sampling.light_steps import SampledSteps, sampled_light_steps
from ..sampling.rows import edge_samples
from .segment_motion import BoundarySamples, SecondaryTerm
from .sensor_subpath import Receivers, SubpathRecords, longest_from_light, subpaths


@dataclass
class StepLine:
    """Where on which step; detached, one entry per sample."""

    lane: mi.UInt32
    row: mi.UInt32
    t: mi.Float
    pdf: mi.Float  # times the number of samples
    wavelengths: mi.Color0f
    weight: mi.Spectrum  # of the wavelengths


@dataclass
class StepOnReceiver:
    """A point x_D of a step on a receiver; detached, one entry per kept sample."""

    lane: mi.UInt32
    at: EdgeLocation  # the same point
    ω: mi.Vector3f  # towards the light
    n_perp: mi.Vector3f
    receiver: Hit  # x_D as the end of a ray from the light
    value: mi.Spectrum  # −ΔE |∂x/∂t × ω|
    pdf: mi.Float
    wavelengths: mi.Color0f


def sample(job: Job, steps: SampledSteps) -> StepLine:
    """Points of steps, in the lights' own films."""
    count = edge_samples(job, paths=1)
    lane = dr.arange(mi.UInt32, count)
    rng = lane_sampler(stream_seed(job.seed, Stream.LIGHT_STEP), lane)
    row, t, pdf = steps.sample_rows(count, rng.next_1d())
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), rng.next_1d())
    return StepLine(lane, row, t, pdf, wavelengths, weight)


def trace(job: Job, steps: SampledSteps, line: StepLine) -> StepOnReceiver | None:
    """The first receiver of each; those that meet none, or part nothing there, are left out (value 0)."""
    light = steps.table.ray(line.row, line.t)
    # Whatever is this close to a light casts no shadow in `path` either: a lamp may lie in the surface it hangs from.
    lead = SHADOW_EPSILON * varying(mi.Float, steps.table.far)
    ray = mi.Ray3f(light.o + lead * light.d, light.d, 0, line.wavelengths)
    pi = job.scene.ray_intersect_preliminary(ray, coherent=False)
    active, r = pi.is_valid() & (light.across > 0), pi.t + lead
    step = light.step(r, line.wavelengths, active)
    found = StepOnReceiver(
        lane=line.lane,
        at=EdgeLocation(line.row, line.t, light.o + r * light.d, mi.Point3f(0), light.scale * r),
        ω=-light.d,
        n_perp=light.n_perp,
        receiver=Hit.of(ray, pi),
        value=-step * line.weight * light.across * r,
        pdf=line.pdf,
        wavelengths=line.wavelengths,
    )
    return compact(found, active & dr.any(step != 0))


def evaluate(job: Job, steps: SampledSteps, found: StepOnReceiver) -> BoundarySamples:
    """What they are worth at the sensor: their subpaths are recorded."""
    records = _subpaths(job, found, longest_from_light(job))
    return BoundarySamples.of(found, records, records.left_by_smooth_lobes(records.data.W))


def evaluate_borne(job: Job, steps: SampledSteps, found: StepOnReceiver) -> BoundarySamples:
    """The same of light that x_D sends on by a delta lobe."""
    # in the material form all of the motion is left with x_D
    records = _subpaths(replace(job, plan=replace(job.plan, form="material")), found, _longest_borne(job))
    return BoundarySamples.of(found, records, dr.select(records.by_delta_lobe(), records.data.W, 0))


def _longest_borne(job: Job) -> int:
    return min(longest_from_light(job), job.light.longest)


def _subpaths(job: Job, found: StepOnReceiver, longest: int) -> SubpathRecords:
    value, still = found.value / found.pdf, mi.Vector3f(0)
    receivers = Receivers(found.lane, found.receiver, found.wavelengths, value, -found.n_perp, still)
    return subpaths(job, Stream.LIGHT_STEP_SUBPATH, receivers, longest)


ESTIMATOR = SecondaryTerm(
    edges=sampled_light_steps, longest=longest_from_light, sample=sample, trace=trace, evaluate=evaluate
)

#: What mirrors and smooth glass send on, where light subpaths are in the image.
BORNE = SecondaryTerm(
    edges=sampled_light_steps, longest=_longest_borne, sample=sample, trace=trace, evaluate=evaluate_borne
)
