"""Suite `inverse`: the optimisations of `scenes/inverse`, from their own start and from two random ones.

A row tells how far the variables are from the truth at the start and at the end, beside what counts as solved. The peer
runs the same loop with the same settings for the time that ours took; its learning rates decay over as many iterations
as fit into it. Cases `overhead: …` take the time of an iteration apart, at 256 x 256 pixels and 16 samples per pixel.
"""

from __future__ import annotations

import shutil
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import rows
from benchmarks.distances import chamfer
from benchmarks.inverse_pictures import write_section
from benchmarks.inverse_tables import CAMERA_PATHS, OURS, OVERHEAD, PEER
from benchmarks.suites import Settings
from psdr_jit.derivative import integrator_specs
from psdr_jit.errors import PsdrError
from psdr_jit.inverse import config, loop
from psdr_jit.inverse.targets import rendered
from psdr_jit.inverse.variables import rms

NAME = "inverse"
BUDGET = 600.0  # [s] longest run
FOLDER = rows.ROOT / "scenes" / "inverse"
STARTS = {"": None, ", start 1": 1, ", start 2": 2}
TRIAL = 3  # iterations of the peer that tell its speed, the first not counted
FEWEST = 3  # iterations that the peer gets at least
OVERHEAD_RES, OVERHEAD_SPP, OVERHEAD_WARM_UP, OVERHEAD_ITERATIONS = 256, 16, 3, 12


@dataclass(frozen=True)
class Example:
    """`figures(problem, latents)`: what is measured, by name with unit; `limits`: below which it is solved.

    A limit is a number, or a function of the figure at the start.
    """

    file: str
    figures: Callable[[Any, Any], dict[str, float]]
    limits: dict[str, Callable[[float], float]]


def below(value: float) -> Callable[[float], float]:
    return lambda start: value


def tenth(start: float) -> float:
    return start / 10


def offset(parameter: str, kind: str, size: float = 1.0) -> Callable[[Any, Any], float]:
    return lambda problem, latents: problem.offsets(latents)[parameter][kind] / size


def named(**figures: Callable[[Any, Any], float]) -> Callable[[Any, Any], dict[str, float]]:
    return lambda problem, latents: {name: figure(problem, latents) for name, figure in figures.items()}


def distance_to_knob(problem: Any, latents: Any) -> float:
    """Chamfer distance of the body to the mesh that the targets show."""
    body = problem.params.properties["body.vertex_positions"][2]
    positions = np.array(problem.variables["body.vertex_positions"].value(latents["body.vertex_positions"]))
    faces = np.array(mi.traverse(body)["faces"]).reshape(-1, 3)
    knob = mi.traverse(mi.load_dict({"type": "ply", "filename": str(FOLDER.parent / "meshes" / "knob.ply")}))
    other = np.array(knob["vertex_positions"]).reshape(-1, 3), np.array(knob["faces"]).reshape(-1, 3)
    return chamfer((positions.reshape(-1, 3), faces), other)


def caustic_error(problem: Any, latents: Any) -> float:
    """Root mean square of what the image with its caustics, which few integrators show, lacks of the target."""
    problem.apply(latents)
    spec = {"type": "psdr_bdpt", "max_depth": integrator_specs.path_options(problem.integrator)["max_depth"]}
    seen = problem.views[0]
    image = rendered(problem.scene, seen.sensor, integrator_specs.build(spec), CAUSTIC_SPP)
    return rms(image - np.array(seen.target))


CAUSTIC_SPP = 2048  # of its picture, whose noise is far below what counts as solved
CAMERA, LAMP, BLOCKER = "camera.to_world", "lamp.position", "blocker.vertex_positions"
BOX, BALL, IOR = "box.vertex_positions", "ball.to_world", "ball.bsdf.eta"
CAMERA_SIZE = 4.3  # [units] from the camera to the middle of the boxes
SHADOW_SIZE = 3.0  # [units] from the lamp to the floor
SPOT, CAUSTIC_SIZE = "lamp.to_world", 3.3  # [units] from the spotlight to the floor
LEFT, RIGHT, BRIGHTNESS = "left:lamp.intensity.value", "right:lamp.intensity.value", 10.0
MIRROR_SIZE = 3.0  # [units] from the mirror to the end of what it shows



