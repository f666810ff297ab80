"""The plan of a derivative render: which terms run, why, in which form and with how many samples. Pure data.

Which terms run follows from the facts about the scene (`scene.facts`) and from the options alone, before a ray is
traced; form and budgets may take a pilot (`driver.pilot`). The integrator executes exactly the plan. A term is left
out only where it is 0 for a reason that is stated; `plan="full"` leaves nothing out, which changes nothing but noise
and time.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from ..core import markup
from ..core.film_samples import FilmDensity
from ..core.line_guide import LineGuide
from ..errors import OptionError
from ..options import FORMS
from .light_plan import LightPlan

SWITCHED_OFF = "switched off by its budget"
NO_EDGES = "none of its edges can contribute"


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
    film: FilmDensity | None = None  # where on the film its samples are; None: evenly, or they do not begin there
    lines: LineGuide | None = None  # which lines through edges it prefers; None: none, or it has no such lines


@dataclass(frozen=True)
class Plan:
    """What a call of `render_forward` or `render_backward` does."""

    form: str  # one of `options.FORMS`
    form_reason: str
    budget_reason: str
    terms: tuple[TermPlan, ...]
    prunes: bool  # edges and paths without a derivative are left out
    light: LightPlan | None = None  # light subpaths, of an integrator that can trace them

    def term(self, name: str) -> TermPlan:
        """The term called `name`; KeyError if there is none."""
        return {t.name: t for t in self.terms}[name]

    @property
    def running(self) -> tuple[TermPlan, ...]:
        return tuple(t for t in self.terms if t.runs)

    def to_json(self) -> str:
        """The plan as text, for another process: `plan=` of an integrator takes it."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> Plan:
        """The plan that `to_json` wrote. Raises `OptionError` for any other text."""
        try:
            data = json.loads(text)
            terms = tuple(_term_plan(term) for term in data.pop("terms"))
            light = data.pop("light", None)
            plan = Plan(terms=terms, light=None if light is None else LightPlan(**light), **data)
        except (ValueError, zlib.error, TypeError, KeyError, AttributeError) as error:
            why = f"it has no {error}" if isinstance(error, KeyError) else error
            raise OptionError(f"plan = {_shortened(text)}: not a plan ({why}); write one with Plan.to_json") from error
        if plan.form not in FORMS:
            raise OptionError(f"a plan has the form {plan.form!r}: use {' or '.join(FORMS)}")
        return plan

    def _repr_html_(self) -> str:
        rows = []
        for t in self.terms:
            numbers = (str(t.spp), str(t.segments)) if t.runs else ("–", "–")
            why = t.reason if t.edges is None else f"{t.reason}; {t.edges}"
            rows.append((t.name, "runs" if t.runs else "out", *numbers, why))
        about = f"{self.form} form: {self.form_reason} · budgets {self.budget_reason}"
        return markup.card("plan", about if self.light is None else f"{about} · light {self.light}",
                           markup.table(("term", "", "spp", "segments/px", "why"), rows, text=(0, 1, 4)))

    def __str__(self) -> str:
        lines = [f"form     {self.form}: {self.form_reason}", f"budgets  {self.budget_reason}"]
        if self.light is not None:
            lines.append(f"light    {self.light}")
        rows = [("term", "", "spp", "segments/px", "why")]
        for t in self.terms:
            numbers = (str(t.spp), str(t.segments)) if t.runs else ("-", "-")
            rows.append((t.name, "runs" if t.runs else "out", *numbers, t.reason))
            if t.edges is not None:
                rows.append(("", "", "", "", str(t.edges)))
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        lines += ["  ".join([row[k].ljust(widths[k]) for k in range(4)] + [row[4]]).rstrip() for row in rows]
        return "\n".join(lines)


def _term_plan(data: dict) -> TermPlan:
    edges, film, lines = data.pop("edges"), data.pop("film", None), data.pop("lines", None)
    edges = None if edges is None else EdgeCount(**edges)
    film = None if film is None else FilmDensity(tuple(film["shape"]), film["levels"])
    lines = None if lines is None else LineGuide(lines["nodes"])
    if film is not None and not np.isfinite(film.relative).all():
        raise ValueError("its samples have no place")
    if lines is not None:
        lines.require_tree()
    term = TermPlan(**{**data, "streams": tuple(data["streams"])}, edges=edges, film=film, lines=lines)
    if not (isinstance(term.name, str) and isinstance(term.runs, bool) and type(term.spp) is int):
        raise TypeError("a term has a name, runs or not, and has a whole number of paths per pixel")
    if (term.spp > 0) != term.runs:
        raise ValueError(f"'{term.name}' has {term.spp} paths per pixel and {'runs' if term.runs else 'does not run'}")
    return term


def _shortened(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:40] + "...")


@dataclass(frozen=True)
class Geometry:
    """Facts about shapes that need their vertices."""

    lone_convex: str = ""  # name of the only shape, if it is convex, opaque, and seen from outside
    touched_lamp: str = ""  # name of an area light that touches what it shines on


def with_edges(plan: Plan, counts: Mapping[str, EdgeCount]) -> Plan:
    """The plan with the sizes of its edge sets; a term that has none left does not run."""
    terms = [replace(t, edges=counts.get(t.name)) for t in plan.terms]
    return replace(plan, terms=tuple(_out_without_edges(t) for t in terms))


def _out_without_edges(term: TermPlan) -> TermPlan:
    if term.edges is None or term.edges.sampled > 0:
        return term
    return replace(term, runs=False, spp=0, segments=0, streams=(), reason=NO_EDGES)
