"""What a run leaves on disk: a log, checkpoints, snapshots, pictures, and the final values.

`log.jsonl` has one object per iteration; `checkpoint.npz` the state; `snapshots/` images; `views/` the images before
and after; `result.png` a strip of them; `curves.png` loss and offsets; `final.npz` the values of all variables, meshes
as PLY; `final.xml` the scene, if the problem knows its file, and `final_files/` what that names. All but the
log are written beside and renamed. A full disk does not end a run: what could not be written is warned about, once
each, and named in the result; the final values that are missing are named apart.
"""

from __future__ import annotations

import io
import json
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.core import files
from psdr_jit.core.compat import VERTEX_POSITIONS
from psdr_jit.derivative import images
from psdr_jit.errors import CheckpointError, OptionError, SceneError, StorageError, UnsupportedError, UnsupportedWarning
from psdr_jit.export import assets
from psdr_jit.export.write import write_scene
from psdr_jit.inverse import checkpoint as checkpoints
from psdr_jit.inverse import pictures
from psdr_jit.inverse.observer import Observer, Seen
from psdr_jit.inverse.variables import numbers
from psdr_jit.scene.params import is_transform

#: Views that the final strip shows, and samples per pixel of its images.
SHOWN, STRIP_SPP = 3, 64

FINAL = "final"  # name of the scene file

VIEWS = "views"  # folder with the images of the strip, one per view

SEED = 0x57121B  # of the strip's images


class Journal:
    """Writes into `folder`, or nothing if it is None. `keep`: iterations of an earlier run that stay in the log.

    `observers` see each iteration as well, with a folder or without.
    """

    def __init__(self, folder: Path | None, problem: Any, keep: int, observers: Sequence[Observer] = ()) -> None:
        self.folder = folder
        self._observers = observers
        self.not_written: list[str] = []
        self.lost: dict[str, str] = {}  # files with final values that are missing, and why
        self._rows: list[dict[str, Any]] = []
        self._initial: list[np.ndarray] = []
        self._log: Any = None
        if folder is None:
            return
        try:
            (folder / "snapshots").mkdir(parents=True, exist_ok=True)
            images.check_writable(folder / "log.jsonl")
            self._rows = [row for row in rows_of(folder / "log.jsonl") if row["iteration"] < keep]
            kept = "".join(json.dumps(row) + "\n" for row in self._rows).encode()
            files.write_bytes(folder / "log.jsonl", kept)  # a full disk must not cost the history
            self._log = open(folder / "log.jsonl", "a", encoding="utf-8")  # open as long as the run
        except StorageError:
            raise
        except OSError as error:
            raise files.refusal(folder, error) from error

    def begin(self, problem: Any) -> None:
        """Let observers look at the problem."""
        for observer in self._observers:
            observer.begin(problem)

    @contextmanager
    def closed_after(self, state: Any) -> Iterator[None]:
        """Close when a run of `state` ends, however it does."""
        try:
            yield
        except BaseException as error:
            self.close(state.iteration, error)
            raise
        self.close(state.iteration)

    def close(self, iteration: int = 0, first: BaseException | None = None) -> None:
        """Close the log, then let every observer take a last look; they may be anyone's, and may raise anything.

        Raises `first` if that is why the run ends: it is not to be hidden by what an observer then raises.
        """
        try:
            with ExitStack() as after:
                for observer in reversed(self._observers):
                    after.callback(observer.close, iteration)
                self._close_log()
        finally:
            if first is not None:
                raise first

    def _close_log(self) -> None:
        """One that has nothing in it is removed."""
        if self._log is None:
            return
        self._try("log.jsonl", self._log.close)
        log = self.folder / "log.jsonl"
        if log.is_file() and log.stat().st_size == 0:
            log.unlink()

    def show(self, seen: Seen) -> None:
        """Let observers look at an iteration, while the scene stands where it was in it."""
        for observer in self._observers:
            observer.step(seen)

    def step(self, seen: Seen, seconds: float, problem: Any) -> None:
        """Log an iteration: what was found before its step."""
        loss, norms = seen.loss, seen.norms
        row = {
            "iteration": seen.iteration,
            "loss": loss if np.isfinite(loss) else None,
            "gradient_norm": {name: norm if np.isfinite(norm) else None for name, norm in norms.items()},
            "seconds": seconds,
            "views": problem.chosen(seen.iteration),
            "rate": seen.rate,
            "offset": seen.offsets,
        }
        self._rows.append(row)

        def write() -> None:
            self._log.write(json.dumps(row) + "\n")
            self._log.flush()

        self._try("log.jsonl", write)
        every = problem.settings.snapshot_every
        if every and seen.iteration % every == 0:
            self.snapshot(seen.iteration, problem, seen.images)

    def keep(self, checkpoint: checkpoints.Checkpoint, last: bool = False) -> None:
        """Replace the checkpoint; the `last` one holds what the run has found."""
        write = self.value if last else self._try
        write(checkpoints.NAME, lambda: checkpoints.save(self.folder / checkpoints.NAME, checkpoint))

    def snapshot(self, iteration: int, problem: Any, found: dict[int, np.ndarray]) -> None:
        """The images that the loss has seen, beside their targets."""
        layers = {}
        for k, image in found.items():
            view = problem.views[k]
            layers |= {f"image_{view.name}": image, f"target_{view.name}": np.array(view.target)}
        sizes, aovs = {layer.shape[:2] for layer in layers.values()}, problem.views[0].aovs
        if len(sizes) == 1:  # a file has one size
            path = self.folder / "snapshots" / f"{iteration:06d}.exr" if self.folder else None
            self._try("snapshots", lambda: images.write_exr(path, layers, {"iteration": str(iteration)}, aovs))
        else:
            self._try("snapshots", lambda: _write_each(self.folder / "snapshots", iteration, layers, aovs))

    def picture(self, problem: Any, latents: Any) -> None:
        """Remember what the first views see now; the scene is left at `latents`."""
        if self.folder is not None:
            problem.apply(latents)
            self._initial = [_look(problem, view) for view in problem.views[:SHOWN]]

    def finish(self, problem: Any, result: Any) -> None:
        """Final values, then pictures: the last room on a disk is for what matters."""
        if self.folder is None:
            return
        for name, content in {**_values(problem), "result.json": _summary(result)}.items():
            self.value(name, lambda name=name, content=content: files.write_bytes(self.folder / name, content))
        self._scene(problem)
        rows = [(view.name, before, _look(problem, view), np.array(view.target))
                for view, before in zip(problem.views[:SHOWN], self._initial, strict=True)]  # fmt: skip
        self._try(VIEWS, lambda: _write_views(self.folder / VIEWS, rows, problem.views[0].aovs))
        seen = [(name, *(images.colours(image, problem.views[0].aovs) for image in shown)) for name, *shown in rows]
        self._try("result.png", lambda: pictures.write_strip(self.folder / "result.png", seen))
        self._try("curves.png", lambda: pictures.write_curves(self.folder / "curves.png", self._rows))

    def _scene(self, problem: Any) -> None:
        """The scenes as files; the values are saved already, so a scene that no file can hold is a warning."""
        for part in problem.parts:
            if part.source is not None:
                name = f"{FINAL}_{part.name}.xml" if part.name else f"{FINAL}.xml"
                self._try(name, lambda part=part, name=name: _write_scene(part, self.folder / name))

    def value(self, what: str, write: Callable[[], Any]) -> None:
        """Write something without which the run was in vain."""
        failed = self._try(what, write)
        if failed is not None:
            self.lost[what] = str(failed)

    def _try(self, what: str, write: Callable[[], Any]) -> Exception | None:
        """The error, if there was one."""
        if self.folder is None:
            return None
        try:
            write()
        except (OSError, RuntimeError, OptionError, CheckpointError) as error:  # RuntimeError: OpenEXR and Mitsuba
            if what not in self.not_written:
                self.not_written.append(what)
                named = "" if str(self.folder / what) in str(error) else f"'{self.folder / what}' was not written: "
                warnings.warn(f"{named}{error}; the optimisation goes on", RuntimeWarning, stacklevel=4)
            return error
        return None


