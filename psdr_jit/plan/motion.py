"""How fast is this point? One question to the scene's own motion and to a probe's alike.

Estimators ask for *displacements*: attached vectors of value 0 whose derivative is the velocity per unit of θ. Forward
mode reads their tangents, backward mode sends adjoints into them. Who answers is the job's `Motion`: the scene, whose
enabled parameters move vertices, poses, lights and the camera; or a probe (`probe_motion.py`), which moves everything
that can move as one body, whatever the parameters do.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.ad import tangents
from ..core.records import Hit
from ..core.sensor_frame import film_area
from ..paths.light_source import is_far
from ..paths.surface_at import surface_at
from ..scene.surfaces import Surfaces


class Displacements(ABC):
    """What moves, inside of the scope in which it is attached. Vectors of value 0 in world space [m]."""

    @abstractmethod
    def of_surface(self, hit: Hit) -> mi.Vector3f:
        """Of the material point at the end of `hit`; 0 where there is no surface."""

    @abstractmethod
    def of_edge(self, table, location, ω: mi.Vector3f) -> mi.Vector3f:
        """Of a point of the edge table, seen by lines of the fixed direction ω."""

    @abstractmethod
    def of_camera(self, film: mi.Point2f, aperture: mi.Point2f, x: mi.Point3f) -> mi.Vector3f:
        """Of the point at the depth of x on the camera ray through a fixed film position ([0, 1]², crop window)."""

    @abstractmethod
    def of_view(self, film: mi.Point2f, aperture: mi.Point2f, ω: mi.Vector3f) -> mi.Vector3f:
        """Of the direction ω of that ray."""

    @abstractmethod
    def of_light(
        self, emitter: mi.EmitterPtr, it: mi.Interaction3f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Of a delta light as seen from `it`: `(of its position, of the direction towards it)`."""

    def of_light_start(self, emitter: mi.EmitterPtr, hit: Hit, active: mi.Bool) -> mi.Vector3f:
        """Of the start of the segment `hit` from a delta light, of which the end keeps its place on its surface.

        Of a directional light, whose ray is any along its direction d, x + t d that which meets it: ẋ = v − t ḋ.
        """
        r = dr.select(hit.shape != 0, hit.t, 1)
        it = dr.zeros(mi.Interaction3f)
        it.p = hit.o + hit.d * r
        of_place, towards = self.of_light(emitter, it, active)
        return dr.select(is_far(emitter), self.of_surface(hit) + r * towards, of_place)

    @abstractmethod
    def material_point(self, hit: Hit, wavelengths) -> mi.Point3f:
        """The material point at the end of `hit`, attached to its motion."""

    @abstractmethod
    def surface(self, hit: Hit, ray: mi.Ray3f, flags) -> mi.SurfaceInteraction3f:
        """The surface met by the attached `ray`, whose intersection is `hit`: `compute_surface_interaction`."""

    @abstractmethod
    def material(self, hit: Hit, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """The same material point with all that is known of it; `ray` is that of `hit`."""

    @abstractmethod
    def footprint(self, kind: str, film: mi.Point2f, aperture: mi.Point2f) -> mi.Float:
        """Area across the camera ray through a fixed film position that a pixel sees at a fixed distance, relative to
        what it is: of value 1, and changed by what is no motion of the sensor alone. `kind`: of the sensor.
        """

    @abstractmethod
    def of_lights(self) -> mi.Vector3f:
        """Of the lights without a shape, on top of what their own parameters do."""


class Motion(ABC):
    """Host object of a job: opens the scope in which displacements are attached."""

    @property
    def of_scene(self) -> bool:
        """Is it what the scene's parameters stand for, and not a probe's?"""
        return False

    @abstractmethod
    def attached(self, *variables):
        """Context manager that yields `Displacements`. `variables` are attached as well, their gradients enabled."""

    @abstractmethod
    def camera_tangents(self, ray: mi.Ray3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """`(ȯ, ḋ)` of attached camera rays, detached."""


@dataclass(frozen=True)
class SceneMotion(Motion):
    """The motion that the enabled parameters of the scene stand for."""

    sensor: mi.Sensor
    surfaces: Surfaces | None = None

    @property
    def of_scene(self) -> bool:
        return True

    @contextmanager
    def attached(self, *variables) -> Iterator[Displacements]:
        with dr.resume_grad():
            dr.enable_grad(*variables)
            yield SceneDisplacements(self.sensor, self.surfaces)

    def camera_tangents(self, ray: mi.Ray3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        with dr.resume_grad():
            return tangents(ray.o, ray.d)


def moved(x: mi.Vector3f) -> mi.Vector3f:
    """The derivative of `x` on a value of 0."""
    return mi.Vector3f(x - dr.detach(x))


@dataclass(frozen=True)
class SceneDisplacements(Displacements):
    """Read off Mitsuba's own attached geometry."""

    sensor: mi.Sensor
    surfaces: Surfaces | None

    def of_surface(self, hit: Hit) -> mi.Vector3f:
        there = hit.shape != 0
        x = surface_at(self.surfaces, hit.intersection(), mi.Ray3f(hit.o, hit.d), _follow(), there).p
        return dr.select(there, moved(x), 0)

    def of_edge(self, table, location, ω: mi.Vector3f) -> mi.Vector3f:
        return table.displacement(location, ω)

    def of_camera(self, film: mi.Point2f, aperture: mi.Point2f, x: mi.Point3f) -> mi.Vector3f:
        ray, _ = self.sensor.sample_ray(0, 0.5, film, aperture)
        return moved(ray.o + ray.d * dr.detach(dr.dot(x - ray.o, ray.d)))

    def of_view(self, film: mi.Point2f, aperture: mi.Point2f, ω: mi.Vector3f) -> mi.Vector3f:
        ray, _ = self.sensor.sample_ray(0, 0.5, film, aperture)
        return moved(ray.d)

    def of_light(
        self, emitter: mi.EmitterPtr, it: mi.Interaction3f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Vector3f]:
        ds, _ = emitter.sample_direction(it, mi.Point2f(0.5), active)
        return moved(ds.p), moved(ds.d)

    def material_point(self, hit: Hit, wavelengths) -> mi.Point3f:
        pi = hit.intersection()
        ray = mi.Ray3f(hit.o, hit.d, 0, wavelengths)
        return surface_at(self.surfaces, pi, ray, _follow(), pi.is_valid()).p

    def surface(self, hit: Hit, ray: mi.Ray3f, flags) -> mi.SurfaceInteraction3f:
        return surface_at(self.surfaces, hit.intersection(), ray, flags)

    def material(self, hit: Hit, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        return surface_at(self.surfaces, hit.intersection(), ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)

    def footprint(self, kind: str, film: mi.Point2f, aperture: mi.Point2f) -> mi.Float:
        ray, _ = self.sensor.sample_ray(0, 0.5, film, aperture)
        cos_θ = dr.dot(ray.d, dr.normalize(self.sensor.world_transform() @ mi.Vector3f(0, 0, 1)))
        # r² cos³θ of the area at distance 1; a parallel view has θ = 0
        return dr.relative_grad(film_area(self.sensor, kind)) * dr.relative_grad(cos_θ * dr.square(cos_θ))

    def of_lights(self) -> mi.Vector3f:
        return mi.Vector3f(0)


def _follow():
    """The surface point stays on its material while the shape moves; nothing else of the interaction is asked for."""
    return mi.RayFlags.Minimal | mi.RayFlags.FollowShape
