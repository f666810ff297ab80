"""The *film* form: places on the film follow what is seen there, as far as a field that is continuous can.

In the other forms a path keeps its place p on the film, and its first vertex slides over whatever moves behind it: of a
picture finer than pixels it sees the slope, which is as large as texels are small, of everything that the sensor passes
an outline and its shadows. Here p itself moves, by w(p) per unit of θ. With h the reconstruction filter of a pixel, f
what paths bring and v the velocity of an outline across the film, Reynolds' transport theorem says

    d/dθ ∫ h f dp = ∫ h (∂f/∂θ + ∇f·w) dp + ∫ f (∇h·w + h div w) dp + ∮ h Δf (v − w)·n dl

for any w that is continuous and 0 around the film, as in the reparameterisation of [Bangaru et al. 2020, §4], where
however w has to agree with v so that the last integral vanishes. Here that one is sampled as ever, and the closer w is
to v the less there is of it. The first integral is the interior term of camera rays that turn by w, the second the same
paths' radiance next to moving places (`interior/film_places.py`), of a box filter across borders of pixels
(`interior/film_borders.py`), and all boundary terms see w as a motion of the sensor: none of them knows this form.

w is bilinear between the corners of pixels, where it is the velocity on the film of the surface that is seen: linear in
all parameters, with weights that are detached. What else it could be would change noise alone, and that is worst at
outlines: by 1/cosθ times the motion of its surface relative to w a vertex slides along its ray, and the second moment
of that diverges (`interior/sphere_rims.py`). So w goes on beyond an outline as it is in front of it, for a pixel:
corners next to something nearer move as that does (`_in_front`), or rest where it rests. Balls and other smooth meshes
that move before a plane had 5 to 10 times less noise by that, and steps at outlines nearly none.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.ad import accumulate, tangents
from ..core.camera_rays import RayNumbers, RayPerPixel, film_position, ray_per_pixel
from ..core.film import sampled_window
from ..core.records import Hit
from ..core.surface_code import top_level_of
from ..core.varying import varying
from ..paths.walk import first_hit
from .motion import Displacements, Motion

#: Distance of a surface in front of another part of the same shape, relative to that one's.
CLEARLY = 0.9


@dataclass(frozen=True)
class FilmFlow:
    """The field w on the film of one sensor, for one `Motion`. Host object; variables of a render call."""

    sensor: mi.Sensor
    motion: Motion  # whose surfaces are followed
    corner: mi.Point2f  # of the sampled window [px]
    columns: mi.UInt32  # of corners of pixels
    last: mi.Point2f  # number of the last pixel in a row, and of the last row
    hit: Hit  # what corners move with: what is seen there, or next to them if that is nearer
    follows: mi.Bool  # by corner: may it move?
    film: mi.Point2f  # where they are, in [0, 1]² of the crop window
    across: tuple[mi.Vector3f, mi.Vector3f]  # ṗ = across · v, of a surface that moves by v; 0 where none is followed
    nodes: mi.Vector2f  # displacement of the corners, attached, of value 0 [px]

    @staticmethod
    def of(
        scene: mi.Scene, sensor: mi.Sensor, film: mi.Film, motion: Motion, moving: mi.UInt32 | None
    ) -> FilmFlow:
        """With corners that have no tangents yet, see `take_tangents`. `moving`: by registry index, 1 if a shape moves
        on the film; None: whatever is seen does.
        """
        lower, upper = sampled_window(film)
        columns, rows = (int(n) + 1 for n in upper - lower)
        corner, width = varying(mi.Point2f, [float(x) for x in lower]), varying(mi.UInt32, columns)
        k = dr.arange(mi.UInt32, columns * rows)
        place = mi.Point2f(mi.Float(k % width), mi.Float(k // width))
        last = varying(mi.Point2f, [columns - 2.0, rows - 2.0])
        with dr.suspend_grad():
            at = film_position(sensor, place + corner)
            ray, _ = sensor.sample_ray(0, 0.5, at, mi.Point2f(0.5))
            _, pi, _ = first_hit(scene, ray, hide_emitters=False)
            hit = _in_front(Hit.of(ray, pi), k, columns, rows)
            follows = (place.x > 0) & (place.y > 0) & (place.x <= last.x) & (place.y <= last.y) & (hit.shape != 0)
            if moving is not None:
                follows &= dr.gather(mi.UInt32, moving, top_level_of(hit.shape), follows) != 0
            per_px = ray_per_pixel(sensor, place + corner, _through(mi.Point2f(0.5)))
            across = _across(per_px, ray, dr.select(follows, hit.t, 1), follows)
            dr.eval(hit, at, across, follows)
        nodes = dr.zeros(mi.Vector2f, columns * rows)
        with dr.resume_grad():
            dr.enable_grad(nodes)
        return FilmFlow(sensor, motion, corner, width, last, hit, follows, at, across, nodes)

    def _displacement(self, moving: Displacements) -> mi.Vector3f:
        """Of the surfaces at the corners relative to the camera rays there, attached."""
        x = self.hit.o + self.hit.d * dr.select(self.hit.shape != 0, self.hit.t, 1)
        return moving.of_surface(self.hit) - moving.of_camera(self.film, mi.Point2f(0.5), x)

    def take_tangents(self) -> None:
        """Let the corners move as the surfaces there: before the terms run in forward mode."""
        with self.motion.attached() as moving:
            v = tangents(self._displacement(moving))
        with dr.resume_grad():
            dr.set_grad(self.nodes, mi.Vector2f(dr.dot(self.across[0], v), dr.dot(self.across[1], v)))

    def hand_on(self) -> None:
        """Add the gradients of the corners to those of what moves: after the terms have run in backward mode."""
        with dr.resume_grad():
            λ = mi.Vector2f(dr.grad(self.nodes))
        λ = λ.x * self.across[0] + λ.y * self.across[1]
        dr.eval(λ)
        with self.motion.attached() as moving:
            accumulate(dr.dot(λ, self._displacement(moving)))

    def _pixel(self, p: mi.Point2f) -> tuple[mi.Point2f, tuple[mi.UInt32, ...]]:
        """Where in its pixel the film position `p` [px] is, and the corners of that: two above, two below."""
        q = dr.detach(p) - self.corner
        pixel = dr.clip(dr.floor(q), 0, self.last)
        above = mi.UInt32(pixel.y) * self.columns + mi.UInt32(pixel.x)
        below = above + self.columns
        return q - pixel, (above, above + 1, below, below + 1)

    def may_move(self, p: mi.Point2f) -> mi.Bool:
        """May the film position `p` [px] move?"""
        _, corners = self._pixel(p)
        found = mi.Bool(False)
        for k in corners:
            found |= dr.gather(mi.Bool, self.follows, k)
        return found

    def at(self, p: mi.Point2f) -> tuple[mi.Vector2f, mi.Float]:
        """Displacement of the film position `p` [px] and its divergence, attached, of value 0."""
        s, corners = self._pixel(p)
        a, b, c, d = (dr.gather(mi.Vector2f, self.nodes, k) for k in corners)
        left, right = dr.lerp(a, c, s.y), dr.lerp(b, d, s.y)
        above, below = dr.lerp(a, b, s.x), dr.lerp(c, d, s.x)
        return mi.Vector2f(dr.lerp(left, right, s.x)), (right.x - left.x) + (below.y - above.y)


def _through(aperture: mi.Point2f) -> RayNumbers:
    """Of a ray whose time and wavelength do not matter."""
    return RayNumbers(aperture, mi.Float(0), mi.Float(0.5))


def _in_front(hit: Hit, k: mi.UInt32, columns: int, rows: int) -> Hit:
    """By corner `k` of pixels, in rows of `columns`: the nearest of the hits there and at the eight corners around.

    On one and the same shape only what is clearly nearer counts: elsewhere it is the same surface, seen at a slant.
    """
    width = varying(mi.UInt32, columns)
    x, y = mi.Int32(k % width), mi.Int32(k // width)
    x_end, y_end = varying(mi.Int32, columns), varying(mi.Int32, rows)
    dr.eval(hit)
    nearest, t = mi.UInt32(k), dr.select(hit.shape != 0, hit.t, dr.inf)
    own = mi.Float(t)
    for dx, dy in ((dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy):
        there = (x + dx >= 0) & (x + dx < x_end) & (y + dy >= 0) & (y + dy < y_end)
        other = mi.UInt32((y + dy) * x_end + x + dx)
        shape = dr.gather(mi.UInt32, hit.shape, other, there)
        t_other = dr.gather(mi.Float, hit.t, other, there)
        farthest = dr.select(shape == hit.shape, CLEARLY * own, own)
        nearer = there & (shape != 0) & (t_other < dr.minimum(t, farthest))
        nearest, t = dr.select(nearer, other, nearest), dr.select(nearer, t_other, t)
    return dr.gather(Hit, hit, nearest)


def _across(
    per_px: RayPerPixel, ray: mi.Ray3f, t: mi.Float, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Rows that turn the velocity of a surface at distance `t` into that of its image, the motion along the ray aside:
    the pseudo-inverse of the two vectors by which the end of the ray moves as p does by a pixel.
    """
    x, y = (o + t * d for o, d in zip(per_px.o, per_px.d, strict=True))
    x, y = (a - ray.d * dr.dot(a, ray.d) for a in (x, y))
    xx, xy, yy = dr.squared_norm(x), dr.dot(x, y), dr.squared_norm(y)
    det = xx * yy - xy * xy
    scale = dr.select(active & (det > 0), dr.rcp(det), 0)
    return (yy * x - xy * y) * scale, (xx * y - xy * x) * scale


