"""Suite `cost`: seconds and memory of one call against samples, resolution, depth, edges and parameters.

One thing grows at a time; the primal `path` runs beside each step. Wall time is what a user waits for; kernel time is
the sum over Dr.Jit's kernel history, and the rest is tracing, launching and the mesh analysis of a call. Memory is the
peak that Dr.Jit allocated while the timed calls ran. `params.update()`, in which Mitsuba rebuilds its acceleration
structure, is not timed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import cases, meshes, methods, rows, sweeps
from benchmarks.cases import BLOCKER, SMALL_BOX, Case, X
from benchmarks.measure import measured
from benchmarks.suites import Settings
from benchmarks.sweeps import Sweep
from psdr_jit.derivative.perturbation import Perturbation

NAME = "cost"
BUDGET = 1.0  # [s]
RES, SPP, DEPTH = 128, 16, 4
WARM_UP, MIN_CALLS, MAX_CALLS = 3, 5, 25
SLOW_CALL, MIN_SLOW_CALLS = 4.0, 1  # [s]; such a call is warm enough after the first
SLOWEST_FIRST_CALL = 20.0  # [s]


@dataclass(frozen=True)
class Step:
    """A case with the size of image and samples, and what is done to the scene before it is rendered."""

    case: Case
    res: int = RES
    spp: int = SPP
    texels: int = 0  # along one side of the texture that is differentiated; 0: no texture


CORNELL = Case("", "cbox", SMALL_BOX, DEPTH, X)
CHANNELS = 3


def of_ball(edges: float) -> Step:
    """A closed mesh of triangles has 3/2 edges a triangle."""
    return Step(Case("", "area_shadow", BLOCKER, 3, X, mesh=partial(meshes.round_ball, round(edges / 1.5))))


def of_texture(parameters: float) -> Step:
    case = Case("", "sliding_texture", "floor.bsdf.reflectance.data", DEPTH)
    return Step(case, texels=max(1, round(np.sqrt(parameters / CHANNELS))))


SWEEPS = (
    Sweep("samples", "spp", (1, 4, 16, 64, 256), lambda n: Step(CORNELL, spp=int(n))),
    Sweep("resolution", "pixels along a side", (32, 64, 128, 256, 512), lambda n: Step(CORNELL, res=int(n))),
    Sweep("depth", "max_depth", (2, 3, 4, 6, 8, 12), lambda n: Step(replace(CORNELL, depth=int(n)))),
    Sweep("edges", "edges of the moving mesh", (1e2, 1e3, 1e4, 1e5, 1e6), of_ball),
    Sweep("parameters", "texture values that are differentiated", (12, 3e2, 3e4, 1e6), of_texture),
)
QUICK, QUICK_STRIDE = ("samples",), 3


@dataclass
class Opened:
    sweep: Sweep
    value: float
    step: Step
    motion: Perturbation
    settings: Settings


def case_names() -> list[str]:
    return sweeps.case_names(SWEEPS)


def quick_case_names() -> list[str]:
    return sweeps.quick_case_names(SWEEPS, QUICK, QUICK_STRIDE)


def open_case(name: str, settings: Settings) -> Opened:
    sweep, value = sweeps.find(SWEEPS, name)
    step = sweep.step(value)
    motion = cases.load(step.case, step.res)
    if step.texels:
        pattern = np.random.default_rng(1).random((step.texels, step.texels, CHANNELS), dtype=np.float32)
        motion.params[motion.name] = mi.TensorXf(pattern)
        motion.params.update()
        motion = cases.perturbed(motion.scene, step.case)
    return Opened(sweep, value, step, motion, settings)


def primal(opened: Opened, integrator: Any) -> Callable[[int], Callable[[], Any]]:
    scene, spp = opened.motion.scene, opened.step.spp
    return lambda seed: lambda: mi.render(scene, integrator=integrator, spp=spp, seed=seed)


def forward(opened: Opened, integrator: Any) -> Callable[[int], Callable[[], Any]]:
    motion, spp = opened.motion, opened.step.spp
    sensor = motion.scene.sensors()[0]

    def prepare(seed: int) -> Callable[[], Any]:
        motion.attach()
        return lambda: integrator.render_forward(motion.scene, motion.params, sensor=sensor, seed=seed, spp=spp)

    return prepare


def backward(opened: Opened, integrator: Any) -> Callable[[int], Callable[[], Any]]:
    """Gradients with respect to every scalar of the parameter; the value is a new one for each call."""
    motion, spp = opened.motion, opened.step.spp
    params, sensor = motion.params, motion.scene.sensors()[0]
    width, height = (int(n) for n in sensor.film().crop_size())
    grad_in = dr.full(mi.TensorXf, 1 / (width * height), (height, width, CHANNELS))
    original = dr.detach(params[motion.name])

    def prepare(seed: int) -> Callable[[], Any]:
        value = type(original)(original)
        dr.enable_grad(value)
        params[motion.name] = value
        params.set_dirty(motion.name)
        params.update()
        dr.eval(grad_in)

        def work() -> Any:
            integrator.render_backward(motion.scene, params, grad_in, sensor=sensor, seed=seed, spp=spp)
            return dr.grad(params[motion.name])

        return work

    return prepare


METHODS = {
    "path (primal)": (primal, {"type": "path"}),
    "psdr_path forward": (forward, {"type": "psdr_path"}),
    "psdr_path backward": (backward, {"type": "psdr_path"}),
    "prb backward": (backward, {"type": "prb"}),
    "prb_projective backward, no guiding": (backward, {"type": "prb_projective", "guiding": "none"}),
}


def method_names(case: str) -> list[str]:
    return list(METHODS)


def measure(opened: Opened, method_name: str) -> dict[str, Any]:
    """The row of one method at one step, without circumstances."""
    make, spec = METHODS[method_name]
    step, case = opened.step, opened.step.case
    row = {
        "bench": NAME, "case": sweeps.case_name(opened.sweep, opened.value), "method": method_name,
        "sweep": opened.sweep.name, "value": opened.value,
        "settings": {"res": step.res, "spp": step.spp, **case.limits, "scene": case.scene, "parameter": case.param,
                     "budget": opened.settings.budget},
    }  # fmt: skip
    try:
        prepare = make(opened, mi.load_dict({**spec, **case.limits}))
        taken, memory = calls(prepare, opened.settings.budget)
    except methods.FAILURES as error:
        return {**row, "status": "cannot", "error": methods.last_line(error)}
    wall, kernel, launches = (np.array(column) for column in zip(*taken, strict=True))
    return {**row, "status": "ok", "seeds": len(taken), "wall_ms": rows.summary(wall),
            "kernel_ms": rows.summary(kernel), "outside_kernels_ms": rows.summary(wall - kernel),
            "launches": float(np.median(launches)), "peak_mib": memory}  # fmt: skip


def calls(prepare: Callable[[int], Callable[[], Any]], budget: float) -> tuple[list[tuple], float]:
    """`measured` of each call in steady state, and the peak of allocated memory [MiB]."""
    taken: list[tuple] = []
    fewest = MIN_CALLS
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for seed in range(WARM_UP):
            wall, _, _ = measured(prepare(seed))
            if wall > 1e3 * SLOWEST_FIRST_CALL:
                raise methods.CannotRenderError(f"one call takes {wall / 1e3:.0f} s")
            if wall > 1e3 * SLOW_CALL:
                fewest = MIN_SLOW_CALLS
                break
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        while len(taken) < fewest or (sum(t[0] for t in taken) < 1e3 * budget and len(taken) < MAX_CALLS):
            taken.append(measured(prepare(WARM_UP + len(taken))))
    return taken, dr.detail.malloc_watermark(backend()) / 2**20


def backend() -> Any:
    return dr.backend_v(mi.Float)
