"""The plan of a derivative render: which terms run, why, in which form and with how many samples. Pure data.

Which terms run follows from the facts about the scene (`scene.facts`) and from the options alone, before a ray is
traced; form and budgets may take a pilot (`driver.pilot`). The integrator executes exactly the plan. A term is left
out only where it is 0 for a reason that is stated; `plan="full"` leaves nothing out, which changes nothing but noise
and time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from ..core.streams import Stream
from ..options import Options
from ..scene.facts import SceneFacts

SWITCHED_OFF = "switched off by its budget"

#: Segments of a path that count when its cost is estimated: deeper ones are rare or dim.
TYPICAL_DEPTH = 5


@dataclass(frozen=True)
class EdgeCount:
    """How many rows of the edge table a term samples, of how many, and why the others are left out."""

    sampled: int
    total: int
    left_out: str
    buried: int = 0  # of those left out: inside of other bodies

    def __str__(self) -> str:
        rest = f", {self.left_out}" if self.sampled < self.total else ""
        inside = f"; {self.buried} lie inside of other bodies" if self.buried else ""
        return f"{self.sampled} of {self.total} edges{rest}{inside}"


@dataclass(frozen=True)
class TermPlan:
    """One term. `spp` counts paths per pixel and is 0 unless it runs."""

    name: str
    runs: bool
    reason: str
    spp: int
    streams: tuple[str, ...]  # of random numbers, see `streams`
    segments: int  # expected path segments per pixel, 0 unless it runs
    edges: EdgeCount | None = None  # None: not a boundary term, or not counted


@dataclass(frozen=True)
class Plan:
    """What a call of `render_forward` or `render_backward` does."""

    form: str  # one of `options.FORMS`
    form_reason: str
    budget_reason: str
    terms: tuple[TermPlan, ...]
    prunes: bool  # edges and paths without a derivative are left out

    def term(self, name: str) -> TermPlan:
        """The term called `name`; KeyError if there is none."""
        return {t.name: t for t in self.terms}[name]

    @property
    def running(self) -> tuple[TermPlan, ...]:
        return tuple(t for t in self.terms if t.runs)

    def __str__(self) -> str:
        lines = [f"form     {self.form}: {self.form_reason}", f"budgets  {self.budget_reason}"]
        rows = [("term", "", "spp", "segments/px", "why")]
        for t in self.terms:
            numbers = (str(t.spp), str(t.segments)) if t.runs else ("-", "-")
            rows.append((t.name, "runs" if t.runs else "out", *numbers, t.reason))
            if t.edges is not None:
                rows.append(("", "", "", "", str(t.edges)))
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        lines += ["  ".join([row[k].ljust(widths[k]) for k in range(4)] + [row[4]]).rstrip() for row in rows]
        return "\n".join(lines)


@dataclass(frozen=True)
class Geometry:
    """Facts about shapes that need their vertices."""

    lone_convex: str = ""  # name of the only shape, if it is convex, opaque, and seen from outside


STREAMS = {
    "interior": (Stream.CAMERA, Stream.INTERIOR),
    "primary": (Stream.PRIMARY_EDGE, Stream.PRIMARY_RADIANCE),
    "direct": (Stream.DIRECT_EDGE, Stream.DIRECT_SUBPATH),
    "indirect": (Stream.INDIRECT_EDGE, Stream.INDIRECT_SUBPATH, Stream.INDIRECT_RADIANCE),
}


def make(
    facts: SceneFacts, options: Options, geometry: Geometry, spp: Mapping[str, int], form: tuple[str, str], budgets: str
) -> Plan:
    """The plan for `spp` paths per pixel and term (0: switched off). `form`: `(form, reason)`; `budgets`: a reason."""
    needed = _needed(facts, options, geometry) if options.plan == "lean" else _everything(facts)
    terms = []
    for name, (runs, reason) in needed.items():
        if spp[name] == 0 and runs:
            runs, reason = False, SWITCHED_OFF
        depth = min(options.depth_limit, TYPICAL_DEPTH)
        count = spp[name] if runs else 0
        streams = tuple(stream.name for stream in STREAMS[name]) if runs else ()
        terms.append(TermPlan(name, runs, reason, count, streams, count * depth))
    return Plan(*form, budgets, tuple(terms), options.plan == "lean")


def with_edges(plan: Plan, counts: Mapping[str, EdgeCount]) -> Plan:
    """The plan with the sizes of its edge sets; a term that has none left does not run."""
    terms = [replace(t, edges=counts.get(t.name)) for t in plan.terms]
    return replace(plan, terms=tuple(_out_without_edges(t) for t in terms))


def _out_without_edges(term: TermPlan) -> TermPlan:
    if term.edges is None or term.edges.sampled > 0:
        return term
    return replace(term, runs=False, spp=0, segments=0, streams=(), reason="none of its edges can contribute")


def _everything(facts: SceneFacts) -> dict[str, tuple[bool, str]]:
    return {name: (True, "the planner is off") for name in STREAMS}


def _needed(facts: SceneFacts, options: Options, geometry: Geometry) -> dict[str, tuple[bool, str]]:
    """In or out, and why, by term."""
    nothing = next(_nothing(facts, options), None)
    if nothing is not None:
        return {name: (False, nothing) for name in STREAMS}
    return {
        "interior": _interior(facts, options),
        "primary": _primary(facts),
        "direct": _direct(facts, options, geometry),
        "indirect": _indirect(facts, options, geometry),
    }


def _nothing(facts: SceneFacts, options: Options) -> Iterator[str]:
    """Reasons why the whole derivative is 0."""
    if not facts.anything_enabled:
        yield facts.still or "no parameter of the scene has gradients enabled"
    elif options.depth_limit == 0:
        yield "max_depth = 0: paths without a segment carry no light"
    elif not facts.emitters:
        yield "the scene has no light source"
    elif not _relevant(facts):
        yield "what has gradients enabled does not enter the image of this sensor"


def _relevant(facts: SceneFacts) -> tuple[str, ...]:
    """The enabled parameters that the image can depend on."""
    names = tuple(n for s in facts.shapes for n in (*s.geometry, *s.shading, *s.material))
    return names + tuple(n for e in facts.emitters for n in (*e.pose, *e.radiance)) + facts.sensor.pose


def _interior(facts: SceneFacts, options: Options) -> tuple[bool, str]:
    changes = _changes(facts)
    if options.depth_limit == 1:
        radiance = any(e.radiance or e.pose for e in facts.emitters)
        emitting = any(s.is_emitter and s.shading for s in facts.shapes)
        slides = facts.geometry_moves and any(e.varies for e in facts.emitters)
        if not (radiance or emitting or slides):
            return False, "max_depth = 1: only emission is seen, and it is the same at every point"
    return True, f"{changes} change along every path"


def _changes(facts: SceneFacts) -> str:
    kinds = [
        (facts.shapes_move, "shapes"),
        (any(s.shading for s in facts.shapes), "shading normals or texture coordinates"),
        (any(s.material for s in facts.shapes), "materials"),
        (facts.emitters_move, "poses of lights"),
        (any(e.radiance for e in facts.emitters), "emission"),
        (facts.camera_moves, "the camera"),
    ]
    return ", ".join(text for there, text in kinds if there)


def _still(facts: SceneFacts) -> str | None:
    """Why no discontinuity moves, if none does."""
    return None if facts.geometry_moves else "no shape, light or camera moves: discontinuities stay where they are"


def _primary(facts: SceneFacts) -> tuple[bool, str]:
    if _still(facts):
        return False, _still(facts)
    if not (facts.shapes_move or facts.camera_moves):
        return False, "only lights without a shape move: every outline stays where it is on the film"
    return True, "outlines move over the film"


def _direct(facts: SceneFacts, options: Options, geometry: Geometry) -> tuple[bool, str]:
    if _still(facts):
        return False, _still(facts)
    if options.depth_limit < 2:
        return False, "max_depth = 1: nothing is lit, so nothing is in shadow"
    if geometry.lone_convex:
        return False, f"'{geometry.lone_convex}' is alone and convex: it casts no shadow on anything"
    if all(e.delta for e in facts.emitters):
        return True, "shadows move; every light is a point or a direction, so they are curves: one dimension less"
    return True, "shadows move"


def _indirect(facts: SceneFacts, options: Options, geometry: Geometry) -> tuple[bool, str]:
    if _still(facts):
        return False, _still(facts)
    if options.depth_limit < 3:
        return False, f"max_depth = {options.depth_limit}: light is scattered once at most"
    if geometry.lone_convex:
        return False, f"'{geometry.lone_convex}' is alone and convex: it sees nothing but the sky"
    if not (facts.shapes_move or facts.camera_moves):
        return False, "only lights without a shape move: what surfaces see of each other stays the same"
    return True, "what surfaces see of each other moves"
