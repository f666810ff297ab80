"""Image files: multi-layer OpenEXR for numbers, PNG with a diverging colour map for eyes.

Files are written beside their destination and renamed, so a reader never meets half of one.
"""

from __future__ import annotations

import errno
import io
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from psdr_jit.core import files
from psdr_jit.errors import OptionError

ROBUST_PERCENTILE = 99.0    # of |value| where not zero: the end of the colour scale
COLOUR_MAP = "RdBu_r"       # red positive, blue negative, white zero
PROBE = 4096    # bytes that a folder must have room for: a disk that is full takes empty files
CHANNELS = {0: (), 1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}


def check_writable(path: str | os.PathLike) -> Path:
    """Raise `OptionError` if a file at `path` could not be written; call it before rendering."""
    path = Path(path)
    if path.is_dir():
        raise OptionError(f"cannot write '{path}': it is a folder; name a file in it")
    folder = path.parent
    if not folder.is_dir():
        raise OptionError(f"cannot write '{path}': the folder '{folder}' does not exist; create it first")
    if path.exists() and not os.access(path, os.W_OK):
        raise OptionError(f"cannot write '{path}': the file is write-protected; choose another name")
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".psdr-") as file:
            file.write(bytes(PROBE))
    except OSError as error:
        raise files.refusal(path, error) from error
    return path


def write_exr(path: str | os.PathLike, layers: Mapping[str, np.ndarray],
              metadata: Mapping[str, str] | None = None, aovs: Sequence[str] = ()) -> Path:
    """Write images (H, W, C) as layers of one 32-bit float OpenEXR file.

    The first layer is also the default one (plain R, G, B), so that every viewer shows something. Layer
    `total` has the channels `total.R`, `total.G`, `total.B`. `metadata` goes into the header.
    `aovs`: names of the last channels of every layer, as `dd.T`; they become `total.dd.T`.
    """
    import OpenEXR

    if not layers:
        raise OptionError("an OpenEXR file needs at least one layer")
    channels: dict[str, np.ndarray] = {}
    for k, (name, image) in enumerate(layers.items()):
        for prefix in ("", f"{name}.") if k == 0 else (f"{name}.",):
            channels.update(_channels(prefix, image, aovs))
    sizes = {c.shape for c in channels.values()}
    if len(sizes) > 1:
        raise OptionError(f"the layers of an image must have one size, got {sorted(sizes)}")
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header.update({f"psdr_{k}": str(v) for k, v in (metadata or {}).items()})

    def write(temporary: str) -> None:
        with OpenEXR.File(header, dict(channels)) as file:  # it puts objects of its own into the dict
            file.write(temporary)
        _require_whole(temporary, channels)

    return _replaced(path, write)


def _require_whole(path: str, channels: Mapping[str, np.ndarray]) -> None:
    """Raise `OSError` unless these channels are in the file: OpenEXR does not notice when its last block is lost."""
    try:
        found = read_exr(path)
    except RuntimeError as error:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
    if not all(name in found and np.array_equal(found[name], channels[name], equal_nan=True) for name in channels):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def channel_names(count: int, aovs: Sequence[str] = ()) -> tuple[str, ...]:
    """Names of `count` channels, of which the last are `aovs`: what is no colour must not pass for alpha."""
    count -= len(aovs)
    return (*CHANNELS.get(count, ("R", "G", "B", *(f"C{k}" for k in range(3, count)))), *aovs)


def colours(image: np.ndarray, aovs: Sequence[str] = ()) -> np.ndarray:
    """What there is to see of an image (H, W, C) whose last channels are `aovs`: the others, or all if there are none.
    """
    image = np.asarray(image)
    return image[..., : image.shape[-1] - len(aovs)] if image.ndim == 3 and image.shape[-1] > len(aovs) else image


def _channels(prefix: str, image: np.ndarray, aovs: Sequence[str]) -> dict[str, np.ndarray]:
    image = np.asarray(image, dtype=np.float32)
    image = image if image.ndim == 3 else image[..., None]
    names = channel_names(image.shape[-1], aovs)
    return {prefix + c: np.ascontiguousarray(image[..., k]) for k, c in enumerate(names)}


