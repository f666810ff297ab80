"""What would be computed? The public way to ask for a plan, with the sizes of its edge sets."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.collection import nothing_collected
from ..core.threads import one_at_a_time
from ..driver.prepare import prepare
from ..edges.scene_table import scene_edges
from ..errors import OptionError
from ..plan.job import Job
from ..plan.plan import EdgeCount, Plan, with_edges
from ..plan.term import Term
from ..scene.guard import require_derivatives
from ..scene.io import find_sensor
from ..scene.params import also_enabled
from .integrator_specs import build, integrator_spec


@one_at_a_time
def make_plan(scene: Any, params: Any = None, sensor: Any = 0, integrator: Any = None, spp: int = 0) -> Plan:
    """What differentiating `scene` by the parameters with gradients enabled would do.

    Traces rays only where form or budgets depend on noise, for a pilot of a few samples per pixel. `params`: name or
    names of parameters that count as enabled as well, or the scene's `mi.SceneParameters` (nothing more). `sensor`: its
    index, or the sensor. `integrator`: one of ours, a dict of its properties, or None. `spp`: as in `mi.render`, 0:
    what the integrator and the sampler say. The sizes of the edge sets are counted. Raises what rendering would raise:
    `OptionError`, `SceneError`, `UnsupportedError`.
    """
    require_derivatives()
    view = find_sensor(scene, sensor)
    if not hasattr(integrator, "call"):
        integrator = build(integrator_spec(scene, integrator))
    if not hasattr(integrator, "call"):
        raise OptionError(f"{type(integrator).__name__} has no plan: use psdr_path or psdr_bdpt")
    names = [] if params is None or isinstance(params, mi.SceneParameters) else params
    names = [names] if isinstance(names, str) else list(names)
    with also_enabled(scene, names), nothing_collected():
        prepared = prepare(integrator.call(scene, view, 0, spp))
        counts = {term.name: _count(term, job) for term, job in prepared.jobs if term.edges is not None}
    return with_edges(prepared.plan, counts)


def _count(term: Term, job: Job) -> EdgeCount:
    table = scene_edges(job)
    with dr.suspend_grad():
        weights = term.edges.weights(job)
    sampled = sum(int(np.count_nonzero(np.array(w) > 0)) for w in weights)
    total = sum(dr.width(w) for w in weights)
    return EdgeCount(sampled, total + table.buried, term.edges.left_out, table.buried)
