"""Light subpaths as one more way to find a path: how likely, next to the other two.

A path x_1 … x_s from the sensor, with light from y_0, can be found by next-event estimation at x_s (N), by scattering
that meets the light (B), and by a light subpath y_0, x_s, …, x_1 whose end is connected to the sensor (L). Only what
light subpaths are meant for is asked of them: x_s focuses (`focuses`), s ≥ 2, and x_1 is not left by a delta lobe.

*Densities.* Write p_k for the density of the direction x_k → x_{k+1} by which the camera's path goes on (x_{s+1} = y_0)
and p̃_k for that of x_k → x_{k−1} by which the light's does, per solid angle; c_k^+ and c_k^− for the cosines between
the surface normal at x_k and its directions towards the light and towards the sensor; n_E and n_L for the numbers of
camera samples per pixel and of light subpaths, J for the area perpendicular to the view at x_1 that a pixel sees. In
terms of area every direction's density turns into one of points by cos/r² at its far end. All r² of the two cancel,

    n_E p_B = n_E (c_1^-/J) Π_{k=1..s} p_k c_{k+1}^-/r_k²
    n_L p_L = n_L E (c_{s+1}^- c_s^+/r_s²) Π_{k=2..s} p̃_k c_{k-1}^+/r_{k-1}²

(c_{s+1}^- at the light, r_k = |x_{k+1} − x_k|, E: `light_source.py`), and what is left belongs to vertices one by one:

    n_L p_L / (n_E p_B) = (n_L/n_E) E · h_1/p_1 · Π_{k=2..s} h_k/p_k      h_k = p̃_k c_k^+/c_k^-,   h_1 = J c_1^+/c_1^-

and with the density p_em of the emitter sample at x_s in place of p_s, the same for N. The first product without E is
carried along the camera's path (`Trail`); along the light's, its inverse is (`light_walk.py`). Both ask the same
functions of the same path, which is all that the weights of multiple importance sampling have to satisfy. The roulette
enters estimates, not weights.

At a delta lobe densities are probabilities P_k, P̃_k times delta functions of directions that are mapped to each other.
The étendue η² c dω does not change on the way, η_k^± the refractive indices on both sides, which leaves

    h_k/p_k = (P̃_k/P_k) (η_k^-/η_k^+)²

there. N cannot find what x_s does by such a lobe, and of a point or spot light neither can B: that is left to L.

*Weights* are those of the power heuristic, w_i = p_i² / Σ_j p_j² [Veach 1997, §9.2.4]. Two of the three are known from
the walk already, 1/w = 1 + (p_j/p_i)²; the third adds (p_L/p_i)².
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, pixel_footprint
from .critical_angle import CriticalAngle
from .delta_step import delta_step
from .light_source import LightSources
from .scattering import Mixture, Scattering, delta_probability, reverse_pdf

#: Fewest surface vertices of a path that light subpaths find: the sensor's own view of a rough surface needs no help.
SHORTEST = 2

#: Cosine at which the sensor sees a surface, below which its paths are the camera's alone. What is seen slides by
#: 1/cosθ, and a light subpath meets such places as often as any other (the camera does less often, and where outlines
#: are round it looks for them: `interior/sphere_rims`).
ASLANT = 0.02

#: Lobes that keep near the mirrored or bent direction, or in it.
FOCUSING = ("Glossy", "DeltaReflection", "DeltaTransmission")


def focuses(bsdf: mi.BSDFPtr) -> mi.Bool:
    """May the surface gather light on others: does all that it scatters keep near the mirrored or bent direction?"""
    flags = bsdf.flags()
    focusing = mi.Bool(False)
    for lobe in FOCUSING:
        focusing |= mi.has_flag(flags, getattr(mi.BSDFFlags, lobe))
    return focusing & ~mi.has_flag(flags, mi.BSDFFlags.Diffuse)


@dataclass
class Trail:
    """What a camera path carries to its next vertex for the sake of its weights. A PyTree: part of a loop's state."""

    q: mi.Float  # (n_L/n_E) Π h_k/p_k over the vertices so far
    focuses: mi.Bool  # the last of them does


