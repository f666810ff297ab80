"""What the images should become: files, arrays, or renders of a scene; checked before anything is optimised."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.film import black
from psdr_jit.core.upload import uploaded
from psdr_jit.derivative import images
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.scene.io import find_sensor

#: Seed of rendered targets.
TARGET_SEED = 0x7A26E7

#: Samples per pixel of a target that are rendered at once.
PASS = 256

#: Luminance of linear Rec. 709 colours, by channel, as in Mitsuba.
LUMINANCE = {"R": 0.2126, "G": 0.7152, "B": 0.0722}


@dataclass(frozen=True)
class View:
    """A sensor of a scene, and the image (H, W, C) that it should see."""

    sensor: mi.Sensor
    target: mi.TensorXf
    name: str
    part: int = 0  # which of several scenes
    share: float = 1.0  # of its loss in that of the problem
    aovs: tuple[str, ...] = ()  # names of the last channels, those that are no colours


def view(scene: mi.Scene, sensor: Any, target: Any, aovs: Sequence[str] = ()) -> View:
    """A view after its checks. `target`: array (H, W, C), Dr.Jit tensor, or the path of an image file.

    `aovs`: names of the channels that the integrator renders behind those of the film; a target has them as well.
    Files hold linear radiance (EXR, PFM, HDR) or are converted to it (PNG, JPEG). Raises `ParameterError` for images of
    another size and for values that are not finite, `OptionError` for files that cannot be read.
    """
    found = find_sensor(scene, sensor)
    name = sensor_name(scene, found)
    what = f"the target of sensor '{name}'"
    expected = image_shape(found, len(aovs))
    if isinstance(target, (str, os.PathLike)):
        what, target = f"{what}, '{target}',", read_image(target, expected[2], aovs)
    image = np.asarray(target, dtype=np.float32)
    image = image[..., None] if image.ndim == 2 else image
    if image.shape != expected:
        channels = f", the last of which are {', '.join(aovs)}" if aovs else ""
        raise ParameterError(
            f"{what} has the shape {image.shape}, but the sensor renders {expected}{channels}: resize the target, "
            f"or set the film's width, height and pixel format{', or aovs' if aovs else ''}"
        )
    bad = int(np.count_nonzero(~np.isfinite(image)))
    if bad:
        raise ParameterError(
            f"{what} has {bad} of {image.size} values that are not finite (NaN or infinite): repair the "
            "image; one such pixel makes every gradient NaN"
        )
    return View(found, mi.TensorXf(uploaded(mi.Float, image), image.shape), name, aovs=tuple(aovs))


def views(scene: mi.Scene, targets: Any, aovs: Sequence[str] = ()) -> list[View]:
    """`targets`: one image for the first sensor, a list with one image per sensor, or a dict by sensor index.

    `aovs` as of `view`.
    """
    if isinstance(targets, (str, os.PathLike)) or hasattr(targets, "shape"):
        pairs = [(0, targets)]
    elif isinstance(targets, dict):
        pairs = list(targets.items())
    elif isinstance(targets, Sequence):
        pairs = list(enumerate(targets))
    else:
        raise ParameterError(f"targets must be an image, a list or a dict of images, got {type(targets).__name__}")
    if not pairs:
        raise ParameterError("there is no target: give an image for at least one sensor")
    return [view(scene, sensor, target, aovs) for sensor, target in pairs]


def rendered(scene: mi.Scene, sensor: Any, integrator: Any, spp: int) -> np.ndarray:
    """The image (H, W, C) of a scene as it stands, with `spp` samples per pixel."""
    found = find_sensor(scene, sensor)
    total, done = 0.0, 0
    while done < spp:
        part = min(PASS, spp - done)
        with dr.suspend_grad():
            image = integrator.render(scene, found, seed=TARGET_SEED + done, spp=part)
        total = total + np.array(image, dtype=np.float64) * part
        done += part
    return total / spp


def image_shape(sensor: mi.Sensor, aovs: int = 0) -> tuple[int, int, int]:
    """(H, W, C) of what a sensor renders, with so many channels behind those of its film."""
    height, width, channels = black(sensor.film()).shape
    return height, width, channels + aovs


def sensor_name(scene: mi.Scene, sensor: mi.Sensor) -> str:
    """Its id, or its number where it has none."""
    if sensor.id() and not sensor.id().startswith("_"):
        return sensor.id()
    return next((str(k) for k, s in enumerate(scene.sensors()) if s is sensor), "sensor")


def read_image(path: str | os.PathLike, channels: int = 3, aovs: Sequence[str] = ()) -> np.ndarray:
    """An image file as linear values (H, W, C), in 1 (luminance), 3 (RGB) or 4 channels (with alpha).

    Of an EXR file with several layers, the default one counts. A file with one channel of whatever name is grey; where
    luminance is wanted, colours are mixed to it. The last of the channels are the `aovs`, which EXR files alone have.
    """
    path = Path(path)
    if not path.is_file():
        raise OptionError(f"image file '{path}' does not exist: check the path")
    try:
        if path.suffix.lower() == ".exr":
            return _picked(path, images.read_exr(path), channels, aovs)
        if aovs:
            raise OptionError(f"image file '{path}' has no channels {', '.join(aovs)}: give an EXR file, or an array")
        formats = mi.Bitmap.PixelFormat
        wanted = {1: formats.Y, 4: formats.RGBA}.get(channels, formats.RGB)
        return np.array(mi.Bitmap(os.fspath(path)).convert(wanted, mi.Struct.Type.Float32, srgb_gamma=False))
    except (OSError, RuntimeError) as error:
        raise OptionError(f"image file '{path}' cannot be read: {str(error).splitlines()[-1].strip()}") from error


def _picked(path: Path, found: dict[str, np.ndarray], channels: int, aovs: Sequence[str]) -> np.ndarray:
    """So many channels (H, W, C) out of those of a file."""
    names = images.channel_names(channels, aovs) if aovs else images.CHANNELS.get(channels, ())
    if names and all(name in found for name in names):
        return np.stack([found[name] for name in names], axis=-1)
    if len(found) == 1 and channels in (1, 3) and not aovs:
        (grey,) = found.values()
        return np.repeat(grey[..., None], channels, axis=-1)
    if channels == 1 and not aovs and all(name in found for name in LUMINANCE):
        return sum(weight * found[name] for name, weight in LUMINANCE.items())[..., None]
    raise OptionError(
        f"image file '{path}' has the channels {', '.join(found)}, but the sensor renders "
        f"{', '.join(names) or f'{channels} channels'}: save the image with those, or set the film's pixel_format"
    )
