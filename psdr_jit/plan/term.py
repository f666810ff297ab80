"""What a term of the derivative is: one record, over which everything that concerns terms iterates.

Adding a term: a file with its estimator and its `TERM`, an entry in `driver.terms`, a scene and a test. Nothing else
knows terms by their names; a budget that is no field of `options.Options` becomes a property of the integrator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi

from ..core.streams import Stream
from ..options import Options
from ..scene.facts import SceneFacts
from .job import Job
from .plan import Geometry

#: Does a term run, and why (not)?
Verdict = tuple[bool, str]


@dataclass(frozen=True)
class EdgeSampling:
    """Of a boundary term: which edges it samples."""

    weights: Callable[[Job], list[mi.Float]]  # by kind of edge, of its rows: not normalised
    left_out: str  # why the others are not sampled


@dataclass(frozen=True)
class Term:
    """A summand of the derivative image.

    `forward(job)` returns its derivative image along the tangents that are set on the scene's parameters (or along
    `job.motion`), `backward(job, grad_in)` accumulates ⟨grad_in, dI⟩ into them. Both draw the same samples.
    """

    name: str
    budget: str  # the option that holds its samples per pixel
    streams: tuple[Stream, ...]  # of random numbers
    needed: Callable[[SceneFacts, Options, Geometry], Verdict]  # asked only where something can have a derivative
    cost: Callable[[str, bool], float]  # time of a path by (form, sky) relative to one of the interior term
    forward: Callable[[Job], mi.TensorXf]
    backward: Callable[[Job, mi.TensorXf], None]
    edges: EdgeSampling | None = None
    guided: int = 0  # random numbers of a sample that a guide may choose: 3 of a line through an edge, 1 of a point
    with_light: float = 1.0  # factor on the cost where light subpaths run
    over_film: bool = False  # its samples begin at points of the film: there may be more where it is noisy
    covers: bool = False  # it changes the coverage of the film as well, without any light
    cost_of_segment: float | None = None  # as `cost`, if samples tell how much they trace (`Job.effort`)
