"""Indirect boundary: an edge x_B seen from a surface point x_D that is itself on the way to the sensor.

Sample x_B on an edge and a direction ω in which the edge can matter; the line through it meets the receiver x_D on one
side and what is seen just past the edge on the other. Measure: edge length × solid angle at x_B.

    (L_− − L_+) · W · |τ×ω| · s·(v_B − u_D) / pdf,        s = τ×ω/|τ×ω|

L_∓ are the radiances that x_D receives from beside the edge on the side −s and +s, traced with common random numbers.
What the first vertex emits does not count (that is the direct term, in material form), but for lights that touch what
they shine on (`edges/followed_lights.py`). In the spatial form this covers silhouettes as well as visible creases,
borders and seams, of moving and of static shapes: a static edge moves in the view of a sliding x_D. It is the boundary
integral of [Zhang et al. 2020, §5], two-sided because directions, not points, are kept.
The planes of coarse smooth-shaded faces take a part of the samples (`horizons.py`).
The sensor subpath of m vertices leaves max_depth − 1 − m segments beyond the first vertex past the edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core import film as films
from ..core.streams import Stream
from ..edges.followed_lights import is_followed
from ..edges.kind import Use
from ..edges.table import EdgeTable, look_beside
from ..options import Options
from ..plan.job import Job
from ..plan.plan import Geometry
from ..plan.reasons import NOTHING_SCATTERS, steps_rest
from ..plan.term import EdgeSampling, Term, Verdict
from ..sampling.horizons import horizon_weights, sampled_horizons
from ..sampling.relevance import SecondaryEdges, line_weights, secondary_edges
from ..scene.facts import SceneFacts
from . import horizons, indirect_material, indirect_orbits, segment_motion
from .close_receivers import at_close_receivers, at_open_receivers
from .edge_lines import EdgeView, longest_path, longest_subpath, radiance_by_depth, sample_lines, slots, trace_receivers
from .segment_motion import BoundarySamples, SecondaryTerm, source_rests
from .sensor_subpath import Receivers, SubpathRecords, subpaths

NAME = "indirect"


def evaluate(job: Job, edges: SecondaryEdges, view: EdgeView) -> BoundarySamples:
    """The step of radiance across every edge, at the sensor."""
    turn = edges.table.turn(view.sight.at, view.sight.ω, view.sight.n_perp) - view.sight.r * view.sight.n_perp
    waits = edges.rests(view.sight.at.row)
    value = view.value / view.pdf
    receivers = Receivers(view.lane, view.receiver, view.wavelengths, value, -view.sight.n_perp, turn, waits)
    records = subpaths(job, Stream.INDIRECT_SUBPATH, receivers, longest_subpath(job))
    value = job.call.counters.rejected.keep_finite(records.data.W * _step(job, edges.table, view, records))
    dr.eval(value)
    return BoundarySamples(
        at=view.sight.at,
        ω=view.sight.ω,
        n_perp=view.sight.n_perp,
        wavelengths=view.wavelengths,
        records=records,
        value=value,
        source_motion=source_rests,
        drawn=view.drawn,
    )


def evaluate_horizons(job: Job, edges: SecondaryEdges, view: EdgeView) -> BoundarySamples:
    """The same of horizons; those that mirrors show are edges (`edges.kind_mirror_horizon`)."""
    found = evaluate(job, edges, view)
    return replace(found, value=found.records.not_mirrored(found.value))


def _step(job: Job, table: EdgeTable, view: EdgeView, records: SubpathRecords) -> mi.Spectrum:
    """L_− − L_+ for every recorded vertex, within the depth that its subpath leaves (flat, see `SubpathRecords`)."""
    lane, left = records.lane_of(), longest_path(job) - records.vertex_of()
    # Whoever is not seen by the sensor need not be known.
    useful = records.connected()
    kept = dr.compress(useful)
    n = dr.width(kept)
    if n == 0:
        return dr.zeros(mi.Spectrum, dr.width(lane))
    slot = slots(records, kept)
    seen = dr.gather(EdgeView, view, kept)
    dr.eval(seen)  # in one kernel, see `compact`
    by_depth, final, followed = _both_sides(job, table, seen, longest_path(job) + 1)
    needed = dr.gather(mi.Bool, useful, lane)
    slot = 2 * dr.gather(mi.UInt32, slot, lane)

    def arrives(side: int, k: mi.UInt32) -> mi.Spectrum:
        return by_depth.up_to(k, slot + side, dr.gather(mi.Spectrum, final, slot + side, needed))

    def emitted(side: int) -> mi.Spectrum:
        return dr.select(dr.gather(mi.Bool, followed, slot + side, needed), 0, arrives(side, 0 * left))

    found = arrives(0, left) - arrives(1, left)
    if records.delta is not None:  # what else the first vertex emits is seen by delta lobes alone
        found -= records.left_by_smooth_lobes(emitted(0) - emitted(1))
    return dr.select(needed, found, 0)


def _both_sides(job: Job, table: EdgeTable, view: EdgeView, vertices: int):
    """Radiance from both sides of every edge point, by depth: `(by_depth, final, followed)`, 2 lanes each (−, +).

    `followed`: lanes that count what they meet first emits, whatever lobe of the receiver sees it.
    """
    index = dr.arange(mi.UInt32, 2 * dr.width(view.lane))
    which, v = index & 1, dr.gather(EdgeView, view, index >> 1)
    ray, pi, differs = look_beside(job.scene, table, v.sight, which, v.wavelengths)
    followed = is_followed(job, pi.shape.emitter(), differs & pi.is_valid())
    # the emission of others is seen by delta lobes, and taken off again for smooth ones
    emission = mi.Bool(True) if job.facts.has_delta_lobes else followed
    limits = replace(job.limits_beside, max_depth=vertices).looking_within(table.within_surfaces(v.sight.at.row))
    return *radiance_by_depth(job, ray, pi, v.lane, limits, differs, emission), followed


#: What its lines are drawn for, by form; in the mixed one, those of most receivers.
USES = {"spatial": Use.STEP, "material": Use.BACKGROUND, "mixed": Use.BACKGROUND}

#: Share of the samples, in the mixed form, for receivers with another surface close by. They are few, and what lines
#: bring to all others is left out.
CLOSE_SHARE = 0.125

#: How the term is estimated, by form.
ESTIMATORS = {
    "spatial": SecondaryTerm(
        edges=lambda job: secondary_edges(job, NAME, USES["spatial"]),
        longest=longest_subpath,
        sample=sample_lines,
        trace=lambda job, edges, line: trace_receivers(job, line),
        evaluate=evaluate,
    ),
    "material": SecondaryTerm(
        edges=lambda job: secondary_edges(job, NAME, USES["material"]),
        longest=longest_subpath,
        sample=sample_lines,
        trace=indirect_material.trace,
        evaluate=indirect_material.evaluate,
    ),
}

#: The same for the horizons of coarse smooth-shaded faces.
HORIZONS = {
    form: SecondaryTerm(
        edges=lambda job: sampled_horizons(job, NAME, direct=False),
        longest=longest_subpath,
        sample=horizons.sample_views,
        trace=trace,
        evaluate=worth,
    )
    for form, trace, worth in (
        ("spatial", horizons.trace_views, evaluate_horizons),
        ("material", horizons.trace_backgrounds, indirect_material.evaluate),
    )
}


def _turning(part: SecondaryTerm) -> SecondaryTerm:
    """What turns together with spheres, on the lines of a part in spatial form."""
    return replace(
        part,
        trace=lambda job, edges, line: indirect_orbits.trace(job, edges, part.trace(job, edges, line)),
        evaluate=indirect_orbits.evaluate,
    )


def parts(job: Job) -> list[tuple[SecondaryTerm, Job]]:
    """What the term consists of, each with its share of the samples: edges, and horizons if faces are coarse."""
    if job.form == "mixed":
        close = max(1, round(CLOSE_SHARE * job.spp))
        at_close = _parts(replace(job, spp=close, guide=None, tally=None), "spatial", at_close_receivers)
        return at_close + _parts(replace(job, spp=max(1, job.spp - close)), "material", at_open_receivers)
    found = _parts(job, job.form, lambda part: part)
    if job.orbits is not None:
        found += [(_turning(part), share) for part, share in found]
    return found


def _parts(job: Job, form: str, at: Callable[[SecondaryTerm], SecondaryTerm]) -> list[tuple[SecondaryTerm, Job]]:
    """Those of a form, `at` some of the receivers."""
    edges = at(ESTIMATORS[form])
    if any(shape.smooth for shape in job.facts.shapes):
        return horizons.shared_out(job, at(HORIZONS[form]), [edges])
    return [(edges, job)]


def forward(job: Job) -> mi.TensorXf:
    """Derivative image of the term along the tangents set on the scene's parameters. Detached."""
    return sum((segment_motion.forward(share, part) for part, share in parts(job)), films.black(job.film))