@dataclass(frozen=True)
class FilmMotion(Motion):
    """A motion as it is seen from film positions that follow a flow."""

    base: Motion
    flow: FilmFlow

    @property
    def of_scene(self) -> bool:
        return self.base.of_scene

    @contextmanager
    def attached(self, *variables) -> Iterator[Displacements]:
        with self.base.attached(*variables, self.flow.nodes) as moving:
            yield FilmDisplacements(moving, self.flow)

    def camera_tangents(self, ray: mi.Ray3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """At places that rest: a ray alone does not tell where on the film it is, see `film_places.camera_tangents`."""
        return self.base.camera_tangents(ray)


@dataclass(frozen=True)
class FilmDisplacements(Displacements):
    """Those of another motion, but for camera rays."""

    base: Displacements
    flow: FilmFlow

    def _turned(self, film: mi.Point2f, aperture: mi.Point2f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Displacements `(of the origin, of the direction)` of the camera ray, as its film position follows."""
        sensor = self.flow.sensor
        p = dr.detach(film) * sensor.film().crop_size() + sensor.film().crop_offset()
        shift, _ = self.flow.at(p)
        return ray_per_pixel(sensor, p, _through(aperture)).moved(shift)

    def of_surface(self, hit: Hit) -> mi.Vector3f:
        return self.base.of_surface(hit)

    def of_edge(self, table, location, ω: mi.Vector3f) -> mi.Vector3f:
        return self.base.of_edge(table, location, ω)

    def of_camera(self, film: mi.Point2f, aperture: mi.Point2f, x: mi.Point3f) -> mi.Vector3f:
        o, d = self._turned(film, aperture)
        ray, _ = self.flow.sensor.sample_ray(0, 0.5, film, aperture)
        depth = dr.detach(dr.dot(x - ray.o, ray.d))
        return self.base.of_camera(film, aperture, x) + o + d * depth

    def of_view(self, film: mi.Point2f, aperture: mi.Point2f, ω: mi.Vector3f) -> mi.Vector3f:
        _, d = self._turned(film, aperture)
        return self.base.of_view(film, aperture, ω) + d

    def of_light(
        self, emitter: mi.EmitterPtr, it: mi.Interaction3f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Vector3f]:
        return self.base.of_light(emitter, it, active)

    def material_point(self, hit: Hit, wavelengths) -> mi.Point3f:
        return self.base.material_point(hit, wavelengths)

    def surface(self, hit: Hit, ray: mi.Ray3f, flags) -> mi.SurfaceInteraction3f:
        return self.base.surface(hit, ray, flags)

    def material(self, hit: Hit, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        return self.base.material(hit, ray, active)

    def footprint(self, kind: str, film: mi.Point2f, aperture: mi.Point2f) -> mi.Float:
        return self.base.footprint(kind, film, aperture)

    def of_lights(self) -> mi.Vector3f:
        return self.base.of_lights()
