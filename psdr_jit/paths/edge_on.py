"""What a sphere or cylinder shows at its outline, where it is met edge-on.

Steps are looked at a little beside an edge. A distance s inside of the outline of a sphere of radius R, its surface is
met at the cosine c = √(2 s/R), which falls much more slowly than s: what is 10⁻⁴ R off the outline is met at .014. Its
normal is turned by as much, which changes what a lamp at 60° to it brings by 2 % (of a lit ball's derivative, moved,
that was a quarter of a percent); and smooth glass with its reflectance 1 − O(c) (Fresnel) has left the limit 1 by 7 %.
The interior term has the whole fall from 1, up to where it ends (`GRAZING`); a step with less than the limit would have
a part of it twice. So walks from beside an edge meet such a surface at that cosine, and in the point of contact: what
is mirrored goes straight on there, which from the point that was met leads through the surface once more.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.sensor_frame import KINDS
from ..core.upload import uploaded
from ..scene.facts import SceneFacts
from ..scene.poses import Poses
from ..scene.registry import registry_values

#: Cosine of arrival below which a vertex has no derivative. A sliding vertex moves by 1/cosθ, and at the outline of a
#: sphere the rounding of float32 makes any cosine below this one. Costs that share of what is smooth near an outline.
GRAZING = 5e-4

#: The same of lights of triangles, whose normals are as exact as directions; what they send goes by the cosine itself.
#: A light had lost a tenth below the other limit of what it sends out of a gap a hundredth as wide as it is long.
GRAZING_FLAT = 2e-6

#: The same of triangles that parallel camera rays meet. All of such a triangle is met at one cosine: what differs
#: between its sides by way of sliding is a step that is missing below the limit (at 4·10⁻⁴, of a torus of 256 triangles
#: that was 4 % of its derivative, smooth-shaded 20 %). Below this one the cosine itself has lost a tenth to rounding.
GRAZING_PARALLEL = 1e-5

#: Shapes without triangles that are met edge-on at their outlines.
ROUND = ("sphere", "cylinder")

#: Cosine up to which a ray from beside an edge is taken to meet an outline: .00125 of the radius.
BESIDE = 0.05


def first_cosine(sensor: mi.Sensor) -> float:
    """Cosine below which camera rays are taken to meet triangles edge-on."""
    return GRAZING_PARALLEL if KINDS.get(sensor.class_name()) == "orthographic" else GRAZING


def least_cosine(shape: mi.ShapePtr, triangles: mi.Float | float = GRAZING) -> mi.Float:
    """Cosine below which `shape` is taken to be met edge-on; `triangles`: the same of meshes."""
    return dr.select(shape.is_mesh(), triangles, GRAZING)


def met_edge_on(si: mi.SurfaceInteraction3f, d: mi.Vector3f, triangles: mi.Float | float = GRAZING) -> mi.Bool:
    """Does a ray along `d` meet the surface so nearly edge-on that single precision cannot tell how it slides?

    `triangles`: see `least_cosine`.
    """
    return dr.abs_dot(si.n, d) < least_cosine(si.shape, triangles)


@dataclass(frozen=True)
class EdgeOn:
    """The shapes of a scene of which this is so. Host object."""

    place: mi.UInt32  # by registry index of a shape: 1 + its place below, 0: it is none of these
    radius: mi.Float  # [m]
    centre: mi.Point3f  # of a cylinder: on its axis
    axis: mi.Vector3f  # of a cylinder, of unit length; 0 of a sphere
    within: mi.Bool | None = None  # by lane, if known: a step inside of a surface, which is seen as it is

    @staticmethod
    def of(scene: mi.Scene, facts: SceneFacts) -> EdgeOn | None:
        """None where there are none."""
        chosen = [s for s in facts.shapes if s.index >= 0 and s.plugin in ROUND and not s.black]
        if not chosen:
            return None
        place = registry_values(scene, {s.index: i + 1 for i, s in enumerate(chosen)})
        shapes = scene.shapes()
        x_axis, _, z_axis, centre = Poses.of([shapes[s.index] for s in chosen]).columns
        long = uploaded(mi.Float, np.array([s.plugin == "cylinder" for s in chosen]))
        found = EdgeOn(place, dr.norm(x_axis), mi.Point3f(centre), long * dr.normalize(z_axis))
        dr.eval(found.place, found.radius, found.centre, found.axis)
        return found

    def at_limit(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """`si`, which a ray along `d` meets, at the point and with the normal of the outline where it lies beside one.
        Detached.

        What is mirrored there then goes straight on, by 2 `GRAZING` radians. The inner wall of a tube is met edge-on as
        well, next to a rim behind which it turns away: it has no outline there, and stays as it is.
        """
        code = dr.reinterpret_array(mi.UInt32, si.shape)
        cos = dr.dot(si.sh_frame.n, -d)
        at_outline = active & si.is_valid() & (dr.abs(cos) < BESIDE)
        if self.within is not None:
            at_outline &= ~self.within
        place = dr.gather(mi.UInt32, self.place, code, at_outline & (code < dr.width(self.place)))
        at_outline &= place != 0
        axis = dr.gather(mi.Vector3f, self.axis, place - 1, at_outline)
        d_across = d - axis * dr.dot(axis, d)
        centre = dr.gather(mi.Point3f, self.centre, place - 1, at_outline)
        at_outline &= dr.dot(si.p - centre, d_across) < 0  # met from outside
        contact = dr.normalize(si.sh_frame.n + d_across * (cos / dr.squared_norm(d_across)))  # at right angles to d
        radius = dr.mulsign(dr.gather(mi.Float, self.radius, place - 1, at_outline), cos)  # normals may be flipped
        n = mi.Normal3f(dr.sqrt(1 - GRAZING**2) * contact - dr.mulsign(GRAZING, cos) * d)
        si.n = dr.select(at_outline, dr.mulsign(mi.Float(1), dr.dot(si.n, n)) * n, si.n)
        si.p = dr.select(at_outline, si.p + radius * (contact - si.sh_frame.n), si.p)
        si.sh_frame = dr.select(at_outline, _turned(si.sh_frame, n), si.sh_frame)
        si.wi = dr.select(at_outline, si.to_local(-d), si.wi)
        return si


def _turned(frame: mi.Frame3f, n: mi.Normal3f) -> mi.Frame3f:
    """`frame` with a normal `n` close to its own: what is brushed, or bent, is turned about it as before."""
    s = dr.normalize(frame.s - n * dr.dot(n, frame.s))
    return mi.Frame3f(s, dr.cross(n, s), n)
