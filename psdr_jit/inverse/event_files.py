"""Curves and images of an optimisation for TensorBoard, by the package `tensorboardX`, which needs no TensorFlow.

Tags: those of `observer.curves`, and `VIEW/image`, `VIEW/target`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from psdr_jit.core import files
from psdr_jit.derivative.images import check_writable, colours, srgb
from psdr_jit.errors import OptionError, SetupError
from psdr_jit.inverse.observer import Care, Seen, curves, frame_due


class EventFiles:
    """An observer that adds an event file to `folder` once a run begins: one that cannot begin leaves none.

    Raises `SetupError` where the package is missing.
    """

    def __init__(self, folder: str | os.PathLike) -> None:
        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise SetupError(
                f"files for TensorBoard need the package tensorboardX ('{error.name}' is missing): pip install "
                "tensorboardX"
            ) from error
        folder = Path(folder)
        if folder.exists() and not folder.is_dir():
            raise OptionError(f"--tensorboard {folder}: that is a file; name a folder")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise files.refusal(folder, error) from error
        check_writable(folder / "events")
        self._folder, self._make = folder, SummaryWriter
        self._care = Care(f"'{folder}'")
        self._writer: Any = None
        self._problem: Any = None

    def begin(self, problem: Any) -> None:
        self._problem = problem
        try:
            self._writer = self._make(str(self._folder))
        except OSError as error:
            raise files.refusal(self._folder, error) from error
        for view in problem.views:
            target = colours(np.array(view.target), view.aovs)
            self._care.attempt(lambda view=view, target=target: self._image(f"{view.name}/target", target, 0))

    def step(self, seen: Seen) -> None:
        self._care.attempt(lambda: self._step(seen))

    def close(self, iteration: int) -> None:
        if self._writer is None:
            return
        self._care.attempt(self._writer.close)

    def _step(self, seen: Seen) -> None:
        for name, values in curves(seen).items():
            for k, value in enumerate(values):
                tag = name if len(values) == 1 else f"{name}/{k}"
                self._writer.add_scalar(tag, value, seen.iteration)
        if frame_due(seen.iteration, self._problem.settings.iterations):
            for k, image in seen.images.items():
                view = self._problem.views[k]
                self._image(f"{view.name}/image", colours(image, view.aovs), seen.iteration)

    def _image(self, tag: str, image: np.ndarray, iteration: int) -> None:
        shown = np.round(255 * srgb(image)).astype(np.uint8)
        self._writer.add_image(tag, shown, iteration, dataformats="HWC")
