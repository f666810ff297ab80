"""What a set of derivative images says: error against time, bias apart from variance, tails. NumPy only, no rendering.

Images are arrays (K, H, W, C) of K independent renders of one method, with K seconds; the reference is the mean of two
independent halves, (H, W, C) each. Errors are mean squares over pixels and channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psdr_jit.derivative.statistics import block_means

BLOCK = 8  # [px] blocks whose products are taken for independent in the error of the squared bias
SPLITS = 16  # random halvings of the renders behind the squared bias
TAIL_SHARE = 1e-3  # share of the pixel values that the heavy-tail index looks at


@dataclass(frozen=True)
class Reference:
    """Two independent halves of a converged derivative image, and the squared error of their mean."""

    halves: np.ndarray  # (2, H, W, C)
    squared_error: float
    groups: tuple[np.ndarray, np.ndarray] | None = None  # each half by independent groups (G, H, W, C), if kept

    @property
    def mean(self) -> np.ndarray:
        return self.halves.mean(0)

    @property
    def power(self) -> float:
        """Mean square of the derivative, free of noise bias."""
        return float(np.mean(self.halves[0] * self.halves[1]))


def error_curve(images: np.ndarray, seconds: np.ndarray, reference: Reference) -> list[dict[str, float]]:
    """Relative RMSE of the mean of n renders for n = 1, 2, 4, …, K, and the seconds that n renders take.

    Each n uses every disjoint group of n renders; the error of the reference is in the figure, as in the eye of a
    reader who compares with it.
    """
    count, scale = len(images), np.sqrt(reference.power)
    sizes = sorted({*(2**k for k in range(int(np.log2(count)) + 1)), count})
    curve = []
    for n in sizes:
        groups = count // n
        means = images[: groups * n].reshape(groups, n, *images.shape[1:]).mean(1)
        rmse = np.sqrt(np.mean((means - reference.mean) ** 2))
        curve.append({"renders": n, "seconds": float(np.median(seconds) * n), "rmse": float(rmse / scale)})
    return curve


def variance(images: np.ndarray) -> float:
    """Mean pixel variance of one render."""
    return float(images.var(axis=0, ddof=1).mean())


def squared_bias(images: np.ndarray, reference: Reference, seed: int = 0) -> tuple[float, float]:
    """Mean square of what no number of renders would cure, and its standard error.

    (A − R₁)(B − R₂), averaged over pixels, where A and B are means over disjoint halves of the renders, and R₁, R₂ the
    halves of the reference: products of independent errors, so that noise averages out instead of adding up. It can
    come out negative when there is no bias. The standard error is that of the mean over pixel blocks.
    """
    rng = np.random.default_rng(seed)
    count, half = len(images), len(images) // 2
    first, second = reference.halves
    product = np.zeros(images.shape[1:])
    for _ in range(SPLITS):
        order = rng.permutation(count)
        a, b = images[order[:half]].mean(0), images[order[half:]].mean(0)
        product += ((a - first) * (b - second) + (a - second) * (b - first)) / (2 * SPLITS)
    blocks = block_means(product, BLOCK).mean(-1)
    return float(product.mean()), float(blocks.std(ddof=1) / np.sqrt(blocks.size))


def tail_share(images: np.ndarray) -> float:
    """Share of the squared deviation from the mean that sits in the top 0.1 % of values: 0.004 for a normal law.

    Near 1, the error of a render is a handful of fireflies.
    """
    deviation = np.sort(((images - images.mean(0)) ** 2).ravel())[::-1]
    total = deviation.sum()
    return float(deviation[: max(1, round(TAIL_SHARE * deviation.size))].sum() / total) if total > 0 else 0.0


def mean_squared_error_after(seconds: float, per_render: float, bias2: float, pixel_variance: float) -> float:
    """Expected squared error of what fits into `seconds`: bias² + variance · (seconds of a render) / seconds."""
    return max(bias2, 0.0) + pixel_variance * per_render / seconds
