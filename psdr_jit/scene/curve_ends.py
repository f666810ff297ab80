"""Mitsuba 3.9.1 reads past the segments of a B-spline curve where a ray meets the very end of it, and may crash there.

Its derivatives by (u, v), which are asked for at every hit, look up segment number floor(v · count), which is `count`
at v = 1 (`BSplineCurve::partials`). What is rendered here goes without them (`paths.surface_at`); Mitsuba's own
`path` does not.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..core.compat import CONTROL_POINTS
from ..core.upload import uploaded
from .names import traverse

#: Parameter of a curve: its segments, by their first control points.
SEGMENTS = "segment_indices"


def pad_curves(scene: mi.Scene) -> None:
    """Let the last segment of every B-spline curve stand once more behind the others, where it is read by mistake.

    Pictures stay the same. On the CPU; CUDA arrays do not let one choose what lies behind them.
    """
    if not any(shape.class_name() == "BSplineCurve" for shape in scene.shapes()):
        return
    params = traverse(scene)
    for name in list(params.keys()):
        owner, _, last = name.rpartition(".")
        if last == SEGMENTS:
            params[name] = uploaded(mi.UInt32, np.array(params[name]), beyond=1)
            params.set_dirty(name)
            params.set_dirty(f"{owner}.{CONTROL_POINTS}")  # Mitsuba looks for changes of a curve there alone
    params.update()
