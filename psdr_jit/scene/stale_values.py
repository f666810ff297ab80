"""What Mitsuba has computed from parameters and does not (or no longer) depend on them.

A plugin computes from some of its parameters what it renders with: normals from vertices, a frame from a pose, the
projection from the field of view. It does so in `params.update()`, and where the parameter has changed. Enabling
gradients of a parameter that is in place changes nothing, and a backward pass uses up the edges between a parameter
and what was computed from it: without an update, and from the second pass on, the derivative by way of the computed
values is missing, in Mitsuba's integrators as well, without a word.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from ..core.ad import array_of
from ..core.compat import VERTEX_POSITIONS, mesh_buffers
from ..core.memory import Memory
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .facts import SceneFacts

#: Last parts of the names of parameters that are rendered by way of what is computed from them.
_COMPUTED_FROM = ("to_world", "x_fov", "cutoff_angle", "beam_width")


def warn_about_stale_values(scene: mi.Scene, facts: SceneFacts, memory: Memory) -> None:
    """Warn of parameters with gradients enabled that what Mitsuba renders with does not depend on. Each is named once.

    For backward mode: in forward mode the tangents reach the computed values before rendering (`late_tangents`).
    """
    smooth = [s for s in facts.shapes if s.smooth and s.index >= 0 and VERTEX_POSITIONS in s.geometry]
    rendered_by_way = [name for name in facts.enabled if name.rpartition(".")[2] in _COMPUTED_FROM]
    # The camera's pose is read as it is.
    rendered_by_way = [name for name in rendered_by_way if name != f"{facts.sensor.name}.to_world"]
    if not smooth and not rendered_by_way:
        return
    with dr.resume_grad():
        edges = _Edges(dr.graphviz_ad(as_string=True))
        shapes, params = scene.shapes(), mi.traverse(scene) if rendered_by_way else None
        lost = [s.name for s in smooth if not edges.arrive_at(mesh_buffers(shapes[s.index])[1])]
        unused = [name for name in rendered_by_way if name in params and edges.end_at(params[name])]
    for name in lost:
        _warn(f"the vertex normals of shape '{name}' do", f"{name}.{VERTEX_POSITIONS}", memory)
    for name in unused:
        _warn("what Mitsuba has computed does", name, memory)


def _warn(what_does: str, key: str, memory: Memory) -> None:
    warn_once(
        f"{what_does} not depend on '{key}', which has gradients enabled: that part of the derivative is missing; "
        f"before every backward pass, assign params['{key}'] or call params.set_dirty('{key}'), then params.update()",
        UnsupportedWarning, memory,
    )  # fmt: skip


class _Edges:
    """Dr.Jit's AD graph, given as GraphViz text: each line `b -> a` says that b was computed from a."""

    def __init__(self, graph: str):
        edges = re.findall(r"^\s*(\d+) -> (\d+)(.*color=red)?", graph, re.MULTILINE)
        self._computed = {int(b) for b, _, _ in edges}
        # Red: by a custom operation. Rendering itself is one, of all parameters it was given.
        self._used = {int(a) for _, a, custom in edges if not custom}

    def arrive_at(self, value) -> bool:
        """Whether anything of `value` was computed from another variable of the graph."""
        return any(i in self._computed for i in _variables(value))

    def end_at(self, value) -> bool:
        """Whether `value` is attached and no variable of the graph was computed from it.

        It is not attached where another object has the name: a sensor that was loaded by itself is not in the scene.
        """
        found = list(_variables(value))
        return bool(found) and not any(i in self._used for i in found)


def _variables(value) -> Iterator[int]:
    """Places in the AD graph of all arrays in a parameter's value."""
    value = array_of(value)
    if dr.is_tensor_v(value):
        value = value.array
    if dr.depth_v(value) > 1:
        for entry in value:
            yield from _variables(entry)
    elif value.index_ad:
        yield value.index_ad