def rows_of(path: Path) -> list[dict[str, Any]]:
    """Rows of a log; a last line that was cut off is dropped."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return found


def _write_scene(part: Any, path: Path) -> None:
    try:
        write_scene(part.scene, path, part.source)
    except (UnsupportedError, SceneError) as error:
        said = f"'{path}' was not written, the values are in final.npz: {error}"
        warnings.warn(said, UnsupportedWarning, stacklevel=6)


def _look(problem: Any, view: Any) -> np.ndarray:
    part = problem.parts[view.part]
    with dr.suspend_grad():
        return np.array(part.integrator.render(part.scene, view.sensor, seed=SEED, spp=STRIP_SPP))


def _write_views(folder: Path, rows: list[tuple[str, np.ndarray, np.ndarray, np.ndarray]], aovs: Sequence[str]) -> None:
    folder.mkdir(exist_ok=True)
    for name, initial, final, target in rows:
        layers = {"initial": initial, "final": final, "target": target}
        images.write_exr(folder / (re.sub(r"[^\w.-]", "_", name) + ".exr"), layers, aovs=aovs)


def _write_each(folder: Path, iteration: int, layers: dict[str, np.ndarray], aovs: Sequence[str]) -> None:
    for name, layer in layers.items():
        images.write_exr(folder / f"{iteration:06d}_{name}.exr", {name: layer}, aovs=aovs)


def _values(problem: Any) -> dict[str, bytes]:
    """Files by name: values by parameter (poses (4, 4), vertices (V, 3), the rest in its own shape), and meshes."""
    values, found = {}, {}
    for part in problem.parts:
        for name in (variable.parameter for variable in part.variables.values()):
            values[part.label(name, ":")] = _value(name, part.params[name])
            node = part.params.properties[name][2]
            if name.endswith(VERTEX_POSITIONS) and isinstance(node, mi.Mesh):
                assets.add_file(found, f"{part.label(node.id() or name.rpartition('.')[0])}.ply", assets.mesh(node))
    content = io.BytesIO()
    np.savez(content, **values)
    return {"final.npz": content.getvalue(), **found}


def _value(name: str, value: Any) -> np.ndarray:
    if is_transform(value):
        return np.array(dr.detach(value.matrix)).reshape(4, 4)
    if dr.is_tensor_v(value):
        return np.array(dr.detach(value))
    flat = numbers(value)
    return flat.reshape(-1, 3) if name.endswith(VERTEX_POSITIONS) else flat


def _summary(result: Any) -> bytes:
    loss = result.loss if np.isfinite(result.loss) else None
    found = {"status": result.status, "iterations": result.iterations, "seconds": result.seconds, "loss": loss,
             "offset": result.offsets, "start_offset": result.start_offsets}  # fmt: skip
    return json.dumps(found, indent=1).encode()
