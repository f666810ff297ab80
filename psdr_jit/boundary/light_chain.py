"""The boundary of smooth caustics: steps of what points of light send to the film by way of mirrors and smooth glass.

The interior term follows such light from its side (`interior/light_borne.py`): with q on the light's own film
(`light_chain_lines`), and y_1, …, y_s the path that the light leaves there by ω(q), a pixel with the filter h is

    I = ∫ g(q) dω(q) …,        g = h(p) Φ(ω) Π_k w_k

Φ the light's intensity [W/sr], or the irradiance of a directional light, of which q is a place on a disk across its
rays and dω its area; w_k lobe by lobe, and at y_s the BSDF over the area that a pixel sees. The first
vertex y_1 stays on its surface, so q moves with it. g steps where two neighbouring paths part: where one goes past
an edge, where the sensor sees one of the two ends y_s only, or where it sees them from different sides of their shading
normals. Along a line X across q the crossed curve is met where
F(X, θ) = 0, as seen by lines of the camera (`chain.py`). Then, with F_θ the derivative of F along the flow, y_1 fixed,

    dI ∋ (g_a − g_b) · (Ẋ − q̇),        Ẋ − q̇ = −F_θ/F_X,        a before b along the line,

times solid angle per line. Both sides land on the film in places of their own, p_a and p_b. Behind the first segment
they share y_1, hence the flow. At the first they do not: each side then has the speed of the edge past its own y_1,

    dI ∋ g_a · (−F_θ^a/F_X) − g_b · (−F_θ^b/F_X).

For the surface that ends in the edge itself, F_θ = 0: its material does not pass its own border. What is left is the
other side, light that something comes in between of, or no longer does.

Left out is what lies behind more than `chain_world.CHAIN_DEPTH` segments. Where glass or a mirror cuts into what it
shines on, both sides are looked at a little off the cut (`chain_beside`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.ad import accumulate, tangents
from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.sensor_frame import lens_point
from ..core.streams import Stream, stream_seed
from ..paths.bounce import particle_eval
from ..paths.light_walk import take_up
from ..paths.surface_at import surface_at, surface_of
from ..plan.job import Job, passes
from ..plan.motion import Displacements
from ..scene.facts import SceneFacts
from .chain_beside import beside_curve
from .chain_crossing import adjoint_of_speed, crossings, step_per_slope
from .chain_fixed import Directions
from .chain_outline import Curve
from .chain_search import find_crossings
from .chain_sweeps import adjoints_at_start, slope_at_end
from .chain_trace import ChainRecords, Pair
from .chain_world import CHAIN_DEPTH
from .light_chain_lines import LightCells, LightLine, LightLines, sensor_view

#: Memory of one line, as in `chain`.
BYTES = 256 + CHAIN_DEPTH * Directions.BYTES

#: Share of the lines that tell where others should be.
PILOT_SHARE = 0.25

#: Lines for each line across the film that the chain term looks at.
SHARE = 0.5


@dataclass
class LightEnd:
    """The last line of sight of chains from lights, which the crossed curve is on. Detached."""

    segment: mi.UInt32  # its number
    curve: Curve
    to_sensor: mi.Bool  # it is one of the sensor, from behind
    turned: mi.Bool  # where it ends, the shading normal turns away from the sensor
    view: mi.Vector3f  # the direction in which the sensor sees its end
    film: mi.Point2f  # where it lands, in [0, 1]² of the crop window
    aperture: mi.Point2f
    lens: mi.Point3f  # the point that it comes from; of an orthographic sensor, unused
    distance: mi.Float  # of that point; infinite for an orthographic sensor

    def attached_F(self, o: mi.Point3f, d: mi.Vector3f, moving: Displacements, facts: SceneFacts) -> mi.Float:
        """F of the attached line of sight; one of the sensor follows its ends, in place of the direction `d`."""
        line = self.curve.line
        aimed = mi.Vector3f(line.d)
        if facts.camera_moves:
            near = dr.isfinite(self.distance)
            shift = moving.of_camera(self.film, self.aperture, self.lens)
            turn = -moving.of_view(self.film, self.aperture, -line.d)
            aimed += dr.select(near, shift / self.distance, turn)
        aimed -= (o - dr.detach(o)) / self.distance
        F = self.curve.attached_F(o, dr.select(self.to_sensor, dr.normalize(aimed), d), moving, facts)
        return dr.select(self.turned, self._attached_cosine(o, d, moving, facts), F)

    def _attached_cosine(
        self, o: mi.Point3f, d: mi.Vector3f, moving: Displacements, facts: SceneFacts
    ) -> mi.Float | float:
        """F of the end's shading outline: the cosine at which the sensor sees it. Attached."""
        if not any(s.smooth for s in facts.shapes):
            return 0.0
        si = moving.surface(self.curve.line, mi.Ray3f(o, d), mi.RayFlags.All)
        shift, turn = mi.Vector3f(0), mi.Vector3f(0)
        if facts.camera_moves:
            shift = moving.of_camera(self.film, self.aperture, self.lens)
            turn = moving.of_view(self.film, self.aperture, self.view)
        near = dr.isfinite(self.distance)
        return dr.dot(si.sh_frame.n, dr.select(near, dr.normalize(si.p - (self.lens + shift)), self.view + turn))


