"""Which curve has been crossed where two neighbouring chains part, and how the line of sight meets it.

Along the crossed curve the line of sight x(s) = o + s d satisfies F = 0, to first order in everything that can move

    F = Σ_i c_i · (o + t d − m_i),        (Σ_i c_i) · d = 0,

with m_i one or two material points and t the distance. On an edge, m is a point of it and c ∝ τ × d. On the outline of
a sphere or cylinder, m is the point of contact and c the normal there: an outline moves with the normal velocity of the
surface, and a turn of the line of sight about m moves it along the tangent plane. Where two surfaces cut, with normals
n_i, the curve moves by both: c_1 = (n_2·d) n_1, c_2 = −(n_1·d) n_2. And where an interpolated normal n turns away from
the line of sight, F = n·d itself, at the point that the line meets. With the direction ω in which a delta lobe there is
left, and the face's own normal n, F = n·ω where paths begin to go on under the face (`chain_surface`).

The nearer surface is the one that ends. If both are equally near, they touch along an edge of the one or of the other
(a crease), or cut into each other: the curve that the line of sight passes closest by is taken. A shape that goes on,
seen from the other side of its shading normal, has a shading outline there.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..edges.copy_table import CopyTable, code_of, number_of, values_of_shapes
from ..edges.curves import CURVES_OF, local_viewpoint, transform_point, transform_vector
from ..edges.edge_shapes import edge_shapes
from ..paths.delta_step import delta_step
from ..paths.rays import ROUNDING
from ..paths.surface_at import surface_of
from ..plan.job import Job
from ..plan.motion import Displacements
from ..scene.facts import SceneFacts
from ..scene.poses import Poses
from .chain_contour import Outline, contour, resting
from .chain_patterns import NO_FAMILY
from .chain_surface import ONE_SHADING
from .chain_trace import Pair
from .chain_world import ChainWorld

#: Difference of distances, relative to them, up to which two surfaces may touch there.
TOUCHING = 1e-3

#: How much closer the edge of the farther surface, and a cut, must be passed by to be preferred.
FARTHER, CUT = 2.0, 4.0

#: How much closer, in units of rounding, a cut must be passed by at the least.
SURE = 4.0

#: Corners of a triangle in barycentric coordinates of its hits.
CORNERS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))

#: Its sides, by their ends.
SIDES = ((0, 1), (1, 2), (2, 0))


@dataclass
class Curve:
    """What has been crossed: the c_i and m_i of F. Detached."""

    line: Hit  # the line of sight, and what it meets
    shading: mi.Bool  # F = n·d
    horizon: mi.Bool  # F = n·ω
    onward: mi.Vector3f  # the direction ω
    pattern: mi.Bool  # F = g·(u, v), up to a constant
    g: mi.Vector2f
    cut: mi.Bool  # it is the curve along which two surfaces cut
    side: mi.Float  # sign of F on the first chain's side of a pattern's line, or of a cut
    m1: Hit
    m2: Hit
    c1: mi.Vector3f
    c2: mi.Vector3f
    inside: mi.Vector3f  # from m_1 to where the surface that ends there is looked at; 0: where it has been met
    t: mi.Float
    F: mi.Float  # where the chain was traced [m]
    valid: mi.Bool

    def attached_F(self, o: mi.Point3f, d: mi.Vector3f, moving: Displacements, facts: SceneFacts) -> mi.Float:
        """F of the attached line of sight (o, d) and of what moves."""
        F = dr.dot(self.c1 + self.c2, o + self.t * d)
        F -= dr.dot(self.c1, moving.of_surface(self.m1)) + dr.dot(self.c2, moving.of_surface(self.m2))
        smooth = any(s.smooth for s in facts.shapes)
        if not (smooth or any(s.patterns for s in facts.shapes)):
            return F
        si = moving.surface(self.line, mi.Ray3f(o, d), mi.RayFlags.All)
        n = dr.select(self.shading, mi.Vector3f(si.sh_frame.n), 0)
        F = dr.select(self.shading, dr.dot(n, d), F)
        if smooth:
            ω = delta_step(mi.BSDFContext(), si, si.bsdf(), self.onward, self.horizon).d
            F = dr.select(self.horizon, dr.dot(si.n, ω), F)
        return dr.select(self.pattern, dr.dot(self.g, si.uv), F)


@dataclass
class AnalyticShape:
    """What a hit is on, if that is a sphere, a disk or a cylinder. Detached."""

    there: mi.Bool  # is it?
    columns: tuple[mi.Vector3f, ...]  # of its object-to-world map
    sphere: mi.Bool
    disk: mi.Bool

    @property
    def across(self) -> mi.Vector3f:
        """Which local coordinates tell how far a point is from its middle: a tube's contour is that of a circle."""
        return dr.select(self.sphere, mi.Vector3f(1), mi.Vector3f(1, 1, 0))

    def local(self, v, w: float) -> mi.Vector3f:
        """A point (w = 1) or a vector (w = 0) in local space."""
        q = local_viewpoint(self.columns, mi.Vector4f(v.x, v.y, v.z, w))
        return mi.Vector3f(q.x, q.y, q.z)

    def closest(self, o: mi.Vector3f, d: mi.Vector3f) -> mi.Vector3f:
        """Where a line passes closest by the middle; local, as the line is."""
        return o - d * (dr.dot(o * self.across, d * self.across) / dr.squared_norm(d * self.across))


