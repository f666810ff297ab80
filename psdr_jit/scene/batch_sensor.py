"""The `batch` sensor: several sensors whose images stand side by side in one film.

Each of its sensors is rendered by itself. Samples near a seam do not bleed into the neighbour's image, as those of
Mitsuba's own `batch` do with filters wider than a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import PIXEL_FORMATS, black, film_like
from .graph import child_objects, plugin_name


@dataclass(frozen=True)
class Part:
    """One sensor of a batch. Its film has the size of its share of the image."""

    sensor: mi.Sensor
    film: mi.Film  # its own, or one of that size with the filter and the channels of the batch's
    seed: Any  # int or mi.UInt32
    spp: int


def splits(sensor: mi.Sensor) -> bool:
    """Is it a batch whose sensors can be rendered one by one? Not if it is cropped.

    Sensors come with films of their own, which may have other filters: what counts is the film of the batch. Where
    these ask for samples beyond the border, the two must agree.
    """
    if plugin_name(sensor) != "batch":
        return False
    film = sensor.film()
    fits = is_uniform(sensor) or all(_border(f) == 0 for f in (film, *(child.film() for child in _sensors(sensor))))
    return fits and _format(film)[1] in PIXEL_FORMATS and tuple(film.crop_size()) == tuple(film.size())


def is_uniform(batch: mi.Sensor) -> bool:
    """Are the films of all its sensors like its own?"""
    return all(_format(child.film()) == _format(batch.film()) for child in _sensors(batch))


def parts_of(sensor: mi.Sensor, seed: Any, spp: int) -> list[Part]:
    """The sensors of a batch from left to right, each with a seed of its own and the batch's sample count."""
    found = _sensors(sensor)
    for child in found:
        child.sampler().set_sample_count(sensor.sampler().sample_count())
    return [Part(child, _film(sensor.film(), child.film()), _seed(seed, k), spp) for k, child in enumerate(found)]


def _film(of_batch: mi.Film, own: mi.Film) -> mi.Film:
    """`own`, or what it would be with the format of the batch's film."""
    if _format(own) == _format(of_batch):
        return own
    width, height = own.crop_size()
    return film_like(of_batch, (int(width), int(height)))


def _border(film: mi.Film) -> int:
    """How far beyond the image samples are taken [px]."""
    return film.rfilter().border_size() if film.sample_border() else 0


def _sensors(batch: mi.Sensor) -> list[mi.Sensor]:
    return [child for child in child_objects(batch) if isinstance(child, mi.Sensor)]


def _format(film: mi.Film) -> tuple[str, int]:
    """Reconstruction filter and number of channels."""
    return str(film.rfilter()), black(film).shape[2]


def _seed(seed: Any, k: int) -> Any:
    if k == 0:
        return seed
    if isinstance(seed, int):
        return int(np.random.SeedSequence((seed, k)).generate_state(1)[0])
    return mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(k))[0]


def side_by_side(images: list[mi.TensorXf]) -> mi.TensorXf:
    """Images (H, W, C) of one size as one image (H, n W, C)."""
    height, width, channels = images[0].shape
    n = len(images)
    index = dr.arange(mi.UInt32, height * n * width * channels)
    c, x, y = index % channels, (index // channels) % (n * width), index // (channels * n * width)
    part, inside = x // width, (y * width + x % width) * channels + c
    values = mi.Float(0)
    for k, image in enumerate(images):
        values = dr.select(part == k, dr.gather(mi.Float, image.array, inside, part == k), values)
    return mi.TensorXf(values, (height, n * width, channels))


def share(image: mi.TensorXf, k: int, count: int) -> mi.TensorXf:
    """The part of sensor `k` out of `count`: the adjoint of `side_by_side`."""
    width = image.shape[1] // count
    return image[:, k * width : (k + 1) * width, :]
