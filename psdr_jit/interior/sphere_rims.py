"""Camera samples close to the outlines of spheres, where the interior term has no finite variance without them.

In the spatial form a vertex on a moving surface slides along its ray by 1/cosθ (`spatial.py`). Over the disk that a
sphere shows, s = cos²θ = 1 − b²/r² is uniform, b the distance at which the ray passes the centre: the second moment of
the slide is ∫ ds/s, which diverges at the outline. Faces of a mesh end before that; a sphere does not.

So beside the even samples of the film there are some with density ∝ s^(−1/2) up to cosθ = C, for which the slide has
the same weight at every s: those with cosθ uniform. By the balance heuristic [Veach 1997, §9.2.2], a film position p
that both may draw counts

    1 / (n_film + n_rim),    n_film: samples of the pixel,  n_rim = N pdf_s pdf_φ · (ds dφ/dΩ) · (dΩ/dp)   [1/px²].

With d the distance to the centre and θ' the angle to it, sinθ' = (r/d) √(1 − s), and so

    dΩ = sinθ' dθ' dφ = r²/(2 d² cosθ') ds dφ,    pdf_s = 1 / (2 C √s),    pdf_φ = 1/2π.

What only one of them can draw, a position outside of the window or a sphere behind something else, is left to that one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.camera_rays import RayNumbers, rays_at
from ..core.compaction import compact
from ..core.film_samples import FilmSamples
from ..core.low_discrepancy import LaneSampler, lane_sampler
from ..core.sensor_frame import KINDS, lens_point, look_at, pixel_footprint
from ..core.streams import Stream, stream_seed
from ..core.surface_code import surface_code
from ..core.varying import varying
from ..paths.edge_on import GRAZING
from ..plan.job import Job
from ..scene.poses import spheres_of
from ..scene.registry import registry_values
from .camera_pass import CameraPass

#: cosθ up to which there are samples: the outer 8 % of a sphere's radius. What is met more edge-on than `GRAZING` has
#: no derivative.
MOST_COS = 0.4

#: How many there are, relative to the samples of the film.
RIM_SHARE = 0.125


@dataclass(frozen=True)
class RimPass:
    """Camera samples of one pass on the rims of spheres; `ray` is attached to the sensor, everything else detached."""

    seed: mi.UInt32
    ray: mi.RayDifferential3f
    weight: mi.Spectrum
    p: mi.Point2f  # [px]

    sought = True  # every one of them meets what moves
    per_px = None  # film positions rest

    @property
    def count(self) -> int:
        """Number of samples."""
        return dr.width(self.p)

    def sampler(self, lane: mi.UInt32) -> LaneSampler:
        """What is random about the paths of these samples."""
        return LaneSampler(mi.UInt32(lane), dr.zeros(mi.UInt32, dr.width(lane)) + self.seed)

    def develop(self, film: mi.Film, value: mi.Spectrum) -> mi.TensorXf:
        """Image of what the samples bring."""
        return films.develop_boundary(
            film, self.p, value * self.weight, mi.Float(0), self.ray.wavelengths, mi.Bool(True)
        )

    def adjoint(self, film: mi.Film, grad_in: mi.TensorXf) -> mi.Spectrum:
        """Of `develop`: derivative of ⟨grad_in, image⟩ with respect to each value."""
        return self.weight * films.boundary_adjoint(film, self.p, grad_in, self.ray.wavelengths)


@dataclass
class _Place:
    """A position on the film that is kept. Detached."""

    p: mi.Point2f  # [px]
    numbers: RayNumbers
    weight: mi.Float


@dataclass(frozen=True)
class SphereRims:
    """The spheres of a scene whose outlines matter, as its sensor sees them. Host object."""

    job: Job
    count: int
    numbers: mi.UInt32  # by registry index of a shape: its number among the spheres, from 1; 0: no such sphere
    centres: mi.Point3f
    radii: mi.Float

    @staticmethod
    def of(job: Job) -> SphereRims | None:
        """None where no vertex slides on a sphere, as much as its rim tells, or none is known to be seen."""
        known = KINDS.get(job.sensor.class_name()) in ("perspective", "thinlens")
        if job.form != "spatial" or job.film_flow is not None or not known:
            return None
        found = [
            shape.index
            for shape in job.facts.shapes
            if shape.plugin == "sphere" and shape.index >= 0 and (shape.geometry or job.facts.camera_moves)
        ]
        if not found:
            return None
        numbers = registry_values(job.scene, {index: k + 1 for k, index in enumerate(found)})
        return SphereRims(job, len(found), numbers, *spheres_of(job.scene, found))

    def left_to_film(self, samples: FilmSamples, ray: mi.Ray3f) -> mi.Float:
        """Weight of the film's own `samples`, with their camera rays: n_film / (n_film + n_rim)."""
        n_film = samples.in_pixel(dr.arange(mi.UInt32, samples.count))
        _, n_rim = self._met(ray, self._samples(samples))
        return n_film / (n_film + n_rim)

    def sample(self, samples: FilmSamples, seed: mi.UInt32) -> RimPass | None:
        """Samples on rims beside those of the film; None if there are none. `seed`: of the pass."""
        sensor, frame = self.job.sensor, self.job.frame
        n = self._samples(samples)
        rng = lane_sampler(stream_seed(seed, Stream.SPHERE_RIMS), dr.arange(mi.UInt32, n))
        u = rng.next_2d()
        k = dr.minimum(mi.UInt32(rng.next_1d() * self.count), self.count - 1)
        numbers = RayNumbers.draw(sensor, rng)

        r, o = dr.gather(mi.Float, self.radii, k), frame.to_world @ lens_point(frame, numbers.aperture)
        axis = dr.gather(mi.Point3f, self.centres, k) - o
        d, cos_θ = dr.norm(axis), dr.lerp(mi.Float(GRAZING), MOST_COS, u.x)
        sin = r / d * dr.sqrt(1 - dr.square(cos_θ))
        cos = dr.safe_sqrt(1 - dr.square(sin))
        sin_φ, cos_φ = dr.sincos(dr.two_pi * u.y)
        ω = mi.Frame3f(axis / d).to_world(mi.Vector3f(sin * cos_φ, sin * sin_φ, cos))
        x = mi.Point3f(o + (d * cos - r * cos_θ) * ω)
        p = look_at(frame, x, numbers.aperture).p

        n_film = samples.at(p)
        valid = (d > r) & ((frame.to_local @ x).z > 0) & (n_film > 0)  # the near plane may cut a sphere open
        ray = mi.Ray3f(dr.detach(rays_at(sensor, p, numbers)[0]))
        met, n_rim = self._met(ray, n, valid)
        kept = compact(_Place(p, numbers, dr.rcp(n_film + n_rim)), valid & (met == k + 1))
        if kept is None:
            return None
        ray, weight = rays_at(sensor, kept.p, kept.numbers)
        return RimPass(stream_seed(seed, Stream.SPHERE_RIM_PATHS), ray, dr.detach(weight) * kept.weight, kept.p)

    @staticmethod
    def _samples(samples: FilmSamples) -> int:
        return max(1, round(RIM_SHARE * samples.count))

    def _met(self, ray: mi.Ray3f, n: int, active: mi.Bool | bool = True) -> tuple[mi.UInt32, mi.Float]:
        """`(number, n_rim)` of the sphere whose rim a camera ray meets before anything else; 0 if it meets none.

        `n`: samples on rims.
        """
        frame = self.job.frame
        code = surface_code(self.job.scene.ray_intersect_preliminary(ray, coherent=True, active=active))
        number = dr.gather(mi.UInt32, self.numbers, code, active & (code < dr.width(self.numbers)))
        among = number > 0
        r = dr.gather(mi.Float, self.radii, number - 1, among)
        o = ray(-(frame.to_local @ ray.o).z / (frame.to_local @ ray.d).z)  # on the lens
        axis = dr.gather(mi.Point3f, self.centres, number - 1, among) - o
        along = dr.dot(axis, ray.d)
        b = dr.norm(axis - along * ray.d)
        cos_θ = dr.safe_sqrt((r - b) * (r + b)) / r
        d = dr.norm(axis)
        pdf_sφ = dr.inv_two_pi / (2 * (MOST_COS - GRAZING) * cos_θ)
        pdf_sa = pdf_sφ * 2 * d * along / dr.square(r)  # d² cosθ' = d · along
        x = mi.Point3f(ray(along))
        per_px = pixel_footprint(frame, x, ray.d) / dr.squared_norm(x - o)
        among &= (d > r) & (cos_θ > GRAZING) & (cos_θ < MOST_COS)
        return dr.select(among, number, 0), dr.select(among, varying(mi.Float, n / self.count) * pdf_sa * per_px, 0)


def with_rims(rims: SphereRims | None, p: CameraPass) -> list[CameraPass | RimPass]:
    """A pass of camera samples, and what it leaves to samples on the rims of spheres."""
    if rims is None:
        return [p]
    left = rims.left_to_film(p.samples, mi.Ray3f(dr.detach(p.ray)))
    on_rims = rims.sample(p.samples, p.seed)
    return [replace(p, weight=p.weight * left)] + ([] if on_rims is None else [on_rims])