def of_glass_and_spot(file: str) -> Example:
    figures = named(ior=offset(IOR, "rms"), spot=offset(SPOT, "distance", CAUSTIC_SIZE))
    return Example(file, figures, {"ior": below(0.01), "spot": below(0.01)})


EXAMPLES = {
    "rotation": Example(
        "rotation", named(angle_degrees=offset("tree.vertex_positions", "angle_degrees")), {"angle_degrees": below(0.1)}
    ),
    "profile": Example("profile", named(rms=offset("prism.vertex_positions", "rms")), {"rms": tenth}),
    "camera": Example(
        "camera",
        named(angle_degrees=offset(CAMERA, "angle_degrees"), distance=offset(CAMERA, "distance", CAMERA_SIZE)),
        {"angle_degrees": below(0.2), "distance": below(0.005)},
    ),
    "reconstruction": Example("reconstruction", named(chamfer=distance_to_knob), {"chamfer": tenth}),
    "shadow": Example(
        "shadow",
        named(lamp=offset(LAMP, "distance", SHADOW_SIZE), blocker=offset(BLOCKER, "distance", SHADOW_SIZE)),
        {"lamp": below(0.01), "blocker": below(0.01)},
    ),
    "mirror": Example(
        "mirror",
        named(angle_degrees=offset(BOX, "angle_degrees"), distance=offset(BOX, "distance", MIRROR_SIZE)),
        {"angle_degrees": below(0.5), "distance": below(0.005)},
    ),
    "glass": Example(
        "glass",
        named(ior=offset(IOR, "rms"), distance=offset(BALL, "distance")),
        {"ior": below(0.01), "distance": below(0.01)},
    ),
    "caustic": of_glass_and_spot("caustic"),
    "smooth_caustic": of_glass_and_spot("smooth_caustic"),
    "lens": Example("lens", named(caustic=caustic_error), {"caustic": tenth}),
    "lamps": Example(
        "lamps",
        named(distance=offset(BLOCKER, "distance", SHADOW_SIZE), angle_degrees=offset(BLOCKER, "angle_degrees"),
              left=offset(LEFT, "rms", BRIGHTNESS), right=offset(RIGHT, "rms", BRIGHTNESS)),
        {"distance": below(0.01), "angle_degrees": below(0.5), "left": below(0.01), "right": below(0.01)},
    ),
}


@dataclass(frozen=True)
class Opened:
    """One example and start."""

    name: str
    example: Example
    config: config.Config
    settings: Settings


def case_names() -> list[str]:
    return [*(name + start for name in EXAMPLES for start in STARTS), *(OVERHEAD + name for name in EXAMPLES)]


def quick_case_names() -> list[str]:
    return []


def method_names(case: str) -> list[str]:
    if case.startswith(OVERHEAD):
        return [OURS]
    return [OURS, PEER, CAMERA_PATHS] if case.startswith("caustic") else [OURS, PEER]


def open_case(name: str, settings: Settings) -> Opened:
    if name.startswith(OVERHEAD):
        example = EXAMPLES[name.removeprefix(OVERHEAD)]
        found = config.read(FOLDER / f"{example.file}.toml", spp=OVERHEAD_SPP, snapshot_every=0)
        targets = tuple({**target, "render": 1} for target in found.targets)
        return Opened(name, example, replace(found, targets=targets, defaults={**found.defaults, "res": OVERHEAD_RES}),
                      settings)  # fmt: skip
    example, _, start = name.partition(",")
    perturb = STARTS["," + start if start else ""]
    found = config.read(FOLDER / f"{EXAMPLES[example].file}.toml", max_seconds=settings.budget)
    found = replace(found, settings=replace(found.settings, perturb=perturb))
    return Opened(name, EXAMPLES[example], found, settings)


def measure(opened: Opened, method_name: str) -> dict[str, Any]:
    """The row of one run, without circumstances."""
    row = {"bench": NAME, "case": opened.name, "method": method_name, "family": opened.example.file}
    if opened.name.startswith(OVERHEAD):
        return {**row, **iteration_times(opened)}
    try:
        chosen = opened.config if method_name == OURS else peer_of(opened, method_name)
        found, folder = run(opened, chosen)
    except (PsdrError, RuntimeError, TypeError) as error:
        return {**row, "settings": {}, "status": "cannot", "error": f"{type(error).__name__}: {str(error)[:200]}"}
    if method_name == OURS and opened.config.settings.perturb is None:
        keep_pictures(opened, folder)
    shutil.rmtree(folder)
    return {**row, **found}