@dataclass
class Side:
    """What is on one side of the crossings, and how fast they pass it. Detached, one entry per crossing."""

    first: Hit  # the first segment: where y_1 is
    emitter: mi.UInt32
    p: mi.Point2f  # where its light lands on the film [px]
    value: mi.Spectrum  # contribution per unit of F_θ
    valid: mi.Bool


@dataclass(frozen=True)
class LightSteps:
    """Host object."""

    chain: ChainRecords
    end: LightEnd
    sides: tuple[Side, Side]
    wavelengths: mi.Color0f
    place: mi.UInt32  # number of the cell
    worth: mi.Float  # what the crossing brings there per unit of F_θ, whatever led to it


def _intensity(line: LightLine, ω: mi.Vector3f, wavelengths) -> mi.Spectrum:
    """Φ in the direction ω: the irradiance at a distance of 1, and of a directional light, at any."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p, si.wavelengths = line.y + ω, wavelengths
    _, E = dr.reinterpret_array(mi.EmitterPtr, line.emitter).sample_direction(si, mi.Point2f(0.5))
    return E


def _sent_on(job: Job, pair: Pair, side: int, Φ: mi.Spectrum, wavelengths) -> tuple[mi.Point2f, mi.Spectrum]:
    """Where the light of segments that have parted lands on the film, and g there.

    Nothing comes of segments whose ends would be vertices beyond the last: `take_up` connects what it is given.
    """
    hit, β = (pair.b, pair.β_b) if side else (pair.a, pair.β_a)
    rng = lane_sampler(stream_seed(job.seed, Stream.CHAIN_RADIANCE), dr.arange(mi.UInt32, dr.width(pair.k)))
    β = dr.select(pair.in_light | pair.turned | (pair.k >= job.light.longest), 0, Φ * β)
    limits = replace(job.limits, light=job.light)
    path = take_up(job.scene, rng, hit, β, pair.k, wavelengths, limits, job.options.hide_emitters)
    return path.p, dr.select(path.count > 0, path.value, 0)


def _connected(job: Job, pair: Pair, hit: Hit, Φβ: mi.Spectrum, wavelengths):
    """The end of `hit`, where paths part in what the sensor sees: `(view, lens point, g if it is seen)`."""
    active = pair.in_light | pair.turned
    ray = mi.Ray3f(hit.o, hit.d, 0, wavelengths)
    si = surface_at(job.surfaces, hit.intersection(), ray, mi.RayFlags.All, active)
    view, aperture = sensor_view(job.frame, si.p, pair.light.u)
    f = particle_eval(si, si.bsdf(), -view.ω, active)
    return view, aperture, dr.select(active, Φβ * f / view.J_px, 0)


def _steps(lines: LightLines | None) -> LightSteps | None:
    """Everything about the crossings of lines but how fast they pass; None if there are none."""
    found = None if lines is None else find_crossings(lines)
    if found is None:
        return None
    job = lines.job
    chain, pair, curve = crossings(lines, found)
    line = lines.line(found.at.sample)
    p = line.at(found.at.lo)
    wavelengths, weight = job.sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), line.wavelength)
    Φ = _intensity(line, line.direction(p), wavelengths) * weight
    ends = pair.a, pair.b
    pair = beside_curve(lines.world, pair, curve)
    shared = chain.segment(pair.k, pair.in_light)
    connected = [
        _connected(job, pair, dr.select(pair.in_light, shared, hit), Φ * β, wavelengths)
        for hit, β in ((pair.a, pair.β_a), (pair.b, pair.β_b))
    ]
    end = _end(job, pair, curve, *connected[0][:2])

    valid, step = step_per_slope(lines, chain, end, (p, line), lambda q: (line.origin(q), line.direction(q)))
    per_F = dr.select(valid, step * lines.measure(line, p), 0)
    sides, worth, weight = [], mi.Float(0), found.at.weight / line.across
    for i, hit in enumerate(ends):
        landed, g = _sent_on(job, pair, i, Φ, wavelengths)
        view, _, at_end = connected[i]
        g += dr.select(pair.turned | (pair.seen ^ mi.Bool(i == 1)), at_end, 0)
        value = job.call.counters.rejected.keep_finite(g * dr.select(mi.Bool(i == 1), -per_F, per_F))
        worth += dr.max(dr.abs(value))
        value *= weight
        first = dr.select(pair.k == 0, hit, chain.segment(mi.UInt32(0), mi.Bool(True)))
        landed = dr.select(pair.in_light | pair.turned, view.p, landed)
        sides.append(Side(first, line.emitter, landed, value, dr.any(value != 0)))
    steps = LightSteps(chain, end, tuple(sides), wavelengths, line.place, worth)
    dr.eval(end, sides, wavelengths, steps.place, worth)
    return steps


def _end(job: Job, pair: Pair, curve: Curve, view, aperture: mi.Point2f) -> LightEnd:
    """The last line of sight; `view` and `aperture`: of the shared vertex where it is one of the sensor."""
    frame = job.frame
    lens, distance = view.o, mi.Float(dr.inf)
    if frame.kind != "orthographic":
        lens = frame.to_world @ lens_point(frame, aperture)
        distance = dr.norm(lens - curve.line.o)
    si = surface_of(job.surfaces, curve.line, pair.turned)
    cos = dr.dot(si.sh_frame.n, view.ω)
    curve = replace(
        curve,
        F=dr.select(pair.turned, cos, curve.F),
        valid=dr.select(pair.turned, dr.isfinite(cos), curve.valid),
    )
    return LightEnd(
        segment=pair.sight,
        curve=curve,
        to_sensor=pair.in_light,
        turned=pair.turned,
        view=view.ω,
        film=view.film,
        aperture=aperture,
        lens=lens,
        distance=distance,
    )


def _leave(moving: Displacements, side: Side) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The motion of the first segments, whose ends y_1 are fixed on their surfaces: of starts and directions."""
    hit = side.first
    r = dr.select(hit.shape != 0, hit.t, 1)
    of_light = moving.of_light_start(dr.reinterpret_array(mi.EmitterPtr, side.emitter), hit, mi.Bool(True))
    across = (moving.of_surface(hit) - of_light) / r
    return of_light, across - hit.d * dr.dot(hit.d, across)


