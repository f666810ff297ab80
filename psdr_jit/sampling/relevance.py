"""Which edges the secondary boundary terms sample, how densely, and from where a resting edge can matter at all.

No viewpoint is known in the middle of a path, so the prior is length × exterior angle. On top of it only what forward
and backward mode both know: which shapes can move, where they are, and where the lights are.

Edges of shapes that rest count where something else slides: a receiver on a moving shape, here or further along the
sensor subpath. They share `STATIC_SHARE` of the samples, in proportion to how much of an edge's view is taken by
what moves; if the camera moves, or a light in the direct term, every edge moves relative to something.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.cones import Cones
from ..core.joining import joined
from ..core.memory import Slot
from ..core.varying import varying
from ..edges.kind import Use, Views
from ..edges.lights import LightBounds
from ..edges.scene_table import scene_edges
from ..edges.table import EdgeTable
from ..edges.wedges import Wedges
from ..plan.job import Job
from .directions import pdf_view, sample_view
from .mirror_images import SeenBall, SeenBalls, with_images
from .nearness import nearness
from .rows import ROW_SAMPLER, SampledRows, row_state, with_static_share

#: Relevance of a resting edge that no moving shape sees directly, only by way of other surfaces.
INDIRECT_RELEVANCE = 0.05

#: Share of a resting edge's directions in which movers are behind it, where that counts; otherwise they are in front.
AHEAD = {Use.STEP: 0.0, Use.SHADOW: 0.0, Use.BACKGROUND: 0.5}

#: The same where directions turn with what moves (`paths/orbits.py`).
AHEAD_OF_ORBITS = 0.5

#: Emitters that are looked at one by one when asking whether an edge can cast a shadow.
MAX_EMITTERS = 16


@dataclass(frozen=True)
class Movers:
    """Ball around everything that can move, if only shapes do, and its images in mirrors."""

    seen: SeenBalls
    ahead: float  # share of a resting edge's directions in which they are behind it

    @property
    def in_mirrors(self) -> bool:
        """Does a mirror show it?"""
        return len(self.seen.balls) > 1

    def seen_from(self, x: mi.Point3f) -> Cones:
        return self.seen.seen_from(x)


#: Of one render call: what moves, by what lines through edges are drawn for.
MOVERS: Slot[dict[Use, Movers | None]] = Slot(dict)


@dataclass(frozen=True)
class SecondaryEdges(SampledRows):
    """Edges of the scene, how their rows are drawn, and what a resting edge has to look at."""

    table: EdgeTable
    use: Use
    movers: Movers | None
    resting: mi.Bool  # by row of the table: matters only through what slides; unused without movers

    def rests(self, row: mi.UInt32) -> mi.Bool | None:
        return None if self.movers is None else dr.gather(mi.Bool, self.resting, row)

    def views(self, row: mi.UInt32) -> RowViews:
        """Directions through points of these rows of the table."""
        return RowViews(self.use, self.movers, self.resting, row)


@dataclass(frozen=True)
class RowViews(Views):
    """Where an edge can matter, and where a resting one has something to look at."""

    use: Use
    movers: Movers | None
    resting: mi.Bool
    row: mi.UInt32  # of the table

    def sample(self, w: Wedges, x: mi.Point3f, u: mi.Point2f, active: mi.Bool) -> mi.Vector3f:
        if self.movers is None:
            return w.sample(u)[0]
        return sample_view(w, self.movers.seen_from(x), self._rests(active), self.movers.ahead, u)[0]

    def pdf(self, w: Wedges, x: mi.Point3f, ω: mi.Vector3f, active: mi.Bool) -> mi.Float:
        if self.movers is None:
            return w.pdf(ω)
        return pdf_view(w, self.movers.seen_from(x), self._rests(active), self.movers.ahead, ω)

    def _rests(self, active: mi.Bool) -> mi.Bool:
        return dr.gather(mi.Bool, self.resting, self.row, active)


def secondary_edges(job: Job, term: str, use: Use) -> SecondaryEdges | None:
    """The edges that `term` samples, for lines anywhere in the scene; None if nothing can contribute."""
    table, movers = scene_edges(job), movers_of(job, use)
    rows = job.call.memory[ROW_SAMPLER]
    state = row_state(job, f"{term}/{use.value}", lambda: line_weights(job, use))
    if state is None:
        return None
    flags = mi.Bool(True)
    if movers is not None:
        flags = ~joined(table.moving())
    return SecondaryEdges(table, rows, state, use, movers, flags)


def line_weights(job: Job, use: Use) -> list[mi.Float]:
    """By kind of edge, the relative weight of each row for lines anywhere in the scene."""
    table, movers = scene_edges(job), movers_of(job, use)
    weights, near = table.weights(lambda kind: kind.line_weights(use)), nearness(job)
    if near is not None:
        weights = [w * n for w, n in zip(weights, near, strict=True)]
    lights = light_bounds(job) if use is Use.SHADOW else None
    if lights is not None:
        casts = table.weights(lambda kind: kind.casts_shadow(lights, job.scene.bbox()))
        weights = [dr.select(c, w, 0) for c, w in zip(casts, weights, strict=True)]
    if movers is None or not weights:
        return weights
    seen = table.weights(lambda kind: movers.seen_from(kind.places()).share)
    return _balanced(weights, table.moving(), seen)


def movers_of(job: Job, use: Use) -> Movers | None:
    """What moves, if only some shapes do; found once per render call.

    None if every edge moves relative to something (all with the camera, shadows with a light, all behind glass), or
    if no shape moves. Places on the film that follow shapes hardly move anywhere else.
    """
    known = job.shared[MOVERS]
    if use not in known:
        known[use] = _found_movers(job, use)
    return known[use]


def _found_movers(job: Job, use: Use) -> Movers | None:
    facts = job.facts
    light_moves = facts.emitters_move or any(s.moves and s.is_emitter for s in facts.shapes)
    moving = [s for s in facts.shapes if s.index >= 0 and s.moves]
    everywhere = facts.camera_moves or facts.paths_bend or (use is Use.SHADOW and light_moves)
    if everywhere or not moving or not job.plan.prunes:
        return None
    shapes = job.scene.shapes()
    ball = [SeenBall.around(shapes[s.index] for s in moving)]
    turns = use is Use.STEP and job.orbits is not None and job.orbits.move
    ahead = AHEAD_OF_ORBITS if turns else AHEAD[use]
    return Movers(SeenBalls.of(ball if use is Use.SHADOW else with_images(job, ball)), ahead)


def _balanced(weights: list, moving: list, seen: list) -> list:
    """Resting edges weighed by what they see of the movers (share of all directions), and scaled to their share."""
    seen = [dr.select(m, 1, s + INDIRECT_RELEVANCE) for m, s in zip(moving, seen, strict=True)]
    return with_static_share([w * s for w, s in zip(weights, seen, strict=True)], moving)


def light_bounds(job: Job) -> list[LightBounds] | None:
    """Where the lights can be; None if one of them is everywhere, or if they are too many to look at."""
    emitters = job.scene.emitters()
    if len(emitters) > MAX_EMITTERS or not job.plan.prunes:
        return None
    found = []
    for emitter, facts in zip(emitters, job.facts.emitters, strict=True):
        if facts.infinite and not facts.delta:
            return None
        if facts.infinite:
            axis = dr.detach(emitter.world_transform() @ mi.Vector3f(0, 0, -1))
            towards = [mi.Vector4f(axis.x, axis.y, axis.z, 0)]
            found.append(LightBounds(towards, towards))
            continue
        owner = job.facts.shapes[facts.shape] if facts.shape >= 0 else None
        shape = None if owner is None else job.scene.shapes()[owner.index]
        box = emitter.bbox() if shape is None else shape.bbox()
        if not box.valid():  # a projector says that it is nowhere
            if not mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
                return None
            start = dr.detach(emitter.world_transform() @ mi.Point3f(0))
            there = [mi.Vector4f(start.x, start.y, start.z, 1)]
            found.append(LightBounds(there, there))
            continue
        corners = [varying(mi.Vector4f, [*box.corner(i), 1.0]) for i in range(8)]
        flat = owner is not None and owner.plugin in ("rectangle", "disk")
        found.append(LightBounds(corners, [corners[0], corners[7]], _plane_of(shape) if flat else None))
    return found


def _plane_of(light: mi.Shape) -> tuple[mi.Vector3f, mi.Point3f]:
    """Normal and a point of a flat light."""
    with dr.suspend_grad():
        ps = light.sample_position(0, mi.Point2f(0.5))
        n, p = mi.Vector3f(dr.detach(ps.n)), mi.Point3f(dr.detach(ps.p))
        dr.make_opaque(n, p)
    return n, p
