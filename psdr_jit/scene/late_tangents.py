"""Tangents that have not reached what Mitsuba has computed from a parameter when forward mode renders.

`dr.forward` visits rendering as soon as the parameters that it was given have their tangents. Of the field of view of a
camera, the cone of a spot and the index of rough plastic, Mitsuba renders with numbers that it has computed from them
in `params.update()` and that do not have theirs yet: what these bring was 0 or came from the parameter alone, with
Mitsuba's own integrators as well. All other parameters are read as they are, or by way of values that come before.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from .facts import SceneFacts

#: Last parts of the names of these parameters.
_LATE = ("x_fov", "cutoff_angle", "beam_width", "eta")


@contextmanager
def tangents_arrived(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts) -> Iterator[None]:
    """While it lasts, such parameters stand in the scene as variables of their own, with the same tangents, and what is
    computed from them has its own. They are put back at the end. Where tangents had arrived before, nothing changes.
    """
    if not any(name.rpartition(".")[2] in _LATE for name in facts.enabled):
        yield
        return
    with dr.resume_grad():
        params = [mi.traverse(scene)]
        if sensor not in params[0].hierarchy:  # loaded on its own
            params.append(mi.traverse(sensor))
        names = [(p, name) for p in params for name in p.keys() if name.rpartition(".")[2] in _LATE]
        late = [(p, name) for p, name in names if _has_tangent(p[name])]
        given = [type(p[name])(p[name]) for p, name in late]
        try:
            for (p, name), value in zip(late, given, strict=True):
                own = dr.detach(value)
                dr.enable_grad(own)
                dr.set_grad(own, dr.grad(value))
                _assign(p, name, own)
                dr.enqueue(dr.ADMode.Forward, own)
                dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
            yield
        finally:
            for (p, name), value in zip(late, given, strict=True):
                _assign(p, name, value)


def _has_tangent(value) -> bool:
    return dr.is_array_v(value) and dr.grad_enabled(value) and bool(dr.any(dr.ravel(dr.grad(value)) != 0)[0])


def _assign(params: mi.SceneParameters, name: str, value) -> None:
    params[name] = value
    params.set_dirty(name)
    params.update()