@dataclass(frozen=True)
class LightTechnique:
    """Host object of a job."""

    sources: LightSources
    frame: SensorFrame
    ratio: mi.Float  # n_L/n_E: light subpaths for each camera sample of a pixel
    longest: int  # surface vertices of a light subpath, at most
    exclusive: bool  # what light subpaths find is left to them
    delta_lobes: bool = False  # the scene has some
    margin: mi.Float | float = 0.0  # around the film in which light that nothing else finds counts as well [px]
    critical: CriticalAngle | None = None  # of light subpaths as well, see `PathLimits`

    @property
    def mixture(self) -> Mixture:
        """How light subpaths sample directions."""
        return Mixture(critical=self.critical)

    def start(self) -> Trail:
        return Trail(mi.Float(self.ratio), mi.Bool(False))

    def share_emission(
        self, mis: mi.Float, trail: Trail, k: mi.UInt32, x: mi.Point3f, si: mi.SurfaceInteraction3f, emitter
    ) -> mi.Float:
        """Weight of the emission that is met at `si`, the vertex number `k` (from 0), coming from `x`.

        `mis`: weight against next-event estimation alone.
        """
        found = self._finds(k) & trail.focuses & (mis > 0)
        y, n, ω = si.p, si.n, si.to_world(si.wi)
        if self.sources.sky:
            met = si.is_valid()
            y, n, ω = (dr.select(met, *of) for of in ((y, x), (n, si.wi), (ω, si.wi)))
        else:
            found &= si.is_valid()
        E = self.sources.segment_density(dr.reinterpret_array(mi.UInt32, emitter), y, n, ω, x, found)
        return self._shared(mis, trail.q * E)

    def share_next_event(
        self, mis: mi.Float, trail: Trail, k: mi.UInt32, si, bsdf: mi.BSDFPtr, ω: mi.Vector3f, ds, active: mi.Bool
    ) -> mi.Float:
        """Weight of the emitter sample `ds` in the local direction `ω` at `si`, the vertex number `k`."""
        found = active & self._finds(k + 1) & focuses(bsdf) & (ds.pdf > 0)
        n = dr.select(ds.delta, 0, ds.n)
        E = self.sources.segment_density(dr.reinterpret_array(mi.UInt32, ds.emitter), ds.p, n, -ds.d, si.p, found)
        found &= E > 0
        h = reverse_pdf(mi.BSDFContext(), si, bsdf, ω, self.mixture, found) * cosine_ratio(si, ω)
        return self._shared(mis, dr.select(found, trail.q * h / ds.pdf * E, 0))

    def carry_on(
        self, trail: Trail, k: mi.UInt32, si, bsdf: mi.BSDFPtr, onward: Scattering, active: mi.Bool
    ) -> Trail:
        """The trail behind `si`, the vertex number `k`, which the path leaves by `onward`."""
        first = k == 0
        found = active & (trail.q > 0) & (onward.pdf > 0) & (k < self.longest) & ~(onward.delta & first)
        back = si.to_world(si.wi)
        found &= ~(first & seen_aslant(si, back))
        view = pixel_footprint(self.frame, si.p, -back)
        turned = reverse_pdf(mi.BSDFContext(), si, bsdf, onward.wo, self.mixture, found & ~first & ~onward.delta)
        q = trail.q * dr.select(first, view, turned) * cosine_ratio(si, onward.wo) / onward.pdf
        if self.delta_lobes:
            delta = found & onward.delta
            P = self._delta_reverse(si, bsdf, onward.wo, delta)
            q = dr.select(delta, trail.q * P / (onward.pdf * dr.square(onward.η)), q)
        return Trail(dr.select(found, q, 0), focuses(bsdf))

    def _delta_reverse(self, si, bsdf: mi.BSDFPtr, wo: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Probability P̃ with which a light subpath that arrives from `wo` (local) takes the delta lobe to `si.wi`."""
        turned = mi.SurfaceInteraction3f(si)
        turned.wi = mi.Vector3f(wo)
        ctx = mi.BSDFContext(mi.TransportMode.Importance)
        back = delta_step(ctx, turned, bsdf, si.to_world(si.wi), active)
        return delta_probability(bsdf, back.probability, self.mixture)

    def _finds(self, s: mi.UInt32) -> mi.Bool:
        """By the number of surface vertices."""
        return (s >= SHORTEST) & (s <= self.longest)

    def _shared(self, mis: mi.Float, likelier: mi.Float) -> mi.Float:
        """The weight `mis` once there is a third way, `likelier` times as likely."""
        w = dr.select(likelier > 0, 0, mis) if self.exclusive else dr.rcp(dr.rcp(mis) + dr.square(likelier))
        return dr.detach(dr.select(dr.isfinite(w), w, 0))


def seen_aslant(si: mi.SurfaceInteraction3f, ω: mi.Vector3f) -> mi.Bool:
    """Is the surface seen along ω so slantwise that what camera paths find there is left to them? See `ASLANT`."""
    return dr.abs_dot(si.n, ω) < ASLANT


def cosine_ratio(si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> mi.Float:
    """|n·wo| / |n·wi| with the geometric normal, both local directions; 0 where it is not defined."""
    cos_o, cos_i = dr.abs_dot(si.n, si.to_world(wo)), dr.abs_dot(si.n, si.to_world(si.wi))
    return dr.select(cos_i > 0, cos_o / cos_i, 0)


def average(value: mi.Spectrum) -> mi.Float:
    """Mean over the channels; `dr.mean` writes the number of lanes into the kernel."""
    return dr.sum(value) * (1 / dr.size_v(mi.Spectrum))
