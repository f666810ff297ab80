"""Lines across what a point of light shines on, searched as those across the film are (`chain_search`).

A point of light looks at a target, a ball that holds a body of glass or a mirror, as a sensor does. Its film is the
disk of radius R that Lambert's azimuthal map makes of the cone which the ball is seen in,

    ω = x √(1 − r²/4) s + y √(1 − r²/4) t + (1 − r²/2) a,        r² = x² + y² ≤ R²,        dω = dx dy,

(s, t, a) a frame about the axis a of the cone, R² = 2 (1 − cos of its half angle): areas are solid angles, and the map
is smooth up to the whole sphere, seen from inside of the ball. Of a directional light all ω are a, and the film is the
disk across them that the ball hides: rays start at c + x s + y t, in front of the scene. The square around the disk is
cut into CELLS² cells; every sample is a line across one of them. Where cones overlap, each has its share of what is in
both.

Few cells see a step that matters. Lines of a pilot, a part of all, tell which; with one line, a cell's part of the
derivative has a variance of about the mean square v of what lines found there, and the variance Σ v_i/n_i of all is
least for n_i ∝ √v_i lines. A share of the lines goes evenly to all cells, and the pilot's are used for nothing else.

Smooth vertices are compared by what the sensor sees of them, as those of camera paths are by what light they see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.cones import towards_sphere
from ..core.low_discrepancy import lane_sampler
from ..core.records import Hit
from ..core.sensor_frame import SensorFrame, View, look_at
from ..core.streams import Stream, stream_seed
from ..core.upload import uploaded
from ..core.varying import varying
from ..paths.light_source import Ball, LightSources, beam_density, beam_pdf, is_far, place_of, shone
from ..paths.light_technique import LightTechnique
from ..paths.rays import skip_emitters
from ..paths.sensor_connection import on_film
from ..plan.job import Job
from ..sampling.distribution import EdgeDistribution, edge_distribution, pmf, sample_edge
from .chain_fixed import Directions, LightPoint
from .chain_lines import LEAST_WIDTH
from .chain_trace import Numbers, Pair
from .chain_world import CHAIN_DEPTH, ChainWorld, Last
from .searched_lines import SearchedLines, either

#: Cells along one side of the square.
CELLS = 64

#: As `chain_lines.NARROWEST`, in cells: these are small beside what casts a shadow, and lines fewer.
NARROWEST = 2.0**-6

#: Share of the lines that is spread evenly over all cells.
EVEN_SHARE = 0.2


@dataclass
class LightLine:
    """The line of a sample across the directions of a light. Detached."""

    emitter: mi.UInt32  # registry index
    far: mi.Bool  # it is a directional one
    y: mi.Point3f  # where it is; of a directional one, where the ray through the middle of the ball starts
    axis: mi.Vector3f  # of the cone
    density: mi.Float  # 1 / its solid angle, or 1 / area of the disk
    cell: mi.Float  # side of a cell in the chart: the root of its solid angle, or of its area
    place: mi.UInt32  # number of the cell, among those of all lights and targets
    across: mi.Float  # expected number of lines of one direction across it
    start: mi.Point2f  # [cells]
    horizontal: mi.Bool
    wavelength: mi.Float  # random number
    lobe: mi.Float  # another one

    def at(self, s: mi.Float) -> mi.Point2f:
        """Position [cells] a share `s` of the way along."""
        return self.start + dr.select(self.horizontal, mi.Point2f(s, 0), mi.Point2f(0, s))

    def direction(self, p: mi.Point2f) -> mi.Vector3f:
        """ω at the position `p` [cells]; attached where `p` is."""
        x, y = self._chart(p)
        r2 = dr.square(x) + dr.square(y)
        up = dr.safe_sqrt(1 - r2 / 4)
        ω = dr.normalize(mi.Frame3f(self.axis).to_world(mi.Vector3f(x * up, y * up, 1 - r2 / 2)))
        return dr.select(self.far, self.axis, ω)

    def origin(self, p: mi.Point2f) -> mi.Point3f:
        """Where the ray of the position `p` [cells] starts; attached where `p` is."""
        x, y = self._chart(p)
        return mi.Point3f(self.y + dr.select(self.far, mi.Frame3f(self.axis).to_world(mi.Vector3f(x, y, 0)), 0))

    def _chart(self, p: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        return (p.x - CELLS / 2) * self.cell, (p.y - CELLS / 2) * self.cell


@dataclass(frozen=True)
class LightCells:
    """How the lines of a job are spread over the cells of all lights and targets. Host object."""

    distribution: EdgeDistribution

    @staticmethod
    def even(squares: int) -> LightCells:
        return LightCells(edge_distribution(dr.ones(mi.Float, squares * CELLS**2)))

    @staticmethod
    def guided(squared: mi.Float) -> LightCells:
        """`squared`: sum, by cell, of the squares of what evenly spread lines have found there."""
        v = np.array(squared, np.float64).reshape(-1, CELLS, CELLS)
        padded = np.pad(v, ((0, 0), (1, 1), (1, 1)))
        around = sum(padded[:, i : i + CELLS, j : j + CELLS] for i in range(3) for j in range(3))
        wish = np.sqrt(around + v)  # a step goes on in the next cell
        if not (np.isfinite(wish).all() and wish.mean() > 0):
            return LightCells.even(v.shape[0])
        share = EVEN_SHARE + (1 - EVEN_SHARE) * wish / wish.mean()
        return LightCells(edge_distribution(uploaded(mi.Float, share.ravel().astype(np.float32))))

    @property
    def count(self) -> int:
        return self.distribution.size


def sensor_world(job: Job, technique: LightTechnique) -> ChainWorld:
    """What chains from lights are traced in: steps that all move, or may, if lights do; and at the end, the camera.

    The line of sight of the sensor, behind y_longest, is a segment as well.
    """
    world = ChainWorld.of(job, partial(compare_sensor, technique, job.options.hide_emitters))
    return replace(
        world,
        depth=min(technique.longest + 1, CHAIN_DEPTH),
        last=Last.NOTHING if technique.longest < CHAIN_DEPTH else Last.ALL,
        surfaces=replace(world.surfaces, folds=world.surfaces.horizons),
        camera=varying(mi.Bool, job.facts.emitters_move),
        lights=varying(mi.Bool, job.facts.camera_moves),
        mode=mi.TransportMode.Importance,
        lamps=None,
    )


@dataclass(frozen=True)
class LightLines(SearchedLines):
    """The lines of a job, `count` in all, half of them horizontal on average. Host object."""

    job: Job  # with a seed of its own
    world: ChainWorld
    points: mi.UInt32  # registry indices of the lights
    sources: LightSources
    count: int
    cells: LightCells
    directions: Directions  # of their smooth vertices
    narrowest = NARROWEST
    first_kept = 0  # the light's own view counts as well

    @staticmethod
    def of(job: Job, technique: LightTechnique, count: int, cells: LightCells | None = None) -> LightLines | None:
        """`cells`: None for an even spread. Returns None if no light is a point."""
        ids = technique.sources.ids
        delta = mi.has_flag(dr.reinterpret_array(mi.EmitterPtr, ids).flags(), mi.EmitterFlags.Delta)
        points = dr.gather(mi.UInt32, ids, dr.compress(delta))
        if dr.width(points) == 0:
            return None
        own = replace(job, call=replace(job.call, seed=stream_seed(job.seed, Stream.LIGHT_CHAIN)))
        world = sensor_world(job, technique)
        cells = cells or LightCells.even(dr.width(points) * len(technique.sources.targets))
        lines = LightLines(own, world, points, technique.sources, count, cells, Directions(count, world.depth))
        lines.guide()
        return lines

    @property
    def _targets(self) -> Sequence:
        return self.sources.targets

    def line(self, sample: mi.UInt32) -> LightLine:
        rng = lane_sampler(stream_seed(self.job.seed, Stream.CHAIN_LINE), sample)
        count, u = varying(mi.Float64, self.count), rng.next_1d()
        cell_of_all, _ = sample_edge(self.cells.distribution, (mi.Float64(sample) + mi.Float64(u)) / count)
        across = pmf(self.cells.distribution, cell_of_all) * mi.Float(count) / 2
        square, cell = cell_of_all // CELLS**2, cell_of_all % CELLS**2
        targets = len(self._targets)
        target = square % targets
        emitter = dr.gather(mi.UInt32, self.points, square // targets)
        light = dr.reinterpret_array(mi.EmitterPtr, emitter)
        far = mi.Bool(False) if self.sources.around is None else is_far(light)
        place, y, axis, density = place_of(light, ~far), mi.Point3f(0), mi.Vector3f(0, 0, 1), mi.Float(1)
        for i, ball in enumerate(self._targets):
            seen = self._bundle(light, place, ball, far)
            y, axis, density = (dr.select(target == i, *v) for v in zip(seen, (y, axis, density), strict=True))
        (horizontal, lobe), offset, wavelength = either(rng.next_1d()), rng.next_1d(), rng.next_1d()
        corner = mi.Point2f(mi.Float(cell % CELLS), mi.Float(cell // CELLS))
        start = corner + dr.select(horizontal, mi.Point2f(0, offset), mi.Point2f(offset, 0))
        side = 2 / CELLS * dr.rsqrt(dr.pi * density)  # R² = Ω/π
        return LightLine(emitter, far, y, axis, density, side, cell_of_all, across, start, horizontal, wavelength,
                         lobe)  # fmt: skip

    def _bundle(
        self, light: mi.EmitterPtr, place: mi.Point3f, ball: Ball, far: mi.Bool
    ) -> tuple[mi.Point3f, mi.Vector3f, mi.Float]:
        """The rays of a light, at `place`, that meet a ball: `(start, axis, 1 / measure)`."""
        cone = towards_sphere(place, *ball)
        if self.sources.around is None:
            return place, cone.axis, cone.density
        ω = shone(light, mi.Point2f(0.5), far)
        y = dr.select(far, self.sources.start_of(ball[0], ω), place)
        return y, dr.select(far, ω, cone.axis), dr.select(far, beam_density(ball), cone.density)

    def measure(self, line: LightLine, p: mi.Point2f) -> mi.Float:
        """Solid angle or area of a cell, times the share of its cone in what others overlap; 0 off the cone."""
        ω, total = line.direction(p), mi.Float(0)
        off = p - CELLS / 2
        for ball in self._targets:
            density = towards_sphere(line.y, *ball).pdf(ω)
            if self.sources.around is not None:
                density = dr.select(line.far, beam_pdf(ball, line.origin(p), ω), density)
            total += density
        share = dr.minimum(line.density / total, 1)
        inside = (dr.squared_norm(off) <= CELLS**2 / 4) & (total > 0)
        return dr.select(inside, dr.square(line.cell) * share, 0)

    def ray(self, line: LightLine, s: mi.Float) -> mi.Ray3f:
        p = line.at(s)
        return mi.Ray3f(line.origin(p), line.direction(p))

    @property
    def least_width(self) -> mi.Float:
        return varying(mi.Float, LEAST_WIDTH)


def sensor_view(frame: SensorFrame, x: mi.Point3f, u: mi.Point2f) -> tuple[View, mi.Point2f]:
    """How the sensor sees `x` through the lens point that `u` tells, and that lens point."""
    aperture = u if frame.kind == "thinlens" else mi.Point2f(0.5)
    return look_at(frame, x, aperture), aperture


def compare_sensor(
    technique: LightTechnique,
    hide_emitters: bool,
    world: ChainWorld,
    pair: Pair,
    ends: tuple,
    u: Numbers,
    active: mi.Bool,
) -> Pair:
    """Does the sensor see both of the surface interactions `ends`, or one of them? And both from the same side of their
    shading normals? The film's own border is no step.
    """
    a, b = ends
    active = active & mi.has_flag(a.bsdf().flags(), mi.BSDFFlags.Smooth)
    views = [sensor_view(technique.frame, si.p, u.light)[0] for si in ends]
    for view in views:
        active &= on_film(technique.frame, view, technique.margin)
    hit_a, hit_b = (_towards_sensor(world, si, view, hide_emitters, active) for si, view in zip(ends, views))
    seen_a, seen_b = hit_a.shape == 0, hit_b.shape == 0
    parts = active & (seen_a != seen_b)
    h_a, h_b = (dr.dot(si.sh_frame.n, view.ω) for si, view in zip(ends, views, strict=True))
    turned = active & seen_a & seen_b & (h_a * h_b < 0) & ~world.surfaces.is_flat(a)
    there = LightPoint(mi.UInt32(0), mi.Point3f(0), mi.Point2f(u.light), mi.Float(1))
    return replace(
        pair,
        differs=pair.differs | parts | turned,
        moves=pair.moves | (parts & (world.lights | world.moves(hit_a, hit_b))) | (turned & world.lights),
        in_light=parts,
        turned=turned,
        where=dr.select(turned, h_a / (h_a - h_b), pair.where),
        seen=seen_a,
        light=dr.select(parts | turned, there, pair.light),
        a=dr.select(parts, hit_a, pair.a),
        b=dr.select(parts, hit_b, pair.b),
    )


def _towards_sensor(world: ChainWorld, si, view: View, hide_emitters: bool, active: mi.Bool) -> Hit:
    """What hides `si` from the sensor, if anything."""
    ray = si.spawn_ray_to(view.o)
    pi = world.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    if hide_emitters:
        behind, pi = skip_emitters(world.scene, ray, pi)
        pi.t += dr.dot(behind.o - ray.o, ray.d)
    return Hit.of(ray, pi)
