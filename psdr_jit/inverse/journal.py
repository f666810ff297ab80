"""What a run leaves on disk: a log, checkpoints, snapshots, pictures, and the final values.

`log.jsonl` has one object per iteration; `checkpoint.npz` the state; `snapshots/` images; `result.png` a strip of the
images before and after; `curves.png` loss and offsets; `final.npz` the values of all variables, meshes as PLY.
A full disk does not end a run: what could not be written is warned about, once each, and named in the result.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core.compat import VERTEX_POSITIONS
from psdr_jit.derivative import images
from psdr_jit.errors import CheckpointError, OptionError
from psdr_jit.inverse import checkpoint as checkpoints
from psdr_jit.inverse import pictures
from psdr_jit.inverse.variables import numbers
from psdr_jit.scene.params import is_transform

#: Views that the final strip shows, and samples per pixel of its images.
SHOWN, STRIP_SPP = 3, 64

SEED = 0x57121B  # of the strip's images


class Journal:
    """Writes into `folder`, or nothing if it is None. `keep`: iterations of an earlier run that stay in the log."""

    def __init__(self, folder: Path | None, problem: Any, keep: int) -> None:
        self.folder = folder
        self.not_written: list[str] = []
        self._rows: list[dict[str, Any]] = []
        self._initial: list[np.ndarray] = []
        self._log: Any = None
        if folder is None:
            return
        try:
            (folder / "snapshots").mkdir(parents=True, exist_ok=True)
            images.check_writable(folder / "log.jsonl")
            self._rows = [row for row in _rows(folder / "log.jsonl") if row["iteration"] < keep]
            kept = folder / ".log.jsonl"  # renamed once it is complete: a full disk must not cost the history
            kept.write_text("".join(json.dumps(row) + "\n" for row in self._rows), encoding="utf-8")
            os.replace(kept, folder / "log.jsonl")
            self._log = open(folder / "log.jsonl", "a", encoding="utf-8")  # open as long as the run
        except OSError as error:
            raise OptionError(
                f"cannot write to the folder '{folder}': {error.strerror or error}; choose another"
            ) from error

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            self._try("log.jsonl", self._log.close)

    def step(self, iteration: int, loss: float, norms: dict[str, float], seconds: float, views: list[int], rate: float,
             offsets: dict[str, dict[str, float]]) -> None:  # fmt: skip
        """Log an iteration: what was found before its step."""
        row = {
            "iteration": iteration,
            "loss": loss if np.isfinite(loss) else None,
            "gradient_norm": {name: norm if np.isfinite(norm) else None for name, norm in norms.items()},
            "seconds": seconds,
            "views": views,
            "rate": rate,
            "offset": offsets,
        }
        self._rows.append(row)

        def write() -> None:
            self._log.write(json.dumps(row) + "\n")
            self._log.flush()

        self._try("log.jsonl", write)

    def keep(self, checkpoint: checkpoints.Checkpoint) -> None:
        """Replace the checkpoint."""
        self._try(checkpoints.NAME, lambda: checkpoints.save(self.folder / checkpoints.NAME, checkpoint))

    def snapshot(self, iteration: int, problem: Any, found: dict[int, np.ndarray]) -> None:
        """The images that the loss has seen, beside their targets."""
        layers = {}
        for k, image in found.items():
            view = problem.views[k]
            layers |= {f"image_{view.name}": image, f"target_{view.name}": np.array(view.target)}
        sizes = {layer.shape[:2] for layer in layers.values()}
        if len(sizes) == 1:  # a file has one size
            path = self.folder / "snapshots" / f"{iteration:06d}.exr" if self.folder else None
            self._try("snapshots", lambda: images.write_exr(path, layers, {"iteration": str(iteration)}))
        else:
            self._try("snapshots", lambda: _write_each(self.folder / "snapshots", iteration, layers))

    def picture(self, problem: Any, latents: Any) -> None:
        """Remember what the first views see now; the scene is left at `latents`."""
        if self.folder is not None:
            problem.apply(latents)
            self._initial = [_look(problem, view) for view in problem.views[:SHOWN]]

    def finish(self, problem: Any, result: Any) -> None:
        """Pictures and final values."""
        if self.folder is None:
            return
        rows = [(view.name, before, _look(problem, view), np.array(view.target))
                for view, before in zip(problem.views[:SHOWN], self._initial, strict=True)]  # fmt: skip
        self._try("result.png", lambda: pictures.write_strip(self.folder / "result.png", rows))
        self._try("curves.png", lambda: pictures.write_curves(self.folder / "curves.png", self._rows))
        self._try("final.npz", lambda: _write_values(self.folder, problem))
        self._try(
            "result.json", lambda: (self.folder / "result.json").write_text(json.dumps(_summary(result), indent=1))
        )

    def _try(self, what: str, write: Callable[[], Any]) -> None:
        if self.folder is None:
            return
        try:
            write()
        except (OSError, RuntimeError, OptionError, CheckpointError) as error:  # RuntimeError: OpenEXR and Mitsuba
            if what not in self.not_written:
                self.not_written.append(what)
                said = f"'{self.folder / what}' was not written: {error}; the optimisation goes on"
                warnings.warn(said, RuntimeWarning, stacklevel=4)


def _rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a log; a last line that was cut off is dropped."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return found


def _look(problem: Any, view: Any) -> np.ndarray:
    with dr.suspend_grad():
        return np.array(problem.integrator.render(problem.scene, view.sensor, seed=SEED, spp=STRIP_SPP))


def _write_each(folder: Path, iteration: int, layers: dict[str, np.ndarray]) -> None:
    for name, layer in layers.items():
        images.write_exr(folder / f"{iteration:06d}_{name}.exr", {name: layer})


def _write_values(folder: Path, problem: Any) -> None:
    """Values by parameter: poses as (4, 4), vertices as (V, 3), everything else in its own shape."""
    np.savez(folder / "final.npz", **{name: _value(name, problem.params[name]) for name in problem.variables})
    for name in problem.variables:
        node = problem.params.properties[name][2]
        if name.endswith(VERTEX_POSITIONS) and isinstance(node, mi.Mesh):
            node.write_ply(str(folder / f"{node.id()}.ply"))


def _value(name: str, value: Any) -> np.ndarray:
    if is_transform(value):
        return np.array(dr.detach(value.matrix)).reshape(4, 4)
    if dr.is_tensor_v(value):
        return np.array(dr.detach(value))
    flat = numbers(value)
    return flat.reshape(-1, 3) if name.endswith(VERTEX_POSITIONS) else flat


def _summary(result: Any) -> dict[str, Any]:
    loss = result.loss if np.isfinite(result.loss) else None
    return {"status": result.status, "iterations": result.iterations, "seconds": result.seconds, "loss": loss,
            "offset": result.offsets, "start_offset": result.start_offsets}  # fmt: skip
