"""What chains are traced in (`chain_trace`): the scene, what of it steps and moves, and how far they go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.surface_code import top_level, top_level_of
from ..core.varying import varying
from ..edges.followed_lights import FollowedLights, followed_lights
from ..plan.job import Job
from ..scene.registry import registry_table
from ..scene.surfaces import Surfaces
from .chain_aims import ChainAims
from .chain_lamps import ChainLamps
from .chain_patterns import ChainPatterns
from .chain_surface import ChainSurfaces

#: Kinds of shapes that have neither triangles nor a pose.
ROUNDED = ("curve", "grid", "ellipsoids")

#: Segments of a chain that are looked at; what is seen at the end of longer ones has no edges.
CHAIN_DEPTH = 8


class Last(Enum):
    """What the last of `ChainWorld.depth` segments can bring."""

    ALL = "all"  # longer paths go on there; or lights that have no points are met by smooth lobes, too
    EMISSION = "emission"  # of lights that are met by a delta lobe
    NOTHING = "nothing"


@dataclass(frozen=True)
class ChainWorld:
    """What chains are traced in. Host object."""

    scene: mi.Scene
    tables: Surfaces | None  # what Mitsuba does not evaluate of it
    depth: int  # largest number of segments
    last: Last
    surfaces: ChainSurfaces
    patterns: ChainPatterns | None  # None: no surface steps inside
    moving: mi.UInt32  # by registry index of a shape or an instance: 1 if steps may move because of it
    camera: mi.Bool  # may they because the camera does, ...
    lights: mi.Bool  # ... or because lights do?
    connects: Callable  # smooth vertices to the other end, as `compare_light` does
    scatters: bool  # are there such vertices at all?
    mode: mi.TransportMode  # of what is carried from there: radiance, or importance
    followed: FollowedLights | None = None  # lights that chains meet, and that have no points of light
    lamps: ChainLamps | None = None  # that may hide between two chains
    has_contours: bool = False  # are there bodies whose ends `chain_contour` knows?
    aims: ChainAims | None = None  # what directions from smooth vertices are aimed at

    @staticmethod
    def of(job: Job, connects: Callable) -> ChainWorld:
        facts = job.facts
        changing = {s.index for s in facts.shapes if s.geometry or s.shading or s.material}
        lights = facts.emitters_move or any(s.is_emitter and s.index in changing for s in facts.shapes)
        depth, followed = min(job.limits.max_depth, CHAIN_DEPTH), followed_lights(job)
        return ChainWorld(
            scene=job.scene,
            tables=job.surfaces,
            depth=depth,
            last=Last.EMISSION if depth == job.limits.max_depth and followed is None else Last.ALL,
            surfaces=ChainSurfaces.of(job),
            patterns=ChainPatterns.of(job),
            moving=registry_table(job.scene, changing),
            camera=varying(mi.Bool, facts.view_moves),
            lights=varying(mi.Bool, lights),
            connects=connects,
            scatters=facts.scatters,
            mode=mi.TransportMode.Radiance,
            followed=followed,
            lamps=ChainLamps.of(job),
            has_contours=any(s.kind in ROUNDED for s in facts.shapes),
        )

    def moves(self, *surfaces: mi.SurfaceInteraction3f | Hit) -> mi.Bool:
        """May a step move because of what was met there?"""
        found = mi.UInt32(0)
        for met in surfaces:
            index = top_level_of(met.shape) if isinstance(met, Hit) else top_level(met)
            found |= dr.gather(mi.UInt32, self.moving, index)
        return found != 0

    def goes_on(self, k: mi.UInt32, by_delta: mi.Bool) -> mi.Bool | bool:
        """Can what is met behind segment `k` count, if that is left by a delta lobe or by another?"""
        if self.last is Last.ALL:
            return True
        inside = k + 2 < self.depth
        return inside | by_delta if self.last is Last.EMISSION else inside

    def differ(self, a: mi.SurfaceInteraction3f, b: mi.SurfaceInteraction3f, k: mi.UInt32) -> mi.Bool | bool:
        """Can what is met at the ends of segments `k` differ?"""
        if self.last is not Last.EMISSION:
            return True
        lit = (a.emitter(self.scene) != None) | (b.emitter(self.scene) != None)  # noqa: E711
        return lit | (k + 1 < self.depth)