def _parts(job: Job) -> Iterator[tuple[float, Job, LightSteps]]:
    """The steps of a job, pass by pass, with their shares."""
    pixels = int(job.film.crop_size()[0]) * int(job.film.crop_size()[1])
    for share, part in passes(job, BYTES):
        count = round(SHARE * part.spp * pixels)
        pilot = replace(part, call=replace(part.call, seed=stream_seed(part.seed, Stream.LIGHT_CHAIN_PILOT)))
        lines = LightLines.of(pilot, job.light, max(1, round(PILOT_SHARE * count)))
        known = _steps(lines)
        cells = None if known is None else _spread(lines, known)
        steps = _steps(LightLines.of(part, job.light, max(1, round((1 - PILOT_SHARE) * count)), cells))
        if steps is not None:
            yield share, part, steps


def _spread(lines: LightLines, found: LightSteps) -> LightCells:
    """Where to look again, by what a pilot's lines have found."""
    squared = dr.zeros(mi.Float, lines.cells.count)
    dr.scatter_add(squared, dr.square(found.worth), found.place)
    return LightCells.guided(squared)


def _splat(job: Job, steps: LightSteps, side: Side, value: mi.Spectrum) -> mi.TensorXf:
    return films.develop_splats(job.film, side.p, value, steps.wavelengths, side.valid)


def _splat_moved(job: Job, steps: LightSteps, side: Side, F_θ: mi.Float) -> mi.TensorXf:
    return _splat(job, steps, side, side.value * F_θ)


def forward(job: Job) -> mi.TensorXf:
    """Derivative image along the tangents set on the scene's parameters. Detached; `dr.suspend_grad` is on."""
    image = films.black(job.film)
    for share, part, steps in _parts(job):
        for side in steps.sides:
            with job.motion.attached() as moving:
                first = tangents(*_leave(moving, side))
            F_grad = slope_at_end(job.facts, steps.chain, steps.end, first, job.motion)
            value = job.call.counters.rejected.keep_finite(side.value * F_grad)
            image += share * _splat(part, steps, side, value)
    return image


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters; the transpose of `forward`."""
    rejected = job.call.counters.rejected
    for share, part, steps in _parts(job):
        for side in steps.sides:
            splat = partial(_splat_moved, part, steps, side)
            λ = share * adjoint_of_speed(splat, dr.width(steps.end.segment), grad_in)
            λ = rejected.keep_finite(mi.Color1f(λ)).x
            λ_o, λ_d = adjoints_at_start(job.facts, steps.chain, steps.end, λ, job.motion, rejected)
            with job.motion.attached() as moving:
                o, d = _leave(moving, side)
                accumulate(dr.dot(λ_o, o) + dr.dot(λ_d, d))
            dr.eval()
