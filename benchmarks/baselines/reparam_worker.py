"""Derivative images by a reparameterised integrator; runs in the environment of Mitsuba 3.4.1, on Python 3.8 or newer.

    python -I reparam_worker.py < request.json

The request is what `reparam.py` sends: the scene as text, the parameter with its value and tangent, and how much to
render. The result is an npz file. Any exit status but 0 comes with a last line on stderr that names the cause.
"""

from __future__ import annotations

import ctypes
import json
import platform
import sys
import time
from typing import Any

import numpy as np

CANNOT_START = 3  # the exit status that says that the backend does not work
VALUE_TOLERANCE = 1e-4  # of the parameter in the two versions, relative to its largest scalar


class RequestError(Exception):
    """This version cannot do what is asked."""


def start(variant: str, preload: list[str]) -> None:
    """Activate the variant and compile a first kernel; end the process where that does not work."""
    try:
        for path in preload:
            ctypes.CDLL(path)
        import mitsuba as mi

        mi.set_variant(variant)
        import drjit as dr

        dr.eval(mi.Float(1) + dr.arange(mi.Float, 2))
        mi.set_log_level(mi.LogLevel.Error)
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        print(one_line(error), file=sys.stderr)
        sys.exit(CANNOT_START)


def load(request: dict[str, Any]) -> Any:
    import mitsuba as mi

    mi.Thread.thread().file_resolver().prepend(request["folder"])
    scene = mi.load_string(request["xml"], **request["load"])
    if not scene.sensors():
        raise RequestError("the scene has no sensor")
    return scene


class Curve:
    """value(theta) = present value + theta * tangent, of one parameter of the scene."""

    def __init__(self, params: Any, name: str, expected: list[float], tangent: list[float]) -> None:
        import drjit as dr

        if name not in params:
            raise RequestError(f"the scene has no parameter '{name}' here; it has {', '.join(params.keys())}")
        base = params[name]
        self.transform = hasattr(base, "inverse_transpose")
        if isinstance(base, (bool, int, float)) or not dr.is_diff_v(base.matrix if self.transform else base):
            raise RequestError(f"parameter '{name}' is a {type(base).__name__}: it carries no derivative here")
        self.params, self.name = params, name
        self.base = dr.detach(base.matrix if self.transform else base)
        own = np.array(self.base, dtype=np.float64).ravel()
        tolerance = VALUE_TOLERANCE * np.abs(own).max(initial=1e-6)
        if own.size != len(expected) or np.abs(own - expected).max(initial=0) > tolerance:
            raise RequestError(f"parameter '{name}' has another value here: this version reads the scene differently")
        self.step = self._like(np.array(tangent, dtype=np.float32))

    def attach(self) -> None:
        """Put the scene at value(0), attached, with the tangent 1 of theta already in the scene."""
        import drjit as dr
        import mitsuba as mi

        theta = mi.Float(0)
        dr.enable_grad(theta)
        value = self.base + self.step * theta
        self.params[self.name] = mi.Transform4f(value) if self.transform else value
        self.params.set_dirty(self.name)
        self.params.update()
        # a tangent set after params.update() would not reach what the scene derived from the parameter
        dr.forward(theta, dr.ADFlag.ClearEdges)

    def _like(self, flat: np.ndarray) -> Any:
        import drjit as dr

        kind = type(self.base)
        if dr.is_tensor_v(self.base):
            return kind(flat.reshape(self.base.shape))
        return kind(flat) if dr.depth_v(kind) == 1 else kind(*flat.tolist())


def measure(request: dict[str, Any], scene: Any) -> tuple[np.ndarray, list[float], float]:
    """Images (K, H, W, C), the seconds of each, and those of the warm-up."""
    import drjit as dr
    import mitsuba as mi

    params = mi.traverse(scene)
    curve = Curve(params, request["param"], request["value"], request["tangent"])
    integrator = mi.load_dict(request["integrator"])
    sensor = scene.sensors()[0]
    images: list[np.ndarray] = []
    seconds: list[float] = []
    warm_up, begin = 0.0, time.perf_counter()
    for k in range(request["warm_up"] + request["max_renders"]):
        curve.attach()
        dr.eval()
        dr.sync_thread()
        start = time.perf_counter()
        image = integrator.render_forward(scene, params, sensor=sensor, seed=request["first_seed"] + k,
                                          spp=request["spp"])  # fmt: skip
        dr.eval(image)
        dr.sync_thread()
        taken = time.perf_counter() - start
        if k < request["warm_up"]:
            warm_up, begin = warm_up + taken, time.perf_counter()
            continue
        seconds.append(taken)
        images.append(np.array(image, dtype=np.float32))
        if len(images) >= request["min_renders"] and time.perf_counter() - begin > request["budget_seconds"]:
            break
    found = np.stack(images)
    return (found if found.ndim == 4 else found[..., None]), seconds, warm_up


def versions() -> dict[str, str]:
    import drjit as dr
    import mitsuba as mi

    llvm = str(dr.llvm_version()) if mi.variant().startswith("llvm") else ""
    return {"python": platform.python_version(), "mitsuba": mi.__version__, "drjit": dr.__version__, "llvm": llvm,
            "variant": mi.variant()}  # fmt: skip


def one_line(error: BaseException) -> str:
    text = str(error).replace("\u200b", "")  # invisible, in front of Mitsuba's messages
    return f"{type(error).__name__}: {' '.join(text.split())}"


def report(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    """Traceback as usual, then the cause in one line."""
    sys.__excepthook__(kind, error, trace)
    print(one_line(error), file=sys.stderr)


def main() -> int:
    sys.excepthook = report
    request = json.load(sys.stdin)
    start(request["variant"], request["preload"])
    images, seconds, warm_up = measure(request, load(request))
    np.savez(request["output"], images=images, seconds=seconds, warm_up_seconds=warm_up,
             versions=json.dumps(versions()))  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
