"""Where light subpaths start: on a light, aimed at surfaces that may focus it.

A light is chosen, a point y_0 on it (uniform by area; a point light has one), and a direction ω towards the ball around
one of the targets, uniform in the cone that the ball is seen in. Rays of a directional light start in front of the
scene, uniform over the disk across them that hides the ball. What another way of finding the same segment y_0 → y_1
needs to know of this is one number, the density with the segment's own measure taken out,

    E = P p_A(y_0) p(ω) / |cosθ_0|          area light; per m² sr, and per unit of cosine
    E = P p(ω) / r²                         point and spot light
    E = P p_⊥(y_0)                          directional light

P the probability of the light, p(ω) = Σ_i [ω in cone i] / (n Ω_i) over the n targets, p_⊥(y_0) = Σ_i [the ray from y_0
meets ball i] / (n π R_i²), θ_0 between ω and the light's normal, r the distance. In this measure what the segment
carries is L_e / E (for a delta light: its irradiance at y_1, perpendicular to the segment, over E), as the weight is
that Mitsuba's `sample_ray` returns. `light_technique.py` has the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from ..core.varying import varying

#: Radius of a target's ball relative to that of the sphere around it: rounding must not leave its rim outside.
MARGIN = 1.001


@dataclass
class LightStart:
    """The first segment of a light subpath, y_0 → y_1. Detached, one entry per lane."""

    emitter: mi.UInt32  # registry index
    y: mi.Point3f  # y_0
    n: mi.Normal3f  # of the light at y_0; 0 for a delta light
    delta: mi.Bool
    ray: mi.Ray3f  # from y_0
    radiance: mi.Spectrum  # of an area light along the ray; 0 for a delta light


#: A ball: centre and radius.
Ball: TypeAlias = "tuple[mi.Point3f, mi.Float]"


@dataclass(frozen=True)
class LightSources:
    """Host object: lights that are traced, and what they are aimed at."""

    ids: mi.UInt32  # registry indices of the lights, each as likely as the others
    shapes: mi.UInt32  # and of their shapes, 0: none
    density: mi.Float  # by registry index: P p_A(y_0) of an area light, P of a delta light; 0: not traced
    choice: mi.Float  # by registry index: probability with which next-event estimation chooses the light
    targets: tuple[Ball, ...]
    around: Ball | None = None  # the scene, if rays from far away are among what is traced

    def sample(self, sampler, wavelengths) -> LightStart:
        """One light subpath for each lane of `sampler`."""
        count = varying(mi.UInt32, dr.width(self.ids))
        chosen = dr.minimum(mi.UInt32(sampler.next_1d() * mi.Float(count)), count - 1)
        u_target, u, v = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
        emitter = dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self.ids, chosen))
        delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)

        shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, self.shapes, chosen))
        on = shape.sample_position(0, u, ~delta)
        si = mi.SurfaceInteraction3f(on, wavelengths)
        si.p = dr.select(delta, place_of(emitter, delta), si.p)
        si.n = dr.select(delta, 0, si.n)
        si.wavelengths = wavelengths
        ω = self._aim(si.p, u_target, v)
        if self.around is not None:
            far = is_far(emitter)
            si.p = dr.select(far, self._from_afar(emitter, u_target, v, far), si.p)
            ω = dr.select(far, shone(emitter, far), ω)
        si.wi = si.to_local(ω)
        radiance = emitter.eval(si, ~delta)
        ray = si.spawn_ray(ω)
        ray.wavelengths = wavelengths
        return LightStart(dr.reinterpret_array(mi.UInt32, emitter), si.p, si.n, delta, ray, radiance)

    def _aim(self, y: mi.Point3f, u: mi.Float, v: mi.Point2f) -> mi.Vector3f:
        """A direction from `y` towards one of the targets."""
        n = len(self.targets)
        scaled = u * n
        ω = mi.Vector3f(0, 0, 1)
        for i, ball in enumerate(self.targets):
            axis, cap, _ = cone(ball, y)
            of_ball = mi.Frame3f(axis).to_world(_square_to_cone(v, cap))
            ω = dr.select((scaled >= i) | (i == 0), of_ball, ω)
        return ω

    def _aimed_pdf(self, y: mi.Point3f, ω: mi.Vector3f) -> mi.Float:
        """Density p(ω) per solid angle of `_aim`."""
        pdf = mi.Float(0)
        for ball in self.targets:
            axis, cap, inverse_angle = cone(ball, y)
            pdf += dr.select(in_cone(axis, cap, ω), inverse_angle, 0)
        return pdf / len(self.targets)

    def _from_afar(self, emitter: mi.EmitterPtr, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> mi.Point3f:
        """The start of a ray of a directional light that meets one of the targets' balls."""
        n, ω = len(self.targets), shone(emitter, active)
        disk, scaled = mi.warp.square_to_uniform_disk_concentric(v), u * n
        across, x = mi.Frame3f(ω).to_world(mi.Vector3f(disk.x, disk.y, 0)), mi.Point3f(0)
        for i, (centre, radius) in enumerate(self.targets):
            x = dr.select((scaled >= i) | (i == 0), centre + radius * across, x)
        return self.start_of(x, ω)

    def start_of(self, x: mi.Point3f, ω: mi.Vector3f) -> mi.Point3f:
        """Where the ray along ω through `x` starts, in front of the scene."""
        centre, radius = self.around
        return x - ω * (dr.dot(x - centre, ω) + radius)

    def _beams_pdf(self, x: mi.Point3f, ω: mi.Vector3f) -> mi.Float:
        """Density p_⊥ per area across ω of rays through `x`."""
        pdf = mi.Float(0)
        for ball in self.targets:
            pdf += dr.select(in_beam(ball, x, ω), beam_density(ball), 0)
        return pdf / len(self.targets)

    def segment_density(
        self, emitter: mi.UInt32, y: mi.Point3f, n: mi.Normal3f, x: mi.Point3f, active: mi.Bool
    ) -> mi.Float:
        """E of the segment from `y` on the light `emitter` (registry index, 0: none) to `x`; 0 if not traced.

        `n`: normal of the light at y, 0 for a delta light.
        """
        known = active & (emitter < varying(mi.UInt32, dr.width(self.density)))
        light = dr.gather(mi.Float, self.density, emitter, known)
        offset = x - y
        r = dr.norm(offset)
        ω = mi.Vector3f(offset / r)
        measure = dr.select(dr.all(n == 0), dr.rcp(dr.square(r)), dr.rcp(dr.abs_dot(n, ω)))
        E = light * self._aimed_pdf(y, ω) * measure
        if self.around is not None:
            far = known & is_far(dr.reinterpret_array(mi.EmitterPtr, dr.select(known, emitter, 0)))
            E = dr.select(far, light * self._beams_pdf(x, ω), E)
        return dr.select(known & (light > 0) & dr.isfinite(E), E, 0)


