"""A trial motion: everything that can move is shifted and turned as one body, whatever the scene's own parameters do.

Forward and backward mode know the same about a scene, but only forward mode knows a direction. What the terms cost and
how noisy they are is therefore measured for this motion (`pilot.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..scene.facts import SceneFacts

#: Direction of the shift and axis of the turn: none that a scene is likely to be aligned with, nor with each other.
SHIFT, AXIS = (0.48, 0.6, 0.64), (0.64, -0.6, 0.48)


@dataclass(frozen=True)
class Trial:
    """v(x) = shift + turn × (x − centre), and who takes part. Detached, and opaque: motion compiles no new kernels."""

    moving: mi.UInt32  # by registry index of a shape: 1 if it can move
    camera: bool
    lights: bool  # those without a shape
    centre: mi.Point3f
    shift: mi.Vector3f
    turn: mi.Vector3f  # as fast at the rim of what moves as the shift

    def velocity(self, x: mi.Point3f) -> mi.Vector3f:
        """Of a point that takes part."""
        return self.shift + dr.cross(self.turn, x - self.centre)

    def takes_part(self, shape: mi.UInt32) -> mi.Bool:
        """By registry index; 0, no shape, does not."""
        return dr.gather(mi.UInt32, self.moving, shape, shape != 0) != 0

    def along(self, covector: mi.Vector3f, x: mi.Point3f, takes_part: mi.Bool) -> mi.Float:
        """What `covector` gets from the motion of the point `x`."""
        return dr.select(takes_part, dr.dot(covector, self.velocity(x)), 0)


@dataclass
class Shift:
    """The trial motion as variables of value 0: a shift `v` and a turn `w`. Nothing moves without a trial."""

    trial: Trial | None
    v: mi.Vector3f
    w: mi.Vector3f

    def at(self, x: mi.Point3f, shape: mi.UInt32) -> mi.Vector3f:
        """Motion of the point `x` of a shape, by registry index."""
        if self.trial is None:
            return mi.Vector3f(0)
        moved = self.v + dr.cross(self.w, dr.detach(x) - self.trial.centre)
        return dr.select(self.trial.takes_part(shape), moved, 0)

    def of_lights(self) -> mi.Vector3f:
        return self.v if self.trial is not None and self.trial.lights else mi.Vector3f(0)

    def surface(self, hit: Hit, ray: mi.Ray3f, flags) -> mi.SurfaceInteraction3f:
        """`compute_surface_interaction` of a surface that moves: the ray is moved the other way, the result back."""
        pi = hit.intersection()
        if self.trial is None:
            return pi.compute_surface_interaction(ray, flags)
        w = dr.select(self.trial.takes_part(hit.shape), self.w, 0)
        ray = mi.Ray3f(ray)
        ray.o = ray.o - self.at(hit.o, hit.shape)
        ray.d = ray.d - dr.cross(w, hit.d)
        si = pi.compute_surface_interaction(ray, flags)
        si.p = si.p + self.at(si.p, hit.shape)
        si.n, si.sh_frame = self._turned(si, w)
        return si

    def segment_end(self, si: mi.SurfaceInteraction3f, hit: Hit) -> None:
        """Move a material point along, in place."""
        if self.trial is not None:
            w = dr.select(self.trial.takes_part(hit.shape), self.w, 0)
            si.p = si.p + self.at(si.p, hit.shape)
            si.n, si.sh_frame = self._turned(si, w)

    @staticmethod
    def _turned(si: mi.SurfaceInteraction3f, w: mi.Vector3f) -> tuple[mi.Normal3f, mi.Frame3f]:
        axes = (si.sh_frame.s, si.sh_frame.t, si.sh_frame.n)
        frame = mi.Frame3f(*(axis + dr.cross(w, dr.detach(axis)) for axis in axes))
        return mi.Normal3f(si.n + dr.cross(w, dr.detach(si.n))), frame


#: No trial: the scene's own motion.
STILL = Shift(None, None, None)


def trial_of(scene: mi.Scene, facts: SceneFacts) -> Trial:
    """The trial motion of a scene, about the middle of what moves."""
    moving = {shape.index for shape in facts.shapes if shape.moves and shape.index >= 0}
    box = mi.ScalarBoundingBox3f()
    for index in moving:
        box.expand(scene.shapes()[index].bbox())
    sphere = (box if box.valid() else scene.bbox()).bounding_sphere()
    turn = [a / max(float(sphere.radius), 1e-6) for a in AXIS]
    return Trial(
        registry_table(scene, moving),
        facts.camera_moves,
        facts.emitters_move,
        dr.opaque(mi.Point3f, list(sphere.center)),
        dr.opaque(mi.Vector3f, list(SHIFT)),
        dr.opaque(mi.Vector3f, turn),
    )


def registry_table(scene: mi.Scene, chosen: set[int]) -> mi.UInt32:
    """By registry index of a shape: 1 if its number in `scene.shapes()` is among `chosen`."""
    ids = [int(i) for i in dr.reinterpret_array(mi.UInt32, scene.shapes_dr())]
    table = [0] * (max(ids, default=0) + 1)
    for index in chosen:
        if index >= 0:
            table[ids[index]] = 1
    return mi.UInt32(table)
