"""The one place that decides how Dr.Jit's AD graph is traversed and what is kept of it."""

from __future__ import annotations

import drjit as dr


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
