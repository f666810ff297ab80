"""Losses: values by hand, and what noise does to them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.errors import OptionError
from psdr_jit.inverse.losses import LOSSES, find_loss

RNG = np.random.default_rng(0)
IMAGE, TARGET = RNG.random((4, 5, 3)).astype(np.float32), RNG.random((4, 5, 3)).astype(np.float32)


def value(name: str, *images: np.ndarray) -> float:
    return float(np.array(LOSSES[name].function(*(mi.TensorXf(i) for i in images), mi.TensorXf(TARGET))).ravel()[0])


def test_values(llvm):
    d = IMAGE - TARGET
    assert value("l1", IMAGE) == pytest.approx(np.abs(d).mean(), rel=1e-5)
    assert value("l2", IMAGE) == pytest.approx((d**2).mean(), rel=1e-5)
    assert value("relative_l2", IMAGE) == pytest.approx((d**2 / (IMAGE**2 + 0.01)).mean(), rel=1e-5)
    assert value("dual_l2", IMAGE, IMAGE) == pytest.approx((d**2).mean(), rel=1e-5)


def test_two_images_make_the_value_unbiased(llvm):
    noisy = [TARGET + RNG.normal(scale=0.3, size=TARGET.shape).astype(np.float32) for _ in range(400)]
    single = np.mean([value("l2", image) for image in noisy])
    dual = np.mean([value("dual_l2", a, b) for a, b in zip(noisy[::2], noisy[1::2], strict=True)])
    assert single == pytest.approx(0.09, rel=0.1) and abs(dual) < 0.01


def test_the_denominator_of_the_relative_loss_is_fixed(llvm):
    image = mi.TensorXf(IMAGE)
    dr.enable_grad(image)
    dr.backward(LOSSES["relative_l2"].function(image, mi.TensorXf(TARGET)))
    expected = 2 * (IMAGE - TARGET) / (IMAGE**2 + 0.01) / IMAGE.size
    assert np.allclose(np.array(dr.grad(image)), expected, rtol=1e-4)


def test_names_and_functions(llvm):
    assert find_loss("l1").images == 1 and find_loss("dual_l2").images == 2
    assert find_loss(lambda image, target: dr.mean(image, axis=None)).images == 1
    for wrong in ("l3", 5):
        with pytest.raises(OptionError, match="dual_l2"):
            find_loss(wrong)
