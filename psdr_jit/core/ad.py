"""The one place that decides how Dr.Jit's AD graph is traversed and what is kept of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr

from psdr_jit.errors import UnsupportedError

#: What Dr.Jit says of a value in a loop that was computed outside of it from attached variables.
COMPUTED_OUTSIDE = "outside of the current dr.isolate_grad() scope"


def array_of(value):
    """The value of a scene parameter as a Dr.Jit array: of a transform, its matrix.

    Not by asking for `matrix`: vectors and colours have every attribute whose letters name components, or do not.
    """
    return value if dr.is_array_v(value) else value.matrix


def tangents(*values):
    """Forward-mode tangents of `values`. Interior nodes keep theirs until all are read: one value may feed another.

    A value that does not depend on any parameter has tangent 0.
    """
    return dr.forward_to(*values, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)


def accumulate(value) -> None:
    """Backward-propagate a scalar, leaving the scene's edges in place for the terms that follow.

    A value that does not depend on any parameter has nothing to say.
    """
    if dr.grad_enabled(value):
        dr.backward_from(value, flags=dr.ADFlag.ClearVertices)


def backpropagate(image, grad_in) -> None:
    """Backward-propagate ⟨grad_in, image⟩, likewise leaving the edges in place."""
    dr.set_grad(image, grad_in)
    dr.enqueue(dr.ADMode.Backward, image)
    dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)


@contextmanager
def leftovers_named() -> Iterator[None]:
    """Raise an `UnsupportedError` that names the way out where Dr.Jit meets what a loop has left attached.

    Its virtual calls reach every scene that is alive, and forward mode follows their parameters back to what these were
    computed from; so it does with Mitsuba's own integrators.
    """
    try:
        yield
    except RuntimeError as error:
        cause: BaseException | None = error
        while cause is not None and COMPUTED_OUTSIDE not in str(cause):
            cause = cause.__cause__
        if cause is None:
            raise
        raise UnsupportedError(
            "a parameter of this scene, or of another one that is alive, is still attached to what it was computed "
            "from, as loops of optimisation leave it, and forward mode cannot tell it from those it is about: detach "
            "it (params[key] = dr.detach(params[key]); params.update()), or delete its scene and params"
        ) from error