@dataclass(frozen=True)
class AnalyticShapes:
    """Spheres, disks and cylinders of a scene. Host object."""

    copies: CopyTable | None
    number: mi.UInt32  # by registry index of a shape or a copy: 1 + its place below, 0: it is none of these
    columns: tuple[mi.Vector3f, ...]  # of their object-to-world maps
    kind: mi.UInt32

    @staticmethod
    def of(job: Job) -> AnalyticShapes | None:
        chosen = [s for s in edge_shapes(job).facts if s.plugin in CURVES_OF]
        if not chosen:
            return None
        shapes = tuple(edge_shapes(job).shapes[s.index] for s in chosen)
        number = values_of_shapes(job, {s.index: i + 1 for i, s in enumerate(chosen)})
        columns = Poses.of(shapes).columns
        kind = mi.UInt32([list(CURVES_OF).index(s.plugin) for s in chosen])
        dr.eval(number, columns, kind)
        return AnalyticShapes(CopyTable.of(job), number, columns, kind)

    def met_by(self, hit: Hit, active: mi.Bool) -> AnalyticShape:
        """The shape at the end of `hit`."""
        number = dr.gather(mi.UInt32, self.number, code_of(self.copies, hit.shape), active & (hit.shape != 0))
        i = dr.maximum(number, 1) - 1
        columns = tuple(dr.gather(mi.Vector3f, c, i) for c in self.columns)
        kind = dr.gather(mi.UInt32, self.kind, i)
        return AnalyticShape(number != 0, columns, *(kind == list(CURVES_OF).index(s) for s in ("sphere", "disk")))


def triangle(copies: CopyTable | None, hit: Hit, active: mi.Bool) -> tuple[mi.Bool, list[mi.Point3f]]:
    """`(is there one, its corners)`: the triangle at the end of `hit`. Detached."""
    shape = code_of(copies, dr.select(active, hit.shape, 0))
    on_mesh = active & (shape != 0)
    on_mesh &= dr.reinterpret_array(mi.ShapePtr, dr.select(on_mesh, shape, 0)).is_mesh()
    mesh = dr.reinterpret_array(mi.MeshPtr, dr.select(on_mesh, shape, 0))
    corners = mesh.face_indices(hit.prim_index, on_mesh)
    return on_mesh, [dr.detach(mesh.vertex_position(corners[i], on_mesh)) for i in range(3)]


def edge_outline(copies: CopyTable | None, hit: Hit, p: mi.Point3f, line: mi.Ray3f) -> Outline:
    """The side of the triangle at the end of `hit`, which it meets at `p`, that `line` passes closest by."""
    on_mesh, x = triangle(copies, hit, mi.Bool(True))
    none = dr.full(mi.Float, dr.inf, dr.width(hit.t))
    best = Outline(resting(hit, p, hit.prim_uv), mi.Vector3f(0), none, mi.Vector3f(0))
    for i, j in SIDES:
        along = x[j] - x[i]
        n = dr.cross(along, line.d)
        length = dr.norm(n)
        n = n / length
        s = dr.clip(dr.dot(p - x[i], along) / dr.squared_norm(along), 0, 1)
        uv = dr.lerp(mi.Point2f(CORNERS[i]), mi.Point2f(CORNERS[j]), s)
        gap = dr.select(on_mesh & (length > 0), dr.dot(n, line.o - x[i]), dr.inf)
        best = best.or_closer(Outline(resting(hit, x[i] + s * along, uv), n, gap, mi.Vector3f(0)))
    return best


def _analytic_outline(shapes: AnalyticShapes, hit: Hit, p: mi.Point3f, line: mi.Ray3f) -> Outline:
    """The same of shapes without triangles: the contours of spheres and tubes, the rims of disks and tubes."""
    shape = shapes.met_by(hit, mi.Bool(True))
    columns, q = shape.columns, shape.local(p, 1)
    closest = shape.closest(shape.local(line.o, 1), shape.local(line.d, 0))
    radial = dr.normalize(closest * shape.across)
    contact = mi.Point3f(radial.x, radial.y, dr.select(shape.sphere, radial.z, closest.z))
    m = transform_point(columns, contact)
    n = dr.normalize(transform_vector(columns, radial))
    gap = dr.select(shape.there & ~shape.disk, dr.dot(n, line.o - m), dr.inf)
    outline = Outline(resting(hit, m, mi.Point2f(0)), n, gap, mi.Vector3f(0))

    rim = dr.normalize(mi.Vector3f(q.x, q.y, 0))
    height = dr.select(shape.disk | (q.z < 0.5), mi.Float(0), 1)
    m = transform_point(columns, mi.Point3f(rim.x, rim.y, height))
    n = dr.normalize(dr.cross(transform_vector(columns, mi.Vector3f(-rim.y, rim.x, 0)), line.d))
    gap = dr.select(shape.there & ~shape.sphere, dr.dot(n, line.o - m), dr.inf)
    return outline.or_closer(Outline(resting(hit, m, mi.Point2f(rim.x, rim.y)), n, gap, mi.Vector3f(0)))