def read_exr(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """All channels of an OpenEXR file as float32 arrays (H, W), by full name such as `total.R`."""
    import OpenEXR

    with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def read_metadata(path: str | os.PathLike) -> dict[str, str]:
    """What `write_exr` was given as metadata."""
    import OpenEXR

    with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
        return {key.removeprefix("psdr_"): str(v) for key, v in file.header().items() if key.startswith("psdr_")}


def write_picture(path: str | os.PathLike, image: np.ndarray) -> Path:
    """Write linear radiance (H, W, C) as PNG, pixel by pixel, in sRGB."""
    from matplotlib.image import imsave

    return _replaced(path, lambda temporary: imsave(temporary, srgb(image), format="png"))


def write_derivative_png(path: str | os.PathLike, image: np.ndarray, title: str = "",
                         unit: str = "radiance per unit") -> Path:
    """Write one derivative image (H, W, C) in red (positive) and blue (negative) with a colour bar."""
    return write_panels(path, [("derivative", title, image)], unit)


def write_panels(path: str | os.PathLike, panels: Sequence[tuple[str, str, np.ndarray]],
                 unit: str = "radiance per unit") -> Path:
    """Write `panels_figure` as PNG."""
    return save_figure(path, panels_figure(panels, unit))


def panels_figure(panels: Sequence[tuple[str, str, np.ndarray]], unit: str = "radiance per unit",
                  columns: int | None = None) -> Any:
    """Images side by side, in rows of `columns`: each panel is (kind, title, image), kind `primal` or `derivative`.

    Derivatives show the mean of their channels; all of them share one symmetric scale, set by a percentile
    so that a few noisy pixels do not wash out the rest.
    """
    from matplotlib.figure import Figure

    derivatives = [grey(image) for kind, _, image in panels if kind == "derivative"]
    limit = robust_limit(derivatives) if derivatives else 1.0
    # Figure instead of pyplot: no global state, no display
    columns = min(columns or len(panels), len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.6 * columns + 0.9, 3.9 * rows), dpi=120, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    shown = None
    for axis in axes:
        axis.set_axis_off()
    for axis, (kind, title, image) in zip(axes, panels, strict=False):
        axis.set_title(title, fontsize=9)
        if kind == "primal":
            axis.imshow(srgb(image), interpolation="nearest")
        else:
            shown = axis.imshow(grey(image), cmap=COLOUR_MAP, vmin=-limit, vmax=limit,
                                interpolation="nearest")
    if shown is not None:
        # in one row the bar stands beside the derivatives, below others it would not say whose it is
        beside = axes if rows > 1 else [a for a, p in zip(axes, panels, strict=False) if p[0] == "derivative"]
        figure.colorbar(shown, ax=beside, label=unit, shrink=0.85)
    return figure


def png_bytes(figure: Any) -> bytes:
    """A Matplotlib figure as PNG, in memory."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def save_figure(path: str | os.PathLike, figure: Any) -> Path:
    """Write a Matplotlib figure as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    return _replaced(path, lambda temporary: figure.savefig(temporary, format="png"))


def robust_limit(images: Sequence[np.ndarray]) -> float:
    """Largest value of a symmetric colour scale: a percentile of the non-zero magnitudes, 1 if all vanish."""
    values = np.concatenate([np.abs(np.asarray(i)).ravel() for i in images])
    values = values[np.isfinite(values) & (values > 0)]
    return float(np.percentile(values, ROBUST_PERCENTILE)) if values.size else 1.0


def srgb(image: np.ndarray) -> np.ndarray:
    """Linear radiance (H, W, C) to display values in [0, 1] (H, W, 3)."""
    image = np.asarray(image, dtype=np.float64)
    image = np.repeat(image[..., :1], 3, axis=-1) if image.shape[-1] < 3 else image[..., :3]
    image = np.clip(np.nan_to_num(image), 0, 1)
    return np.where(image <= 0.0031308, 12.92 * image, 1.055 * image ** (1 / 2.4) - 0.055)


def grey(image: np.ndarray) -> np.ndarray:
    """Mean of the colour channels (H, W): of red, green and blue, or luminance beside its alpha."""
    image = np.asarray(image, dtype=np.float64)
    return image if image.ndim == 2 else image[..., : 3 if image.shape[-1] >= 3 else 1].mean(-1)


def _replaced(path: str | os.PathLike, write: Callable[[str], None]) -> Path:
    """The file at `path`, whole or not at all; `OptionError` or `StorageError` otherwise."""
    return files.replace(check_writable(path), write)