def backward(job: Job, grad_in: mi.TensorXf) -> None:
    """Accumulate ⟨grad_in, dI⟩ into the attached parameters; the transpose of `forward`, same samples."""
    for part, share in parts(job):
        segment_motion.backward(share, part, grad_in)


def needed(facts: SceneFacts, options: Options, geometry: Geometry) -> Verdict:
    """Surfaces see each other, and something moves in their view."""
    if steps_rest(facts):
        return False, steps_rest(facts)
    if geometry.touched_lamp:
        return True, f"what surfaces see of each other moves, and of '{geometry.touched_lamp}', which touches some"
    if options.depth_limit < 3:
        return False, f"max_depth = {options.depth_limit}: light is scattered once at most"
    if not facts.scatters:
        return False, NOTHING_SCATTERS
    if geometry.lone_convex:
        return False, f"'{geometry.lone_convex}' is alone and convex: it sees nothing but the sky"
    if not (facts.shapes_move or facts.camera_moves or facts.paths_bend):
        return False, "only lights without a shape move: what surfaces see of each other stays the same"
    return True, "what surfaces see of each other moves"


def cost(form: str, sky: bool) -> float:
    """Time of a path relative to one of the interior term (medians over the shipped scenes, two cores)."""
    # in material form one side of an edge is traced, in the mixed one lines of both kinds are drawn
    return {"material": 0.6, "mixed": 1.1}.get(form, 0.9)


TERM = Term(
    name=NAME,
    budget="sppi",
    streams=(Stream.INDIRECT_EDGE, Stream.INDIRECT_SUBPATH, Stream.INDIRECT_RADIANCE, Stream.HORIZON_VIEW),
    needed=needed,
    cost=cost,
    forward=forward,
    backward=backward,
    edges=EdgeSampling(
        lambda job: line_weights(job, USES[job.form]) + horizon_weights(job, NAME, direct=False),
        "the others are coplanar, or lie inside of closed surfaces",
    ),
    guided=3,
)
