"""Losses: numbers that say how far an image is from its target. All are means over pixels and channels.

A loss is a function of images (H, W, C), attached, and a target of the same shape, that returns one number. The
gradient of the rendering is sampled apart from the images, so that it is unbiased wherever the loss is at most
quadratic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from psdr_jit.errors import OptionError

#: Squared radiance that is added to the denominator of the relative loss, so that black pixels do not rule it.
RELATIVE_FLOOR = 1e-2


@dataclass(frozen=True)
class Loss:
    """`function(*images, target)`, with `images` independent renders of one view."""

    name: str
    function: Callable[..., Any]
    images: int = 1


def l1(image: Any, target: Any) -> Any:
    """⟨|I − T|⟩. Its derivative with respect to a noisy image is biased towards the median."""
    return dr.mean(dr.abs(image - target), axis=None)


def l2(image: Any, target: Any) -> Any:
    """⟨(I − T)²⟩. The value contains the variance of the image; the gradient is unbiased."""
    return dr.mean(dr.square(image - target), axis=None)


def relative_l2(image: Any, target: Any) -> Any:
    """⟨(I − T)² / (I² + ε)⟩ with the denominator held fixed, as in Rousselle et al. 2011 and Lehtinen et al. 2018."""
    return dr.mean(dr.square(image - target) / (dr.square(dr.detach(image)) + RELATIVE_FLOOR), axis=None)


def dual_l2(first: Any, second: Any, target: Any) -> Any:
    """⟨(I₁ − T)(I₂ − T)⟩ of two independent images: the value is unbiased as well, and may be negative by noise.

    The dual-buffer method of Deng et al. 2022, "Reconstructing Translucent Objects using Differentiable Rendering".
    """
    return dr.mean((first - target) * (second - target), axis=None)


LOSSES = {
    "l1": Loss("l1", l1),
    "l2": Loss("l2", l2),
    "relative_l2": Loss("relative_l2", relative_l2),
    "dual_l2": Loss("dual_l2", dual_l2, images=2),
}


def find_loss(loss: str | Loss | Callable[..., Any]) -> Loss:
    """A loss by its name, itself, or made of a function of (image, target)."""
    if isinstance(loss, Loss):
        return loss
    if isinstance(loss, str):
        if loss not in LOSSES:
            raise OptionError(f"there is no loss '{loss}': it is one of {', '.join(LOSSES)}, or a function")
        return LOSSES[loss]
    if not callable(loss):
        raise OptionError(f"loss = {loss!r}: expected one of {', '.join(LOSSES)}, or a function of image and target")
    return Loss(getattr(loss, "__name__", "loss"), loss)