def _outline(world: ChainWorld, shapes: AnalyticShapes | None, at: tuple, line: mi.Ray3f, bends: mi.Bool) -> Outline:
    """`at`: hit and surface interaction; `bends`: the surface goes on, and bends there."""
    hit, si = at
    best = edge_outline(world.surfaces.copies, hit, si.p, line)
    if world.has_contours:
        best = best.or_closer(contour(world, hit, si, line, bends))
    return best if shapes is None else best.or_closer(_analytic_outline(shapes, hit, si.p, line))


def crossed_curve(world: ChainWorld, shapes: AnalyticShapes | None, pair: Pair, sight: Hit) -> Curve:
    """The curve between the two chains, for the line of sight of the first: its segment `sight`."""
    line = mi.Ray3f(sight.o, sight.d)
    first = pair.a.intersection().t <= pair.b.intersection().t
    near, far = dr.select(first, pair.a, pair.b), dr.select(first, pair.b, pair.a)
    near, far = (dr.select(pair.horizon, sight, hit) for hit in (near, far))
    si_near, si_far = surface_of(world.tables, near), surface_of(world.tables, far)
    touching = (far.shape != 0) & (far.t - near.t < TOUCHING * far.t)
    folded = (near.shape == far.shape) & (dr.norm(si_near.sh_frame.n - si_far.sh_frame.n) < ONE_SHADING)
    if world.surfaces.grids is not None:
        folded &= ~world.surfaces.grids.bends(number_of(world.surfaces.copies, si_near), si_near.n, si_far.n)
    bends = touching & (near.shape == far.shape) & ~folded
    best = _outline(world, shapes, (near, si_near), line, bends)
    other = _outline(world, shapes, (far, si_far), line, bends)
    closer = touching & (FARTHER * dr.abs(other.gap) < dr.abs(best.gap))
    best = dr.select(closer, other, best)

    c1, c2 = dr.dot(si_far.n, line.d) * si_near.n, -dr.dot(si_near.n, line.d) * si_far.n
    scale = dr.rcp(dr.norm(c1 + c2))
    t = dr.dot(si_near.p - line.o, line.d)
    x = line.o + t * line.d
    F_cut = (dr.dot(c1, x - si_near.p) + dr.dot(c2, x - si_far.p)) * scale
    known = SURE * ROUNDING * (1 + dr.max(dr.abs(x)))  # where two faces share an edge, that is the curve
    cut = touching & ~folded & dr.isfinite(scale) & (CUT * dr.abs(F_cut) + known < dr.abs(best.gap))

    h_near, h_far = dr.dot(si_near.sh_frame.n, line.d), dr.dot(si_far.sh_frame.n, line.d)
    shading = touching & (near.shape == far.shape) & (h_near * h_far <= 0)
    F = dr.select(shading, dr.select(first, h_near, h_far), dr.select(cut, F_cut, best.gap))
    n = mi.Vector3f(c1 + c2) * scale
    in_front = dr.dot(si_near.n, n) / dr.dot(si_near.n, line.d) > dr.dot(si_far.n, n) / dr.dot(si_far.n, line.d)
    pattern, g, side = mi.Bool(False), mi.Vector2f(0), dr.select(first ^ in_front, mi.Float(-1), 1)
    if world.patterns is not None:
        pattern = pair.family != NO_FAMILY
        ends = surface_of(world.tables, pair.a), surface_of(world.tables, pair.b)
        g, F_line, side_line = world.patterns.line(pair.family, *ends)
        F, shading, side = dr.select(pattern, F_line, F), shading & ~pattern, dr.select(pattern, side_line, side)
    if world.surfaces.grids is not None:
        si_a, si_b = (dr.select(first, one, other) for one, other in ((si_near, si_far), (si_far, si_near)))
        bent = world.surfaces.grids.side(number_of(world.surfaces.copies, si_a), si_a, si_b, line.d, n)
        side = dr.select(bends & (bent != 0), bent, side)
    horizon = pair.horizon & pair.one_face
    F = dr.select(horizon, dr.dot(si_near.n, pair.a.d), F)
    return Curve(
        line=sight,
        shading=shading,
        horizon=horizon,
        onward=pair.a.d,
        pattern=pattern,
        g=g,
        cut=cut & ~pattern & ~shading,
        side=side,
        m1=dr.select(cut, resting(near, si_near.p, near.prim_uv), best.m),
        m2=dr.select(cut, resting(far, si_far.p, far.prim_uv), best.m),
        c1=dr.select(cut, mi.Vector3f(c1 * scale), best.n),
        c2=dr.select(cut, mi.Vector3f(c2 * scale), 0),
        inside=dr.select(cut | shading | pattern | horizon, 0, best.inside),
        t=dr.select(cut, t, dr.dot(best.m.o - line.o, line.d)),
        F=F,
        valid=dr.isfinite(F),
    )
