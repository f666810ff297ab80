"""A probe's motion: everything that can move is shifted and turned as one body, whatever the scene's parameters do.

Forward and backward mode know the same about a scene, but only forward mode knows a direction. What the terms cost and
how noisy they are is therefore measured for this motion (`driver.pilot`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..core.varying import varying
from ..paths.surface_at import surface_at
from ..scene.facts import SceneFacts
from ..scene.registry import registry_table
from ..scene.surfaces import Surfaces
from .motion import Displacements, Motion

#: Direction of the shift and axis of the turn: none that a scene is likely to be aligned with, nor with each other.
SHIFT, AXIS = (0.48, 0.6, 0.64), (0.64, -0.6, 0.48)


@dataclass(frozen=True)
class ProbeMotion(Motion):
    """v(x) = shift + turn × (x − centre), and who takes part. Detached."""

    moving: mi.UInt32  # by registry index of a shape: 1 if it can move
    known: mi.UInt32  # number of its entries: what instances show, and copies of it for edges, rest
    camera: bool
    lights: bool  # those without a shape
    centre: mi.Point3f
    shift: mi.Vector3f
    turn: mi.Vector3f  # as fast at the rim of what moves as the shift
    surfaces: Surfaces | None

    @contextmanager
    def attached(self, *variables) -> Iterator[Displacements]:
        """Gradients of the probe and of `variables` alone: those of the scene's own parameters rest."""
        v, w = mi.Vector3f(0), mi.Vector3f(0)
        with dr.resume_grad():
            dr.enable_grad(*variables, v, w)
        with dr.resume_grad(*variables, v, w):
            dr.set_grad(v, self.shift)
            dr.set_grad(w, self.turn)
            yield ProbeDisplacements(self, v, w)

    def camera_tangents(self, ray: mi.Ray3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        if not self.camera:
            return mi.Vector3f(0), mi.Vector3f(0)
        o, d = dr.detach(ray.o), dr.detach(ray.d)
        return self.shift + dr.cross(self.turn, o - self.centre), dr.cross(self.turn, d)

    def takes_part(self, shape: mi.UInt32) -> mi.Bool:
        """By the code of a surface; 0, no shape, does not."""
        return dr.gather(mi.UInt32, self.moving, shape, (shape != 0) & (shape < self.known)) != 0


@dataclass(frozen=True)
class ProbeDisplacements(Displacements):
    """The probe as two variables of value 0, the shift `v` and the turn `w`, which carry its tangents."""

    probe: ProbeMotion
    v: mi.Vector3f
    w: mi.Vector3f

    def _of_point(self, x: mi.Point3f, takes_part) -> mi.Vector3f:
        return dr.select(takes_part, self.v + dr.cross(self.w, dr.detach(x) - self.probe.centre), 0)

    def _turn_of(self, shape: mi.UInt32) -> mi.Vector3f:
        return dr.select(self.probe.takes_part(shape), self.w, 0)

    def of_surface(self, hit: Hit) -> mi.Vector3f:
        x = hit.o + dr.select(hit.shape != 0, hit.t, 0) * hit.d
        return self._of_point(x, self.probe.takes_part(hit.shape))

    def of_edge(self, table, location, ω: mi.Vector3f) -> mi.Vector3f:
        return self._of_point(location.x, table.moves(location))

    def of_camera(self, film: mi.Point2f, aperture: mi.Point2f, x: mi.Point3f) -> mi.Vector3f:
        return self._of_point(x, mi.Bool(self.probe.camera))

    def of_view(self, film: mi.Point2f, aperture: mi.Point2f, ω: mi.Vector3f) -> mi.Vector3f:
        return dr.cross(self.w, ω) if self.probe.camera else mi.Vector3f(0)

    def of_light(
        self, emitter: mi.EmitterPtr, it: mi.Interaction3f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Vector3f]:
        return self.of_lights(), mi.Vector3f(0)  # shifted only: where a light is, nobody says

    def material_point(self, hit: Hit, wavelengths) -> mi.Point3f:
        x = hit.o + dr.select(hit.shape != 0, hit.t, 0) * hit.d
        return mi.Point3f(x + self.of_surface(hit))

    def surface(self, hit: Hit, ray: mi.Ray3f, flags) -> mi.SurfaceInteraction3f:
        """The ray is moved the other way, the result back."""
        pi, w = hit.intersection(), self._turn_of(hit.shape)
        moving = self.probe.takes_part(hit.shape)
        ray = mi.Ray3f(ray)
        ray.o = ray.o - self._of_point(hit.o, moving)
        ray.d = ray.d - dr.cross(w, hit.d)
        si = surface_at(self.probe.surfaces, pi, ray, flags)
        si.p = si.p + self._of_point(si.p, moving)
        si.n, si.sh_frame = _turned(si, w)
        return si

    def material(self, hit: Hit, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        follow = mi.RayFlags.All | mi.RayFlags.FollowShape
        si = surface_at(self.probe.surfaces, hit.intersection(), ray, follow, active)
        si.p = si.p + self._of_point(si.p, self.probe.takes_part(hit.shape))
        si.n, si.sh_frame = _turned(si, self._turn_of(hit.shape))
        return si

    def footprint(self, kind: str, film: mi.Point2f, aperture: mi.Point2f) -> mi.Float:
        return mi.Float(1)  # as of every rigid motion

    def of_lights(self) -> mi.Vector3f:
        return self.v if self.probe.lights else mi.Vector3f(0)


def _turned(si: mi.SurfaceInteraction3f, w: mi.Vector3f) -> tuple[mi.Normal3f, mi.Frame3f]:
    axes = (si.sh_frame.s, si.sh_frame.t, si.sh_frame.n)
    frame = mi.Frame3f(*(axis + dr.cross(w, dr.detach(axis)) for axis in axes))
    return mi.Normal3f(si.n + dr.cross(w, dr.detach(si.n))), frame


def probe_motion(scene: mi.Scene, facts: SceneFacts, surfaces: Surfaces | None = None) -> ProbeMotion:
    """The probe of a scene, about the middle of what moves."""
    # glass that bends paths takes part: what is seen through it moves much as if it did
    moving = {s.index for s in facts.shapes if (s.moves or s.bends) and s.index >= 0}
    box = mi.ScalarBoundingBox3f()
    for index in moving:
        box.expand(scene.shapes()[index].bbox())
    sphere = (box if box.valid() else scene.bbox()).bounding_sphere()
    turn = [a / max(float(sphere.radius), 1e-6) for a in AXIS]
    table = registry_table(scene, moving)
    return ProbeMotion(
        table,
        varying(mi.UInt32, dr.width(table)),
        facts.camera_moves,
        facts.emitters_move,
        varying(mi.Point3f, list(sphere.center)),
        varying(mi.Vector3f, list(SHIFT)),
        varying(mi.Vector3f, turn),
        surfaces,
    )
