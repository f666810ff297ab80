"""Both sides of a crossed curve are looked at a little off it: where rounding, and the height at which rays start,
no longer decide what they see.

Rays that Mitsuba starts leave their surface at a small height. Beside a line of a pattern and a curve along which
surfaces cut, and inside of an edge sharper than a right angle, that height is more than there is room for.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core.records import Hit
from ..edges.points import LEAST_SLANT, clear_of_lift
from ..paths.rays import ROUNDING
from ..paths.surface_at import surface_of
from .chain_outline import Curve, edge_outline, triangle
from .chain_patterns import INSET
from .chain_trace import Pair
from .chain_world import ChainWorld

#: How far inside of an edge its face is looked at, in units of rounding.
INSIDE = 4.0

#: How far from an edge, as a share of its distance from the face's centroid, the other face is looked for, ...
PROBE = 0.1

#: ... from this height above or below the face, as a share of that.
PROBE_HEIGHT = 0.01

#: Largest sine of the angle to its face at which an edge is thought to belong to it.
SAME_EDGE = 0.02


def beside_curve(world: ChainWorld, pair: Pair, curve: Curve) -> Pair:
    """The last segments clear of a crossed line of a pattern, a cut, an edge or a contour; others as they are."""
    if world.patterns is not None:
        pair = _beside_line(world, pair, curve)
    pair = _beside_sharp_edges(world, _beside_cut(world, _inside_edge(world, pair, curve), curve))
    if world.has_contours:
        pair = _inside_contour(pair, curve)
    dr.eval(pair)  # in one kernel: what follows is asked for one by one
    return pair


def _beside_line(world: ChainWorld, pair: Pair, curve: Curve) -> Pair:
    """Where a line of a pattern has been crossed: both last segments moved off it, in parallel."""
    si = surface_of(world.tables, pair.a, curve.pattern)
    across = curve.g * (INSET / dr.squared_norm(curve.g))
    step = si.dp_du * across.x + si.dp_dv * across.y
    crossed = curve.pattern & dr.all(dr.isfinite(step))
    return _both_moved(world.scene, pair, curve.side * step, crossed)


def _beside_cut(world: ChainWorld, pair: Pair, curve: Curve) -> Pair:
    """Where surfaces cut: both last segments moved off the curve, in parallel, until rounding no longer decides.

    Rays that leave a surface start off it, and a point beside a cut is known to a few units in the last place: closer
    to the curve, what is behind the other surface may be taken for what is in front. A segment whose own surface is the
    one in front on the positive side, the larger n_i·n/(n_i·d), is moved along n = c_1 + c_2.
    """
    n = mi.Vector3f(curve.c1 + curve.c2)
    crossed = curve.cut & ~pair.in_light & dr.isfinite(curve.side)
    n_a, n_b = (surface_of(world.tables, hit).n for hit in (pair.a, pair.b))
    cot = dr.abs(dr.dot(n_a, n_b)) / dr.maximum(dr.norm(dr.cross(n_a, n_b)), LEAST_SLANT)
    x = curve.line.o + curve.t * curve.line.d
    return _both_moved(world.scene, pair, curve.side * n * (clear_of_lift(x) * (1 + cot)), crossed)


def _on_curve(pair: Pair, curve: Curve) -> tuple[mi.Bool, mi.Bool]:
    """Is it the first segment, or the second, that ends on the crossed curve? Of two on one shape it is the nearer."""
    a_on, b_on = pair.a.shape == curve.m1.shape, pair.b.shape == curve.m1.shape
    first = a_on & (~b_on | (pair.a.t <= pair.b.t))
    return first & ~pair.in_light, b_on & ~first & ~pair.in_light


def _inside_edge(world: ChainWorld, pair: Pair, curve: Curve) -> Pair:
    """Of a mesh's edge: the segment that ends at it, moved inside of its face by more than rounding.

    Lines are halved until what they meet is as close to the edge as a hit is known: of an outline it may be the face
    behind, met from its back, and what is seen of it a step of its own that does not count. Faces met from their front
    stay: what lies between the edge and a line of a pattern on it, by rounding, is counted for both.
    """
    edge = curve.valid & ~(curve.cut | curve.pattern | curve.shading | curve.horizon)

    def moved(hit: Hit, active: mi.Bool) -> Hit:
        behind = dr.dot(surface_of(world.tables, hit, active & edge).n, hit.d) > 0
        on_mesh, corners = triangle(world.surfaces.copies, hit, active & edge & behind)
        inward = dr.sign(dr.dot((corners[0] + corners[1] + corners[2]) / 3 - curve.m1.o, curve.c1)) * curve.c1
        step = INSIDE * ROUNDING * (1 + dr.max(dr.abs(curve.m1.o)))
        return _moved(world.scene, hit, step * inward, on_mesh)

    first, second = _on_curve(pair, curve)
    return replace(pair, a=moved(pair.a, first), b=moved(pair.b, second))


def _inside_contour(pair: Pair, curve: Curve) -> Pair:
    """Where rays meet a surface next to its contour with any normal: the segment that ends on it, a little inside of
    it; no ray is traced.
    """
    inside, x = dr.any(curve.inside != 0), curve.m1.o + curve.inside

    def moved(hit: Hit, active: mi.Bool) -> Hit:
        return dr.select(active, replace(curve.m1, o=mi.Point3f(x - hit.t * hit.d), d=hit.d, t=hit.t), hit)

    first, second = _on_curve(pair, curve)
    return replace(pair, a=moved(pair.a, inside & first), b=moved(pair.b, inside & second))


def _beside_sharp_edges(world: ChainWorld, pair: Pair) -> Pair:
    """Of a mesh's edge sharper than a right angle: last segments moved along their faces until rays start inside.

    A ray that starts a height h off a face, at less than h cot φ from an edge where another face meets it at the angle
    φ, starts behind that one (`edges.points.face_inset`).
    """
    active = ~pair.in_light
    return replace(pair, a=_clear_of_edge(world, pair.a, active), b=_clear_of_edge(world, pair.b, active))


def _clear_of_edge(world: ChainWorld, hit: Hit, active: mi.Bool) -> Hit:
    """The segment, moved in parallel into the triangle that it ends on, if it ends too near to a sharp edge of that."""
    line = mi.Ray3f(hit.o, hit.d)
    on_mesh, corners = triangle(world.surfaces.copies, hit, active)
    p = line(dr.select(on_mesh, hit.t, 0))
    edge = edge_outline(world.surfaces.copies, hit, p, line)
    m = edge.m.o
    n_face = dr.normalize(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))
    inward = mi.Vector3f((corners[0] + corners[1] + corners[2]) / 3 - m)
    τ = dr.normalize(dr.cross(n_face, edge.n))
    inward -= τ * dr.dot(τ, inward)
    depth = dr.norm(inward)
    inward /= depth
    cot = dr.maximum(*(_cot_to_other(world.scene, m, (inward, τ, side * n_face), depth, on_mesh) for side in (-1, 1)))
    needed = clear_of_lift(m) * cot
    slant = dr.dot(inward, edge.n)
    near = on_mesh & (dr.abs(edge.gap) < needed * dr.abs(slant)) & (needed < depth)
    return _moved(world.scene, hit, edge.n * (needed * slant), near)


def _cot_to_other(scene: mi.Scene, m: mi.Point3f, frame: tuple, depth: mi.Float, active: mi.Bool) -> mi.Float:
    """cot φ of the face that meets a face's edge at `m`, on the side of its normal; 0: none does in less than 90°.

    `frame`: unit vectors, into the face across the edge, along the edge, and the normal.
    """
    inward, τ, n = frame
    s = PROBE * depth
    ray = mi.Ray3f(m + s * (inward + PROBE_HEIGHT * n), n)
    ray.maxt = s / LEAST_SLANT
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    met = active & pi.is_valid() & pi.shape.is_mesh()
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, met)
    away = dr.normalize(si.p - m)
    met &= (dr.abs(dr.dot(si.n, away)) < SAME_EDGE) & (dr.abs(dr.dot(si.n, τ)) < SAME_EDGE)
    height = PROBE_HEIGHT * s + pi.t
    return dr.select(met, s / height, 0)


def _both_moved(scene: mi.Scene, pair: Pair, step: mi.Vector3f, crossed: mi.Bool) -> Pair:
    """The last segments shifted by ±`step`."""
    return replace(pair, a=_moved(scene, pair.a, step, crossed), b=_moved(scene, pair.b, -step, crossed))


def _moved(scene: mi.Scene, hit: Hit, step: mi.Vector3f, crossed: mi.Bool) -> Hit:
    """A segment shifted by `step`, where it still ends on the same shape."""
    # From half of the way: beside its start there may be the surface that it has left.
    ray = mi.Ray3f(hit.o + 0.5 * hit.t * hit.d + step, hit.d)
    there = Hit.of(ray, scene.ray_intersect_preliminary(ray, coherent=False, active=crossed))
    return dr.select(crossed & (there.shape == hit.shape), there, hit)