def place_of(emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Point3f:
    """Where point and spot lights are. Not by `sample_ray`, which textures on other lights may not know. Detached."""
    ds, _ = emitter.sample_direction(dr.zeros(mi.SurfaceInteraction3f), mi.Point2f(0.5), active)
    return mi.Point3f(dr.detach(ds.p))


def is_far(emitter: mi.EmitterPtr) -> mi.Bool:
    """Do rays of the light come from infinitely far away?"""
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)


def shone(emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Vector3f:
    """The direction in which a directional light shines. Detached."""
    ds, _ = emitter.sample_direction(dr.zeros(mi.SurfaceInteraction3f), mi.Point2f(0.5), active)
    return dr.select(active, -mi.Vector3f(dr.detach(ds.d)), mi.Vector3f(0, 0, 1))


def in_beam(ball: Ball, x: mi.Point3f, ω: mi.Vector3f) -> mi.Bool:
    """Does the line along ω through `x` meet the ball?"""
    centre, radius = ball
    off = x - centre
    return dr.squared_norm(off - ω * dr.dot(off, ω)) <= dr.square(radius)


def beam_density(ball: Ball) -> mi.Float:
    """1 / area of the disk that a ball hides of parallel rays."""
    return dr.inv_pi / dr.square(ball[1])


def cone(ball: Ball, y: mi.Point3f) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
    """The cone in which `y` sees a ball: `(unit axis, 1 − cosine of its half angle, 1/Ω)`; from inside, all directions.

    Seen from a thousand radii away, the cosine itself is 1 but for rounding.
    """
    centre, radius = ball
    to_centre = centre - y
    dist2 = dr.squared_norm(to_centre)
    sin2 = dr.square(radius) / dist2
    outside = sin2 < 1
    cap = dr.select(outside, sin2 / (1 + dr.safe_sqrt(1 - sin2)), 2)
    axis = dr.select(dist2 > 0, to_centre * dr.rsqrt(dist2), mi.Vector3f(0, 0, 1))
    return axis, cap, dr.inv_two_pi / cap


def in_cone(axis: mi.Vector3f, cap: mi.Float, ω: mi.Vector3f) -> mi.Bool:
    """Is the angle between two unit vectors at most that with the cosine 1 − `cap`?"""
    return dr.squared_norm(ω - axis) <= 2 * cap


def _square_to_cone(u: mi.Point2f, cap: mi.Float) -> mi.Vector3f:
    """`mi.warp.square_to_uniform_cone`, which takes the cosine, for cones however narrow."""
    p = mi.warp.square_to_uniform_disk_concentric(u)
    down = cap * dr.squared_norm(p)
    p *= dr.safe_sqrt(cap * (2 - down))
    return mi.Vector3f(p.x, p.y, 1 - down)


def light_sources(scene: mi.Scene, lights: Sequence[int], targets: Sequence[int], most: int) -> LightSources:
    """Read off the scene: numbers of lights in `scene.emitters()`, and of targets in `scene.shapes()`.

    More than `most` targets have one ball around all of them.
    """
    emitters, shapes = scene.emitters(), scene.shapes()
    ids = [int(i) for i in dr.reinterpret_array(mi.UInt32, scene.emitters_dr())]
    of_shape = [int(i) for i in dr.reinterpret_array(mi.UInt32, scene.shapes_dr())]
    density, choice, owners = [0.0] * (max(ids) + 1), [0.0] * (max(ids) + 1), []
    for k in lights:
        owner = next((i for i, s in enumerate(shapes) if s.emitter() is emitters[k]), None)
        area = 1.0 if owner is None else float(dr.detach(mi.Float(shapes[owner].surface_area()))[0])
        owners.append(0 if owner is None else of_shape[owner])
        density[ids[k]] = 1 / (len(lights) * area)
        choice[ids[k]] = float(mi.Float(scene.pdf_emitter(k))[0])
    balls = [_ball(shapes[k]) for k in targets]
    if len(balls) > most:
        whole = mi.ScalarBoundingBox3f()
        for k in targets:
            whole.expand(shapes[k].bbox())
        sphere = whole.bounding_sphere()
        balls = [(sphere.center, sphere.radius)]
    stored = tuple((varying(mi.Point3f, list(c)), varying(mi.Float, MARGIN * float(r))) for c, r in balls)
    tables = mi.UInt32([ids[k] for k in lights]), mi.UInt32(owners), mi.Float(density), mi.Float(choice)
    dr.make_opaque(*tables)
    around = None
    if any(mi.has_flag(emitters[k].flags(), mi.EmitterFlags.Infinite) for k in lights):
        sphere = scene.bbox().bounding_sphere()
        around = varying(mi.Point3f, list(sphere.center)), varying(mi.Float, MARGIN * float(sphere.radius))
    return LightSources(*tables, stored, around)


def _ball(shape: mi.Shape) -> tuple[mi.ScalarPoint3f, float]:
    """A ball about the middle of the shape's box that holds the shape: `(centre, radius)`."""
    box = shape.bbox()
    centre = box.center()
    if shape.class_name() == "Sphere":
        return centre, max(box.extents()) / 2
    if shape.is_mesh():
        corners = shape.vertex_position(dr.arange(mi.UInt32, shape.vertex_count()))
        return centre, float(dr.max(dr.norm(dr.detach(corners) - mi.Point3f(centre)))[0])
    return centre, box.bounding_sphere().radius
