"""Means with measured errors, and the comparison of two noisy images. No rendering here, numpy only.

Images of independent seeds are collected into a fixed number of groups, so that memory stays bounded while
seeds are added without end; all errors come from the scatter between groups.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


class GroupedImages:
    """Running sums of images (H, W, C) in `groups` groups, filled in turn; float64."""

    def __init__(self, groups: int = 32) -> None:
        self.groups = groups
        self.count = np.zeros(groups, dtype=np.int64)
        self.sums: np.ndarray | None = None
        self.total = 0

    def add(self, image: np.ndarray) -> None:
        """Add the image of one more independent seed."""
        if self.sums is None:
            self.sums = np.zeros((self.groups, *image.shape))
        g = self.total % self.groups
        self.sums[g] += image
        self.count[g] += 1
        self.total += 1

    def group_means(self) -> np.ndarray:
        """Mean image of each non-empty group, (G, H, W, C)."""
        used = self.count > 0
        return self.sums[used] / self.count[used, None, None, None]

    def mean(self) -> np.ndarray:
        """Mean over all seeds, (H, W, C)."""
        return self.sums.sum(0) / self.total

    def stderr(self, block: int = 1) -> np.ndarray:
        """Standard error of the mean of each block of `block` x `block` pixels; NaN below two groups."""
        return standard_error(block_means(self.group_means(), block))


def standard_error(samples: np.ndarray) -> np.ndarray:
    """Standard error of the mean over axis 0; NaN for a single sample."""
    n = samples.shape[0]
    if n < 2:
        return np.full(samples.shape[1:], np.nan)
    return samples.std(axis=0, ddof=1) / np.sqrt(n)


def block_means(images: np.ndarray, block: int) -> np.ndarray:
    """Means over blocks of pixels: (..., H, W, C) -> (..., ceil(H/block), ceil(W/block), C).

    Blocks at the right and lower margin may be smaller.
    """
    if block == 1:
        return images
    h, w = images.shape[-3:-1]
    rows, cols = np.arange(0, h, block), np.arange(0, w, block)
    sums = np.add.reduceat(np.add.reduceat(images, rows, axis=-3), cols, axis=-2)
    size_r = np.diff(np.append(rows, h))[:, None, None]
    size_c = np.diff(np.append(cols, w))[None, :, None]
    return sums / (size_r * size_c)


@dataclass(frozen=True)
class Gain:
    """Least-squares slope of an estimate against a noisy reference, with its error split by cause."""

    value: float
    stderr_estimate: float   # part due to the noise of d
    stderr_reference: float  # part due to the noise of f1 and f2
    power: float             # f1 . f2, the squared norm of the reference without noise bias
    power_stderr: float

    @property
    def stderr(self) -> float:
        return float(np.hypot(self.stderr_estimate, self.stderr_reference))

    @property
    def has_signal(self) -> bool:
        """The reference differs from zero beyond its own noise, so the slope means something."""
        return self.power > 4 * self.power_stderr


def gain(d: np.ndarray, f1: np.ndarray, f2: np.ndarray) -> Gain:
    """gain = d . (f1 + f2) / (2 f1 . f2), its error by deleting one group at a time.

    Each argument is an array of group means, first axis the groups; the three are independent of each other.
    With a single noisy reference f, d . f / f . f would be biased low by the noise power of f.
    """
    d, f1, f2 = (np.reshape(x, (x.shape[0], -1)) for x in (d, f1, f2))
    df1, df2, ff = d @ f1.T, d @ f2.T, f1 @ f2.T

    def slope(wd: np.ndarray, w1: np.ndarray, w2: np.ndarray) -> tuple[float, float]:
        power = float(w1 @ ff @ w2)
        return (float(wd @ df1 @ w1 + wd @ df2 @ w2) / (2 * power) if power else float("nan")), power

    weights = [np.full(len(x), 1 / len(x)) for x in (d, f1, f2)]
    value, power = slope(*weights)
    variance, power_variance = [], []
    for k, x in enumerate((d, f1, f2)):
        n = len(x)
        replicas = []
        for leave in range(n if n > 1 else 0):
            w = np.full(n, 1 / (n - 1))
            w[leave] = 0
            replicas.append(slope(*[w if j == k else weights[j] for j in range(3)]))
        # the classical jackknife: (n-1)/n times the sum of squared deviations of the replicas
        spread = (n - 1) * np.var(replicas, axis=0) if n > 1 else (np.nan, np.nan)
        variance.append(spread[0])
        power_variance.append(spread[1])
    return Gain(value, float(np.sqrt(variance[0])), float(np.sqrt(variance[1] + variance[2])), power,
                float(np.sqrt(power_variance[1] + power_variance[2])))


#: |z| from which on a block's measured error is asked whether it is that of few events.
SURPRISING = 3.0


@dataclass(frozen=True)
class BlockTest:
    """z-scores of block means of two images."""

    rms_z: float     # over blocks with a measured error; NaN when there is none
    max_z: float     # largest |z| over all blocks where anything is non-zero
    blocks: int      # number of z-scores in rms_z
    z: np.ndarray    # (h, w, C), 0 where both images vanish


@dataclass(frozen=True)
class Unseen:
    """Errors of block means (h, w, C) that the scatter between groups does not show."""

    floor: float | np.ndarray = 0.0
    rare: float | np.ndarray = 0.0  # what one event changes: where few have occurred, scatter may be far too small


def block_test(d: np.ndarray, f: np.ndarray, block: int, unseen: Unseen = Unseen()) -> BlockTest:
    """z = (mean d - mean f) / sqrt(se_d^2 + se_f^2 + floor^2) for each block of pixels and channel.

    `d`, `f`: group means (G, H, W, C). Blocks whose measured error lies below `unseen.floor` count towards max_z only,
    since the root mean square of their z says nothing. `unseen.rare` counts as an error of blocks that are off by more
    than `SURPRISING`.
    """
    floor, rare = unseen.floor, unseen.rare
    d, f = block_means(d, block), block_means(f, block)
    variance = standard_error(d) ** 2 + standard_error(f) ** 2
    difference = d.mean(0) - f.mean(0)
    active = (variance > 0) | (difference != 0)
    measured = variance > floor**2
    with np.errstate(divide="ignore", invalid="ignore"):
        z, far = (np.nan_to_num(np.where(active, difference / np.sqrt(total), 0.0), nan=0.0)
                  for total in (variance + floor**2, variance + floor**2 + rare**2))  # fmt: skip
    z = np.where(np.abs(z) > SURPRISING, far, z)
    rms = float(np.sqrt(np.mean(z[measured] ** 2))) if measured.any() else float("nan")
    return BlockTest(rms, float(np.abs(z).max(initial=0.0)), int(measured.sum()), z)
