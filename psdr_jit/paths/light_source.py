"""Where light subpaths start: on a light, aimed at surfaces that may focus it.

A light is chosen, a point y_0 on it (uniform by area; a point light has one), and a direction ω towards the ball around
one of the targets, uniform in the cone that the ball is seen in. Rays of a directional light and of the sky start in
front of the scene, uniform over the disk across them that hides the ball; the sky's direction is one of its own emitter
sampling. What another way of finding the same segment y_0 → y_1 needs to know of this is one number, the density with
the segment's own measure taken out,

    E = P p_A(y_0) p(ω) / |cosθ_0|          area light; per m² sr, and per unit of cosine
    E = P p(ω) / r²                         point and spot light
    E = P p_⊥(y_0)                          directional light
    E = P p_⊥(y_0) p_sky(−ω)                sky: environment map, constant, sunsky; per m² sr

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

from ..core.cones import towards_sphere
from ..core.varying import varying
from ..scene.registry import registry_indices

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
    density: mi.Float  # by registry index: P p_A(y_0) of an area light, P of all others; 0: not traced
    choice: mi.Float  # by registry index: probability with which next-event estimation chooses the light
    targets: tuple[Ball, ...]
    around: Ball | None = None  # the scene, if rays from far away are among what is traced
    sky: bool = False  # the sky is

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
            ω = dr.select(far, shone(emitter, u, far), ω)
            si.p = dr.select(far, self._from_afar(ω, u_target, v), si.p)
            si.n = dr.select(far & ~delta, ω, si.n)
        si.wi = si.to_local(ω)
        if self.sky:
            si.wi = dr.select(far, ω, si.wi)
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
            ω = dr.select((scaled >= i) | (i == 0), towards_sphere(y, *ball).sample(v), ω)
        return ω

    def _aimed_pdf(self, y: mi.Point3f, ω: mi.Vector3f) -> mi.Float:
        """Density p(ω) per solid angle of `_aim`."""
        return sum(towards_sphere(y, *ball).pdf(ω) for ball in self.targets) / len(self.targets)

    def _from_afar(self, ω: mi.Vector3f, u: mi.Float, v: mi.Point2f) -> mi.Point3f:
        """The start of a ray along ω that meets one of the targets' balls."""
        disk, scaled = mi.warp.square_to_uniform_disk_concentric(v), u * len(self.targets)
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
        return sum(beam_pdf(ball, x, ω) for ball in self.targets) / len(self.targets)

    def segment_density(
        self, emitter: mi.UInt32, y: mi.Point3f, n: mi.Normal3f, ω: mi.Vector3f, x: mi.Point3f, active: mi.Bool
    ) -> mi.Float:
        """E of the segment from `y` on the light `emitter` (registry index, 0: none) along `ω` to `x`; 0: not traced.

        `n`: normal of the light at y, 0 for a delta light. `ω` is not told by the two points: what they tell is
        rounded, and misses a sun disc that was hit near its rim, where densities are 1e5 times smaller.
        """
        known = active & (emitter < varying(mi.UInt32, dr.width(self.density)))
        light = dr.gather(mi.Float, self.density, emitter, known)
        measure = dr.select(dr.all(n == 0), dr.rcp(dr.squared_norm(x - y)), dr.rcp(dr.abs_dot(n, ω)))
        E = light * self._aimed_pdf(y, ω) * measure
        if self.around is not None:
            shining = dr.reinterpret_array(mi.EmitterPtr, dr.select(known, emitter, 0))
            far = known & is_far(shining)
            beams = light * self._beams_pdf(x, ω)
            if self.sky:
                beams *= _shone_pdf(shining, ω, far)
            E = dr.select(far, beams, E)
        return dr.select(known & (light > 0) & dr.isfinite(E), E, 0)


def place_of(emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Point3f:
    """Where point and spot lights are. Not by `sample_ray`, which textures on other lights may not know. Detached."""
    ds, _ = emitter.sample_direction(dr.zeros(mi.SurfaceInteraction3f), mi.Point2f(0.5), active)
    return mi.Point3f(dr.detach(ds.p))


def is_far(emitter: mi.EmitterPtr) -> mi.Bool:
    """Do rays of the light come from infinitely far away?"""
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)


def shone(emitter: mi.EmitterPtr, u: mi.Point2f, active: mi.Bool) -> mi.Vector3f:
    """The direction in which a directional light shines, or one of those of the sky, drawn by `u`. Detached."""
    ds, _ = emitter.sample_direction(dr.zeros(mi.SurfaceInteraction3f), u, active)
    return dr.select(active, -mi.Vector3f(dr.detach(ds.d)), mi.Vector3f(0, 0, 1))


def _shone_pdf(emitter: mi.EmitterPtr, ω: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """Density of `shone` per solid angle, 1 of a directional light."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d = -ω
    delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
    return dr.select(delta, 1, emitter.pdf_direction(dr.zeros(mi.Interaction3f), ds, active & ~delta))


def beam_pdf(ball: Ball, x: mi.Point3f, ω: mi.Vector3f) -> mi.Float:
    """`beam_density` if the line along ω through `x` meets the ball, else 0."""
    centre, radius = ball
    off = x - centre
    meets = dr.squared_norm(off - ω * dr.dot(off, ω)) <= dr.square(radius)
    return dr.select(meets, beam_density(ball), 0)


def beam_density(ball: Ball) -> mi.Float:
    """1 / area of the disk that a ball hides of parallel rays."""
    return dr.inv_pi / dr.square(ball[1])


def light_sources(scene: mi.Scene, lights: Sequence[int], targets: Sequence[int], most: int) -> LightSources:
    """Read off the scene: numbers of lights in `scene.emitters()`, and of targets in `scene.shapes()`.

    More than `most` targets have one ball around all of them.
    """
    emitters, shapes = scene.emitters(), scene.shapes()
    ids = [int(i) for i in dr.reinterpret_array(mi.UInt32, scene.emitters_dr())]
    of_shape = registry_indices(scene)
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
    around, far = None, [emitters[k] for k in lights if mi.has_flag(emitters[k].flags(), mi.EmitterFlags.Infinite)]
    if far:
        sphere = scene.bbox().bounding_sphere()
        around = varying(mi.Point3f, list(sphere.center)), varying(mi.Float, MARGIN * float(sphere.radius))
    return LightSources(*tables, stored, around, any(light.is_environment() for light in far))


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
