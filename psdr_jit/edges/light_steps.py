"""Steps that a light throws on surfaces: where they are, what they part, how they move.

A light with a position emits along rays p(t, s) = o + s M d(t): M its `to_world`, o = M 0, and d(t) a curve in its own
space across which its emission steps,

    d(t) = (q(t), 1),                        a line of its film (`light_step_rows.py`), q an affine function of (u, v)
    d(t) = (sin θ cos φ, sin θ sin φ, cos θ),   φ(t) of an arc of its rim, θ half of its opening angle

These rays form a sheet that is rigidly attached to the light, and the step on a receiver is where it cuts the surface.
Hence the velocity of the step at x = p(t, s) is that of the light's own space there, Ṁ s d + M s ḋ: what it is along
the sheet does not matter. ḋ is 0 but where the opening of a spot is differentiated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from ..core.joining import joined, pointers
from ..core.varying import varying
from ..scene.poses import Poses
from .curves import transform_point, transform_vector
from .light_step_rows import LightStepRows
from .location import EdgeLocation

#: How far beside a rim its sides are looked at [rad]: as a share of its angle, and as the rounding of its cosine,
#: eight units in the last place over the sine.
RIM_INSET, RIM_ROUNDING = 1e-4, 5e-7

#: Of the cone of a spot on its picture, in texture coordinates.
SPOT_RADIUS = 0.5

#: A row is weighed by the steps at the middles of as many parts of it ...
PROBES = 3

#: ... and by this share of the mean of all rows, for what lies between.
UNPROBED = 0.1

#: Where lights are asked about themselves in spectral variants [nm]: in the middle of what is visible.
WAVELENGTH = 550.0


@dataclass
class LightFilm:
    """How texture coordinates lie on the plane z = 1 of a light; one entry per light, or per sample."""

    centre: mi.Point2f  # texture coordinates of the axis
    size: mi.Vector2f  # of the unit square; negative where an axis is mirrored
    rim: mi.Float  # angle θ of a spot [rad], else 0


@dataclass
class LightRay:
    """A ray of a light along one of its steps; detached, one entry per sample."""

    emitter: mi.EmitterPtr
    o: mi.Point3f  # of the light [m]
    d: mi.Vector3f  # unit, away from the light
    n_perp: mi.Vector3f  # unit, across the step
    across: mi.Float  # |∂d/∂t × d|: length of the step per unit of t and distance
    aside: mi.Vector3f  # at unit distance, from the step to where the side n_perp is looked at
    scale: mi.Float  # d in the light's space per unit of distance

    def step(self, r: mi.Float, wavelengths, active: mi.Bool) -> mi.Spectrum:
        """E(+n_perp) − E(−n_perp): what is more on one side than on the other at the distance r, for a surface that
        faces the light.
        """
        plus, minus = (self._exposure(self.d + side * self.aside, r, wavelengths, active) for side in (1, -1))
        return plus - minus

    def _exposure(self, d: mi.Vector3f, r: mi.Float, wavelengths, active: mi.Bool) -> mi.Spectrum:
        it = dr.zeros(mi.Interaction3f)
        it.p, it.wavelengths = self.o + r * d, wavelengths
        return self.emitter.sample_direction(it, mi.Point2f(0.5), active)[1]


@dataclass(frozen=True)
class LightSteps:
    """The steps of all lights of a scene that have any: a table of rows, see `sampling.rows.Table`."""

    rows: LightStepRows
    lights: tuple[mi.Emitter, ...]
    films: LightFilm  # by light, detached
    moving: mi.UInt32  # by light: 1 if it can move
    reshaped: bool  # the opening of a spot is differentiated
    far: float  # distance at which lights are asked about themselves [m]: the size of the scene

    @cached_property
    def poses(self) -> Poses:
        return Poses.of(self.lights)

    def moves(self, at: EdgeLocation) -> mi.Bool:
        return dr.gather(mi.UInt32, self.moving, dr.gather(mi.UInt32, self.rows.light, at.row)) != 0

    def displacement(self, at: EdgeLocation, ω: mi.Vector3f) -> mi.Vector3f:
        """As of `EdgeKind`; `at.scale`: s of the ray on which x lies."""
        rows = dr.gather(LightStepRows, self.rows, at.row)
        films = films_of(self.lights, self.far) if self.reshaped else self.films
        d, _, _ = _direction(rows, at.t, dr.gather(LightFilm, films, rows.light))
        x = transform_point(self.poses.attached_at(rows.light), mi.Point3f(at.scale * d))
        return mi.Vector3f(x - dr.detach(x))

    def ray(self, row: mi.UInt32, t: mi.Float) -> LightRay:
        """The ray at t of `row`."""
        rows = dr.gather(LightStepRows, self.rows, row)
        films = dr.gather(LightFilm, self.films, rows.light)
        local = _direction(rows, t, films)
        columns = self.poses.at(rows.light)
        w, dw, aside = (transform_vector(columns, v) for v in local)
        length = dr.norm(w)
        d = w / length
        side = dr.cross(dw, d)
        across = dr.norm(side)
        n_perp = dr.select(across > 0, side / across, 0)
        n_perp *= dr.select(dr.dot(n_perp, aside) < 0, -1.0, 1.0)
        across = dr.select(_is_lit(rows, t, films), across, 0)
        emitter = dr.gather(mi.EmitterPtr, pointers(mi.EmitterPtr, self.lights), rows.light)
        return LightRay(
            emitter, mi.Point3f(columns[3]), d, n_perp, across / length, aside / length, dr.rcp(length)
        )  # fmt: skip

    def weights(self) -> mi.Float:
        """By row: its length as the light sees it, times the step across it; not 0 where that has only been missed."""
        lane, far = dr.arange(mi.UInt32, PROBES * dr.width(self.rows.light)), varying(mi.Float, self.far)
        wavelengths = dr.zeros(mi.Interaction3f).wavelengths
        if mi.is_spectral:
            wavelengths = type(wavelengths)(WAVELENGTH)
        ray = self.ray(lane // PROBES, (mi.Float(lane % PROBES) + 0.5) / PROBES)
        parted = dr.max(dr.abs(ray.step(far, wavelengths, mi.Bool(True)))) * dr.square(far)
        dr.eval(ray.across, parted)  # else each sum has a kernel that does it all
        length, step = (dr.block_reduce(dr.ReduceOp.Add, x, PROBES) / PROBES for x in (ray.across, parted))
        mean = dr.mean(step)
        dr.make_opaque(mean)
        return length * dr.select(mean > 0, step + UNPROBED * mean, 1)


def films_of(lights: tuple[mi.Emitter, ...], far: float) -> LightFilm:
    """By light; attached to what opens the cones of spots. `far`: see `LightSteps`."""
    found = [_film(light, far) for light in lights]
    return LightFilm(
        mi.Point2f(*(joined([mi.Float(film.centre[axis]) for film in found]) for axis in range(2))),
        mi.Vector2f(*(joined([mi.Float(film.size[axis]) for film in found]) for axis in range(2))),
        joined([film.rim for film in found]),
    )


def _film(light: mi.Emitter, far: float) -> LightFilm:
    params = mi.traverse(light)
    if "cutoff_angle" in params:
        cutoff, beam = (dr.deg2rad(mi.Float(params[name])) for name in ("cutoff_angle", "beam_width"))
        return LightFilm(mi.Point2f(0.5), mi.Vector2f(dr.tan(cutoff) / SPOT_RADIUS), (cutoff + beam) / 2)
    return _film_of_projector(light, far)


def _film_of_projector(light: mi.Emitter, far: float) -> LightFilm:
    """Mitsuba tells neither its field of view nor the sides of its picture: it is asked where two points are seen."""
    with dr.suspend_grad():
        it, z = dr.zeros(mi.Interaction3f), varying(mi.Float, far)
        uv = []
        for x in (0, 1):
            it.p = dr.detach(light.world_transform()) @ mi.Point3f(x * z, x * z, z)
            uv.append(mi.Point2f(light.sample_direction(it, mi.Point2f(0.5), True)[0].uv))
        return LightFilm(uv[0], dr.rcp(mi.Vector2f(uv[1] - uv[0])), mi.Float(0))


def _is_lit(rows: LightStepRows, t: mi.Float, film: LightFilm) -> mi.Bool:
    """Is a point of a line within the cone of a spot, which ends where its picture does? True of all other points.

    The sides of a line that just touches the cone from outside are a little off it, and one of them may be lit.
    """
    q = mi.Vector2f(rows.a + t * (rows.b - rows.a)) - film.centre
    return (rows.arc != 0) | (film.rim == 0) | (dr.squared_norm(q) < SPOT_RADIUS**2)


def _direction(rows: LightStepRows, t: mi.Float, film: LightFilm) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]:
    """`(d, ∂d/∂t, from d to where one of its sides is looked at)`, in the light's space."""
    along = mi.Vector2f(rows.b - rows.a)
    q = (mi.Vector2f(rows.a) + t * along - film.centre) * film.size
    dq = along * film.size
    beside = mi.Vector2f(-along.y, along.x) * dr.rcp(dr.norm(along)) * rows.inset * film.size
    sin_φ, cos_φ = dr.sincos(rows.a.x + t * along.x)
    sin_θ, cos_θ = dr.sincos(film.rim)
    inset = RIM_INSET * film.rim + RIM_ROUNDING / sin_θ
    arc = rows.arc != 0
    return (
        dr.select(arc, mi.Vector3f(sin_θ * cos_φ, sin_θ * sin_φ, cos_θ), mi.Vector3f(q.x, q.y, 1)),
        dr.select(arc, along.x * sin_θ * mi.Vector3f(-sin_φ, cos_φ, 0), mi.Vector3f(dq.x, dq.y, 0)),
        dr.select(arc, inset * mi.Vector3f(cos_θ * cos_φ, cos_θ * sin_φ, -sin_θ), mi.Vector3f(beside.x, beside.y, 0)),
    )
