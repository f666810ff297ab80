"""`prb_reparam`, the reparameterised integrator that Mitsuba lost after 3.4.1, run in an environment of its own.

`environment` makes a virtual environment with that version in the user's cache; `render` runs `reparam_worker.py` in
it and hands back derivative images with their times. The curve is that of a `Perturbation` of this process: only its
value and tangent travel, so both versions differentiate along the same direction.

The integrator refuses a box filter. Whatever it is compared with has to use the scene of `gaussian_scene` as well.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.derivative.perturbation import Perturbation
from psdr_jit.errors import OptionError, PsdrError, SceneError, SetupError
from psdr_jit.scene import io as scene_io
from psdr_jit.scene.params import is_transform
from psdr_jit.setup import llvm

MITSUBA = "3.4.1"  # the last with the reparameterisation
REQUIREMENTS = (f"mitsuba=={MITSUBA}", "numpy<2")
PYTHONS = ("3.12", "3.11", "3.10", "3.9", "3.8")  # the wheels there are
STAMP = "psdr-complete"  # written into the environment when all else is there
WORKER = Path(__file__).with_name("reparam_worker.py")
CANNOT_START = 3  # exit status of the worker where Dr.Jit's backend does not work
INSTALL_SECONDS = 900
PROBE_SECONDS = 60
MESSAGE_LENGTH = 400  # of an error of another process


class BaselineError(PsdrError, RuntimeError):
    """The old Mitsuba does not support what is asked, failed, or took too long."""


@dataclass(frozen=True)
class Request:
    """Derivative images of one scene file along one curve.

    `motion` is a perturbation of that scene under any variant and filter; `load` overrides the file's `<default>`
    values, as in `scene_io.load_scene`. Renders go on until there are `max_renders`, or `min_renders` and
    `budget_seconds` are over; seeds count up from `first_seed`, those of the warm-up included.
    """

    scene: Path
    motion: Perturbation
    integrator: Mapping[str, Any]  # max_depth, rr_depth, hide_emitters, reparam_*; `type` if not prb_reparam
    spp: int
    load: Mapping[str, Any] = field(default_factory=dict)
    first_seed: int = 0
    warm_up: int = 1
    min_renders: int = 4
    max_renders: int = 32
    budget_seconds: float = 30.0
    timeout_seconds: float = 600.0  # for the whole process, with its start and warm-up
    variant: str = scene_io.DEFAULT_VARIANT

    def __post_init__(self) -> None:
        if self.spp < 1 or self.warm_up < 0 or not 1 <= self.min_renders <= self.max_renders:
            raise OptionError(
                f"expected spp >= 1, warm_up >= 0 and 1 <= min_renders <= max_renders, got spp {self.spp}, warm_up "
                f"{self.warm_up}, min_renders {self.min_renders} and max_renders {self.max_renders}"
            )


@dataclass(frozen=True)
class Renders:
    """What the worker measured; not finite values are left as they are."""

    images: np.ndarray  # (K, H, W, C), float32
    seconds: np.ndarray  # (K,), one call of render_forward with its kernels
    warm_up_seconds: float
    versions: dict[str, str]


def render(request: Request) -> Renders:
    """Run the worker; a `PsdrError` says why there is no result."""
    python = environment()
    with tempfile.TemporaryDirectory() as scratch:
        output = Path(scratch) / "renders.npz"
        try:
            message = json.dumps(message_for(request, output))
            done = subprocess.run([python, "-I", WORKER], input=message, capture_output=True, text=True, cwd=scratch,
                                  timeout=request.timeout_seconds, check=False)  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise BaselineError(f"Mitsuba {MITSUBA} was ended after {request.timeout_seconds:g} s") from error
        if done.returncode:
            raise _worker_error(done.returncode, done.stderr)
        with np.load(output) as found:
            return Renders(found["images"], found["seconds"], float(found["warm_up_seconds"]),
                           json.loads(str(found["versions"])))  # fmt: skip


def message_for(request: Request, output: Path) -> dict[str, Any]:
    """The request as the worker reads it: plain values only."""
    text = with_gaussian_filter(request.scene.read_text(encoding="utf-8"))
    value, tangent = value_and_tangent(request.motion)
    message = {k: getattr(request, k) for k in
               ("spp", "first_seed", "warm_up", "min_renders", "max_renders", "budget_seconds", "variant")}  # fmt: skip
    return {
        **message, "xml": text, "folder": str(request.scene.resolve().parent), "load": _overrides(text, request.load),
        "integrator": {"type": "prb_reparam", **request.integrator}, "output": str(output), "preload": _preload(),
        "param": request.motion.name, "value": value.tolist(), "tangent": tangent.tolist(),
    }  # fmt: skip


def _preload() -> list[str]:
    """Libraries that the LLVM of this process needs and the system lacks."""
    choices = [choice for choice in map(llvm.read_choice, (llvm.CHOICE_FILE, llvm.USER_FILE)) if choice is not None]
    return [path for choice in choices if choice.path == os.environ.get(llvm.VARIABLE) for path in choice.preload]


def _worker_error(status: int, stderr: str) -> PsdrError:
    reason = _reason(status, stderr)
    if status < 0 or status == CANNOT_START:
        return SetupError(f"Mitsuba {MITSUBA} does not run here with {llvm.VARIABLE}="
                          f"{os.environ.get(llvm.VARIABLE, '')}: {reason}")  # fmt: skip
    return BaselineError(f"Mitsuba {MITSUBA}: {reason}")


def _reason(status: int, stderr: str) -> str:
    """The last line that a process printed; for one that aborted, what LLVM said."""
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    return llvm.failure_reason(status, stderr) if status < 0 or not lines else lines[-1][:MESSAGE_LENGTH]


def value_and_tangent(motion: Perturbation) -> tuple[np.ndarray, np.ndarray]:
    """The parameter and its derivative along the curve, at theta = 0: flat, matrices row by row."""
    theta = mi.Float(0)
    dr.enable_grad(theta)
    value = motion.curve(theta)
    value = value.matrix if is_transform(value) else value
    dr.forward(theta)
    return tuple(np.array(x, dtype=np.float64).ravel() for x in (dr.detach(value), dr.grad(value)))


def with_gaussian_filter(xml: str) -> str:
    """The scene with every reconstruction filter that is not a Gaussian replaced by one with default width."""
    root = ElementTree.fromstring(xml)
    for node in root.iter("rfilter"):
        if node.get("type") != "gaussian":
            node.clear()
            node.set("type", "gaussian")
    return ElementTree.tostring(root, encoding="unicode")


def gaussian_scene(path: Path, **load: Any) -> Any:
    """The scene that the worker renders, in this process: `scene_io.load_scene` with a Gaussian filter."""
    text = with_gaussian_filter(path.read_text(encoding="utf-8"))
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(str(path.resolve().parent))
    mi.set_file_resolver(resolver)
    try:
        return mi.load_string(text, optimize=False, **_overrides(text, load))
    except RuntimeError as error:
        raise SceneError(f"scene file '{path}' cannot be loaded with a Gaussian filter: {error}") from error
    finally:
        mi.set_file_resolver(before)


def _overrides(xml: str, load: Mapping[str, Any]) -> dict[str, str]:
    """`load` without what `xml` no longer uses, such as the name of the filter: Mitsuba refuses such values."""
    return {name: str(value) for name, value in load.items() if f"${name}" in xml}


def environment() -> Path:
    """The Python of an environment with Mitsuba 3.4.1, which is made on first use (40 MB are fetched)."""
    folder = environment_folder()
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if is_complete(folder) and python.is_file():
        return python
    base = find_python()
    print(f"making an environment for Mitsuba {MITSUBA} in {folder} ...", file=sys.stderr, flush=True)
    try:
        if folder.exists():
            shutil.rmtree(folder)  # half-made, or by an interpreter that is gone
        run_step([base, "-I", "-m", "venv", str(folder)])
        run_step([str(python), "-I", "-m", "pip", "install", "-q", "--no-input", "--disable-pip-version-check",
                  "--only-binary=:all:", *REQUIREMENTS])  # fmt: skip
        (folder / STAMP).write_text("\n".join(REQUIREMENTS), encoding="utf-8")
    except OSError as error:
        raise SetupError(f"no environment for Mitsuba {MITSUBA}: {error}; set XDG_CACHE_HOME to a folder that can be "
                         "written") from error  # fmt: skip
    return python


def environment_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "psdr_jit" / f"mitsuba-{MITSUBA}"


def is_complete(folder: Path) -> bool:
    """Whether the installation into `folder` came to its end, for the present requirements."""
    stamp = folder / STAMP
    return stamp.is_file() and stamp.read_text(encoding="utf-8") == "\n".join(REQUIREMENTS)


def find_python() -> str:
    """An interpreter that Mitsuba 3.4.1 has wheels for, and that can make environments."""
    tried = []
    for name in (sys.executable, *(f"python{version}" for version in PYTHONS)):
        path = shutil.which(name)
        reason = "not on PATH" if path is None else obstacle(path)
        if path is not None and not reason:
            return path
        tried.append(f"{name}: {reason}")
    raise SetupError(f"Mitsuba {MITSUBA} needs Python {PYTHONS[-1]} to {PYTHONS[0]} with venv; put one on PATH "
                     f"({'; '.join(tried)})")  # fmt: skip


def obstacle(python: str) -> str:
    """Why this interpreter does not serve; empty if it does."""
    code = "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"
    try:
        done = subprocess.run([python, "-I", "-c", code], capture_output=True, text=True, timeout=PROBE_SECONDS,
                              check=False)  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode:
        return _reason(done.returncode, done.stderr)
    return "" if done.stdout.strip() in PYTHONS else f"is {done.stdout.strip()}"


def run_step(command: Sequence[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_SECONDS, check=False)
    except subprocess.TimeoutExpired as error:
        raise SetupError(f"no environment for Mitsuba {MITSUBA}: not ready after {INSTALL_SECONDS} s") from error
    if done.returncode:
        reason = _reason(done.returncode, done.stderr or done.stdout)
        raise SetupError(f"no environment for Mitsuba {MITSUBA}: '{' '.join(command)}' failed ({reason})")
