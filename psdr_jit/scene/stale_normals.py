"""Vertex normals that have lost their way to the vertex positions they were computed from.

`params.update()` recomputes normals only where a parameter has changed. Enabling gradients of what has them already
changes nothing, and the backward pass before has used up the edges between positions and normals: from the second pass
on, in Mitsuba's integrators as well, the derivative by way of the normals is missing without a word.
"""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi

from ..core.compat import VERTEX_POSITIONS, mesh_buffers
from ..core.memory import Memory
from ..core.warn_once import warn_once
from ..errors import UnsupportedWarning
from .facts import SceneFacts


def warn_about_stale_normals(scene: mi.Scene, facts: SceneFacts, memory: Memory) -> None:
    """Warn of smooth meshes whose positions are differentiated and whose normals do not depend on them.

    For backward mode: in forward mode the tangents have reached the normals before rendering. Each is named once.
    """
    smooth = [s for s in facts.shapes if s.smooth and s.index >= 0 and VERTEX_POSITIONS in s.geometry]
    if not smooth:
        return
    with dr.resume_grad():
        graph, shapes = dr.graphviz_ad(as_string=True), scene.shapes()
        lost = [s.name for s in smooth if not _depends(mesh_buffers(shapes[s.index])[1], graph)]
    for name in lost:
        key = f"{name}.{VERTEX_POSITIONS}"
        warn_once(
            f"the vertex normals of shape '{name}' do not depend on '{key}', which has gradients enabled: that part of "
            f"the derivative is missing; before every backward pass, assign params['{key}'] or call "
            f"params.set_dirty('{key}'), then params.update()",
            UnsupportedWarning, memory,
        )  # fmt: skip


def _depends(value: mi.Float, graph: str) -> bool:
    """Whether the variable of `value` in Dr.Jit's graph, given as GraphViz text, has an edge to what it came from."""
    return value.index_ad != 0 and re.search(rf"^\s*{value.index_ad} -> ", graph, re.MULTILINE) is not None