def peer_of(opened: Opened, method_name: str) -> config.Config:
    """Another integrator with as many iterations as fit into our time."""
    stored = rows.read([opened.settings.folder / f"{NAME}.jsonl"])
    ours = [r for r in stored if r["case"] == opened.name and r["method"] == OURS and r["status"] == "ok"]
    if not ours:
        raise PsdrError(f"there is no row of {OURS} whose time could be given to {method_name}")
    seconds = ours[-1]["seconds"]
    chosen = config.with_integrator(opened.config, "psdr_path" if method_name == CAMERA_PATHS else PEER)
    if method_name == PEER:
        chosen = replace(chosen, integrator={**chosen.integrator, "guiding": "none"})
    problem = config.problem_of(replace(chosen, settings=replace(chosen.settings, iterations=TRIAL, max_seconds=None)))
    times: list[float] = [time.perf_counter()]
    loop.run(problem, progress=lambda *_: times.append(time.perf_counter()))
    each = float(np.median(np.diff(times)[1:]))
    count = max(FEWEST, min(chosen.settings.iterations, int(seconds / each)))
    return replace(chosen, settings=replace(chosen.settings, iterations=count, max_seconds=None))


def run(opened: Opened, chosen: config.Config) -> tuple[dict[str, Any], Path]:
    """Figures before and after, and the folder with the pictures."""
    problem = config.problem_of(chosen)
    figures = opened.example.figures
    before = figures(problem, problem.start())
    folder = Path(tempfile.mkdtemp(prefix="psdr-inverse-"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = loop.run(problem, folder)
    after = figures(problem, result.latents)
    if opened.example.file == "profile":
        write_section(folder / "section.png", problem, problem.start(), result.latents)
    limits = {name: limit(before[name]) for name, limit in opened.example.limits.items()}
    return {
        "settings": {"iterations": chosen.settings.iterations, "spp": chosen.settings.spp,
                     "perturb": chosen.settings.perturb, "integrator": dict(chosen.integrator)},
        "status": "ok", "ended": result.status, "seeds": 1, "seconds": result.seconds, "iterations": result.iterations,
        "loss": result.loss, "before": before, "after": after, "limits": limits,
        "solved": all(after[name] < limit for name, limit in limits.items()),
    }, folder  # fmt: skip


def iteration_times(opened: Opened) -> dict[str, Any]:
    """Milliseconds of an iteration, of its kernels, and what is left: Python, tracing, launching."""
    problem = config.problem_of(opened.config)
    stepper = loop.Stepper(problem)
    wall, kernels, launches = [], [], []
    for k in range(OVERHEAD_WARM_UP + OVERHEAD_ITERATIONS):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            start = time.perf_counter()
            stepper.step()
            dr.sync_thread()
            seconds = time.perf_counter() - start
            history = dr.kernel_history()
        if k >= OVERHEAD_WARM_UP:
            wall.append(1e3 * seconds)
            kernels.append(sum(entry["execution_time"] for entry in history))
            launches.append(len(history))
    outside = np.array(wall) - np.array(kernels)
    return {
        "settings": {"res": OVERHEAD_RES, "spp": OVERHEAD_SPP, "views": len(problem.chosen(0))}, "status": "ok",
        "seeds": OVERHEAD_ITERATIONS, "wall_ms": rows.summary(wall), "kernel_ms": rows.summary(kernels),
        "outside_kernels_ms": rows.summary(outside), "outside_share": rows.summary(outside / wall),
        "launches": float(np.median(launches)),
    }  # fmt: skip


def keep_pictures(opened: Opened, folder: Path) -> None:
    """The strip of images of a run from the example's own start."""
    into = opened.settings.folder / NAME
    into.mkdir(parents=True, exist_ok=True)
    for name in ("result", "curves", "section"):
        if (folder / f"{name}.png").is_file():
            shutil.copyfile(folder / f"{name}.png", into / f"{opened.example.file}_{name}.png")
