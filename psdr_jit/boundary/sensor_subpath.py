"""From a receiving point x_D back to the sensor: importance, and how far its motion carries (motion transport).

A boundary segment found in the middle of a path ends at x_D. Its value counts wherever a path from x_D reaches
the sensor: directly ("connect") or after more scattering ("continue"). In the spatial form x_D slides when anything on
that subpath moves,

    u_k = u_{k-1} − ω_k n·(u_{k-1} − v_k)/(n·ω_k),    u_0 = ȯ + tḋ of the camera ray,

with ω_k the direction of travel, away from the sensor, in which vertex k is reached. For one covector a applied to u_D
the adjoint runs in walking order: deposit g = n (a·ω)/(n·ω) on v, then a ← a − g; what is left acts on the camera ray.

In the mixed form a vertex slides where the one nearer to the sensor has another surface close by.
In the material form only the first vertex of a light path slides. Hence a receiver that sees the sensor takes its
deposit as above, one further along moves with its surface: all of a acts on its own v, and nothing is carried on.

The walk is detached and leaves a record of every vertex: where a connection lands on the film, what it is worth, and
both deposits (ω differs between "connect" and "continue"). Derivatives are then taken from the records: tangents are
prefix sums along the walk, adjoints suffix sums.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.sensor_frame import View, look_at
from ..core.streams import Stream, stream_seed
from ..core.varying import varying
from ..edges.points import facing
from ..paths.bounce import PathLimits, PathState, bounce, particle_eval
from ..paths.scattering import UNIFORM_SHARE
from ..paths.sensor_connection import on_film, seen_by_sensor
from ..paths.surface_at import surface_at
from ..plan.job import Job
from .awaited import Awaited
from .delta_adjoint import DeltaRecords, DeltaTurn, carried_along, through_vertex
from .deposits import carried_off, deposit

#: Vertices of a sensor subpath that are recorded when the depth is unlimited.
UNLIMITED_VERTICES = 32


@dataclass
class Receivers:
    """Where boundary segments end: x_D, lane by lane. Detached."""

    lane: mi.UInt32  # picks the random numbers
    hit: Hit  # x_D as the end of a ray
    wavelengths: mi.Color0f
    value: mi.Spectrum  # of the boundary segment over its density
    a: mi.Vector3f  # covector on u_D
    b: mi.Vector3f  # covector on the direction in which x_D is left, which moves if that is by a delta lobe
    waits: mi.Bool | None = None  # nothing but what moves along the subpath makes it count; None: it counts anyway


@dataclass
class Connection:
    """One vertex of a sensor subpath and its connection to the sensor. Detached."""

    hit: Hit  # the vertex
    deposit_connect: mi.Vector3f  # covector on the vertex' material velocity if the path ends here ...
    deposit_continue: mi.Vector3f  # ... and if it goes on
    camera: mi.Vector3f  # covector on the camera ray's point, for the connection
    p: mi.Point2f  # film position [px]
    film: mi.Point2f  # the same in [0, 1]² of the crop window
    aperture: mi.Point2f
    W: mi.Spectrum  # value splatted per unit of motion; 0: no connection


class SubpathRecords:
    """Connections of `lanes` subpaths, at most `depth` each, vertex-major. Not a PyTree, so never loop state.

    `delta`: of a scene with delta lobes, whose turns are recorded as well.
    """

    BYTES_RGB = 4 * (11 + 9 + 6 + 3)  # of one vertex

    def __init__(self, lanes: int, depth: int, delta: bool):
        size = lanes * depth
        self.delta = DeltaRecords(lanes, depth) if delta else None
        self.lanes, self.depth = lanes, depth
        self.stride = varying(mi.UInt32, lanes)
        self.lane = dr.arange(mi.UInt32, lanes)
        self.data = Connection(
            Hit.made(dr.zeros, size),
            dr.zeros(mi.Vector3f, size),
            dr.zeros(mi.Vector3f, size),
            dr.zeros(mi.Vector3f, size),
            dr.zeros(mi.Point2f, size),
            dr.zeros(mi.Point2f, size),
            dr.zeros(mi.Point2f, size),
            dr.zeros(mi.Spectrum, size),
        )
        dr.make_opaque(self.data)

    def write(self, k: mi.UInt32, connection: Connection, active: mi.Bool) -> None:
        dr.scatter(self.data, connection, k * self.stride + self.lane, active, mode=dr.ReduceMode.Permute)

    def left_by_smooth_lobes(self, values: mi.Spectrum) -> mi.Spectrum:
        """`values` (flat) of connections whose path leaves its first vertex by a smooth lobe; 0 for all others."""
        if self.delta is None:
            return values
        return dr.select(self.by_delta_lobe(), 0, values)

    def by_delta_lobe(self) -> mi.Bool:
        """Connections (flat) whose path leaves its first vertex, and does not end there, by a delta lobe."""
        return (self.vertex_of() > 0) & dr.gather(mi.Bool, self.delta.leaves, self.lane_of())

    def not_mirrored(self, values: mi.Spectrum) -> mi.Spectrum:
        """`values` (flat) but of connections whose path leaves its first vertex as by a mirror, of which they are 0."""
        if self.delta is None:
            return values
        mirrored = (self.vertex_of() > 0) & dr.gather(mi.Bool, self.delta.mirrored, self.lane_of())
        return dr.select(mirrored, 0, values)

    def connected(self) -> mi.Bool:
        """Per lane: does any vertex see the sensor?"""
        return _connected(self)

    def lane_of(self) -> mi.UInt32:
        """Subpath of every flat entry."""
        return dr.arange(mi.UInt32, self.lanes * self.depth) % self.stride

    def vertex_of(self) -> mi.UInt32:
        """Number on its subpath of every flat entry, 0: the receiver."""
        return dr.arange(mi.UInt32, self.lanes * self.depth) // self.stride

    def before(self, values: mi.Float) -> mi.Float:
        """For every vertex the sum of `values` over the earlier vertices of its subpath (flat arrays)."""
        return _running_sum(self, values, _Flat(self), 0, 1)

    def after(self, values: mi.Float) -> mi.Float:
        """For every vertex the sum of `values` over the later vertices of its subpath (flat arrays)."""
        return _running_sum(self, values, _Flat(self), self.depth - 1, -1)

    def total(self, values: mi.Float, after: mi.Float) -> mi.Float:
        """Sum of `values` over each subpath, one entry per lane; `after`: what `self.after(values)` returned."""
        return dr.gather(mi.Float, values, self.lane) + dr.gather(mi.Float, after, self.lane)


def recorded_vertices(job: Job, limit: int) -> int:
    """Vertices of a sensor subpath of at most `limit` that can move against anything.

    While only the camera moves, nothing but the first vertex of a light path slides in the material form.
    """
    facts = job.facts
    only_camera = job.form == "material" and not (facts.shapes_move or facts.emitters_move)
    return min(limit, 1) if only_camera and job.plan.prunes else limit


def longest_from_light(job: Job) -> int:
    """Vertices from the sensor to a receiver of light, at most: one segment is left for the emitter."""
    return recorded_vertices(job, job.options.max_depth - 1 if job.options.max_depth != -1 else UNLIMITED_VERTICES)


class _Flat:
    """A flat output array that a recorded loop scatters into, hidden from its state."""

    def __init__(self, records: SubpathRecords):
        self.array = dr.zeros(mi.Float, records.lanes * records.depth)
        dr.make_opaque(self.array)


@dr.syntax
def _running_sum(records: SubpathRecords, values: mi.Float, out: _Flat, start: int, step: int) -> mi.Float:
    """Exclusive sums along every subpath, from vertex `start` in direction `step`. Detached."""
    k = mi.Int32(start)
    done = mi.UInt32(0)
    total = dr.zeros(mi.Float, records.lanes)
    while dr.hint(done < records.depth, label="psdr.running_sum"):
        index = mi.UInt32(k) * records.stride + records.lane
        dr.scatter(out.array, total, index)
        total += dr.gather(mi.Float, values, index)
        k += step
        done += 1
    dr.eval(total, out.array)
    return out.array


@dr.syntax
def _connected(records: SubpathRecords) -> mi.Bool:
    k = mi.UInt32(0)
    found = dr.full(mi.Bool, False, records.lanes)
    while dr.hint(k < records.depth, label="psdr.connected"):
        found |= dr.any(dr.gather(mi.Spectrum, records.data.W, k * records.stride + records.lane) != 0)
        k += 1
    return found


def subpaths(job: Job, stream: Stream, receivers: Receivers, longest: int) -> SubpathRecords:
    """Walk every receiver x_D back to the sensor, at most `longest` vertices."""
    records = SubpathRecords(dr.width(receivers.lane), longest, job.facts.has_delta_lobes)
    own_frames = job.limits.own_frames
    limits = PathLimits(longest, job.options.rr_depth, uniform_share=UNIFORM_SHARE, own_frames=own_frames)
    walk_to_sensor(job, receivers, lane_sampler(stream_seed(job.seed, stream), receivers.lane), limits, records)
    dr.eval(records.data)
    if records.delta is not None:
        dr.eval(records.delta.turns, records.delta.leaves, records.delta.mirrored)
    return records


@dataclass
class _AtSensor:
    """How the sensor sees a vertex, and what a path that ends there would be worth. Detached."""

    view: View
    aperture: mi.Point2f
    W: mi.Spectrum  # 0 where it is not seen


def _connect(job: Job, sampler, si, bsdf: mi.BSDFPtr, value: mi.Spectrum, active: mi.Bool) -> _AtSensor:
    """Connect the vertex to the sensor; `value`: of the boundary segment and the path that led here."""
    frame = job.frame
    aperture = sampler.next_2d() if frame.kind == "thinlens" else mi.Point2f(0.5)
    view = look_at(frame, si.p, aperture)
    to_sensor = -view.ω
    seen = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (facing(si.n, view.ω) != 0)
    seen &= on_film(frame, view)
    W = value * particle_eval(si, bsdf, to_sensor, seen) / view.J_px
    seen = seen_by_sensor(job.scene, si, view, job.options.hide_emitters, seen & dr.any(W != 0))
    return _AtSensor(view, aperture, dr.select(seen, W, 0))


@dr.syntax
def walk_to_sensor(job: Job, receivers: Receivers, sampler, limits: PathLimits, records: SubpathRecords) -> None:
    """Trace the sensor subpaths of the receivers; fills `records`. Detached.

    `limits.max_depth`: vertices at most.
    """
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    ray = mi.Ray3f(receivers.hit.o, receivers.hit.d, 0, receivers.wavelengths)
    pi = receivers.hit.intersection()
    value = mi.Spectrum(receivers.value)
    a, b = mi.Vector3f(receivers.a), mi.Vector3f(receivers.b)
    # Vertex 0 is what the segment comes from. Roulette judges the walk alone, not the segment that it started from.
    path = PathState.start(1)
    active = mi.Bool(True)
    awaited = Awaited.of(job, receivers.waits)
    orbits = job.orbits
    waits = mi.Bool(False) if awaited is None else mi.Bool(receivers.waits)
    while dr.hint(active, label="psdr.sensor_walk", exclude=[job, limits, awaited, orbits]):
        si = surface_at(job.surfaces, pi, ray, mi.RayFlags.All)
        bsdf = si.bsdf()
        end = _connect(job, sampler, si, bsdf, value * path.β, active)
        if dr.hint(awaited is not None, mode="scalar"):
            waits &= ~awaited.met(dr.reinterpret_array(mi.UInt32, pi.shape))
        onward = bounce(
            si, bsdf, sampler, path, limits if awaited is None else awaited.aimed(limits, si.p, waits), ctx, active
        )
        following = onward.ray(si)
        g_connect = deposit(a, si.n, end.view.ω)
        path, goes_on = onward.path, onward.alive & (onward.path.k <= limits.max_depth)
        found = job.scene.ray_intersect_preliminary(following, coherent=False, active=goes_on)
        g_continue = carried_off(job, a, si.n, following, found, goes_on)
        records.write(
            path.k - 2,
            Connection(
                Hit.of(ray, pi),
                g_connect,
                g_continue,
                a - g_connect,
                end.view.p,
                end.view.film,
                end.aperture,
                end.W,
            ),
            active,
        )
        a -= g_continue
        if dr.hint(records.delta is not None, mode="scalar"):
            delta = onward.alive & onward.scattering.delta
            turned, bent = through_vertex(job.surfaces, pi, si, bsdf, b, -following.d, -ray.d, delta)
            through = dr.dot(si.sh_frame.n, ray.d) * dr.dot(si.sh_frame.n, following.d) > 0
            a += bent
            arriving = turned + found.t * a
            q, s = carried_along(orbits, following, found, pi, arriving, goes_on & delta)
            turn = DeltaTurn(-following.d, dr.select(delta, b, 0), q, s)
            records.delta.write(path.k - 2, turn, delta, through, active)
            a, b = a - q, arriving
        ray, pi, active = following, found, goes_on & found.is_valid()
