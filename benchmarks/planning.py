"""Suite `planning`: what the planner saves, which form suits a scene, and what budgets by measured noise are worth.

Three families of cases. `plan: …` compares a lean plan with a full one; `scene: …` compares the forms, and equal
budgets with automatic ones, on every shipped scene with paths of four segments, so that the forms differ; `prb: …`
compares material gradients with Mitsuba's `prb`. The methods of a case take turns, render by render, in one process:
their ratios do not depend on what else the machine does meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks import cases, rows
from benchmarks.cases import BLOCKER, SMALL_BOX, Case, X, Y
from benchmarks.measure import FIRST_SEED, finite
from benchmarks.methods import renders_of
from benchmarks.suites import Settings
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.statistics import block_means
from psdr_jit.errors import PsdrError

NAME = "planning"
BUDGET = 2.0  # [s]
RES, SPP = 64, 16
WARM_UP = 9  # calls: kernels are compiled, and budgets have learned from eight pairs of images
MIN_ROUNDS, MAX_ROUNDS = 16, 64
BLOCK = 8  # [px]
ROUNDING = 1e-5  # of float32 sums in another order, relative to the image
EQUAL = {"sppc": SPP, "sppp": SPP, "sppi": SPP}

ON, OFF = "plan on", "plan off"
PLANS = {ON: {"form": "spatial", **EQUAL}, OFF: {"form": "spatial", "plan": "full", **EQUAL}}
KNOWN = {ON: {**PLANS[ON], "direction": "known"}, OFF: PLANS[OFF]}
EQUAL_BUDGETS, SPATIAL, MATERIAL, AUTO = "spatial, equal budgets", "spatial", "material", "auto"
FORMS = {EQUAL_BUDGETS: {"form": "spatial", **EQUAL}, SPATIAL: {"form": "spatial"}, MATERIAL: {"form": "material"},
         AUTO: {}}  # fmt: skip
OURS, PRB = "psdr_path", "prb"
MATERIALS = {OURS: {}, PRB: {"type": "prb"}}


@dataclass(frozen=True)
class Comparison:
    """One case and the integrators that are compared on it: name -> properties."""

    case: Case
    methods: dict[str, dict[str, Any]] = field(default_factory=dict)


def _plans() -> list[Comparison]:
    found = [
        Case("material", "cbox", "white.reflectance.value", 4),
        Case("texture", "sliding_texture", "floor.bsdf.reflectance.data", 3),
        Case("roughness", "rough_conductor", "ball.bsdf.alpha.value", 4),
        Case("emission", "textured_emitter", "card.emitter.radiance.data", 3),
        Case("convex body", "envmap_rotation", "ball.to_world", 4, X),
        Case("convex mesh", "icosphere", "ball.vertex_positions", 4, rotate=(1, 1, 0)),
        Case("lamp", "point_shadow", "lamp.position", 3, X),
        Case("hidden light", "baffled_light", BLOCKER, 3, X),
        Case("direct light", "cbox", SMALL_BOX, 2, X, load=cases.FLOATING),
        Case("one box moves", "cbox", SMALL_BOX, 4, X, load=cases.FLOATING),
        Case("camera", "cbox", "sensor.to_world", 3, X),
        Case("emission of a room", "cbox", "light.emitter.radiance.value", 4),
        Case("turning sky", "envmap_rotation", "sky.to_world", 3, rotate=Y),
    ]
    known = Case("one vertex, known direction", "many_occluders", "occluders.vertex_positions", 2, index=1)
    return [Comparison(case, PLANS) for case in found] + [Comparison(known, KNOWN)]


def _scenes() -> list[Comparison]:
    """One moving thing per shipped scene."""
    named = {case.scene: case for case in reversed(cases.CASES) if case.name not in ("material only", "cbox sunk")}
    others = {
        "furnace": ("walls.vertex_positions", X), "glowing_sphere": ("ball.to_world", X),
        "camera_thinlens": ("camera.to_world", X), "ball_shadow": ("blocker.to_world", X),
        "camera_crop": ("camera.to_world", X),
        "camera_orthographic_scaled": ("camera.to_world", X), "camera_perspective": ("camera.to_world", X),
        "coloured_emitter": ("card.vertex_positions", X), "concave_corner": ("camera.to_world", X),
        "constant_shadow": (BLOCKER, X), "cylinder_outline": ("tube.to_world", X),
        "directional_light": ("sun.to_world", X), "disk_rim": ("disk.to_world", X),
        "emissive_card": ("card.vertex_positions", X), "emitter_mesh": ("card.vertex_positions", Y),
        "emitter_sphere": ("bulb.to_world", X), "envmap_rotation": ("ball.to_world", X),
        "hidden_emitter": ("card.vertex_positions", X), "icosphere": ("ball.vertex_positions", X),
        "inside_out": ("boxes.vertex_positions", X), "lit_box": ("box.vertex_positions", X),
        "patterns": ("floor.to_world", X), "point_light": ("lamp.position", X),
        "rectangle_moved": ("plate.to_world", X),
        "rough_conductor": ("ball.to_world", X), "rough_dielectric": ("ball.to_world", X),
        "sliding_texture": ("floor.vertex_positions", X), "smooth_mesh": ("ball.vertex_positions", X),
        "sphere_silhouette": ("ball.to_world", X), "spot_light": ("lamp.to_world", Y),
        "stacked_cubes": ("camera.to_world", Y), "stress_shadow": (BLOCKER, X), "sunk_ball": ("ball.to_world", X),
        "sunk_box": ("box.vertex_positions", Y), "three_sheets": ("camera.to_world", X),
        "tube_shadow": ("blocker.to_world", X), "two_sided": ("tent.vertex_positions", X),
    }  # fmt: skip
    found = [Case(scene, scene, param, 4, direction) for scene, (param, direction) in others.items()]
    for scene, c in named.items():
        param, how = c.param, {"direction": c.direction, "rotate": c.rotate, "index": c.index}
        if scene == "rough_glass":
            param, how = "lamp.to_world", {"direction": X}
        found.append(Case(scene, scene, param, 4, load=c.load, **how))
    return [Comparison(case, FORMS) for case in sorted(found, key=lambda case: case.name)]


def _materials() -> list[Comparison]:
    found = [
        Case("reflectance", "cbox", "white.reflectance.value", 4),
        Case("texture", "sliding_texture", "floor.bsdf.reflectance.data", 3),
        Case("roughness", "rough_conductor", "ball.bsdf.alpha.value", 4),
    ]
    return [Comparison(case, MATERIALS) for case in found]


COMPARISONS = {
    f"{family}: {c.case.name}": c
    for family, found in (("plan", _plans()), ("scene", _scenes()), ("prb", _materials())) for c in found
}  # fmt: skip
QUICK = ("plan: material", "plan: convex body", "scene: baffled_light", "prb: reflectance")


@dataclass
class Opened:
    """One comparison, rendered by whoever asks first."""

    name: str
    comparison: Comparison
    settings: Settings
    found: dict[str, dict[str, Any]] = field(default_factory=dict)


def case_names() -> list[str]:
    return list(COMPARISONS)


def quick_case_names() -> list[str]:
    return list(QUICK)


def method_names(case: str) -> list[str]:
    return list(COMPARISONS[case].methods)


def open_case(name: str, settings: Settings) -> Opened:
    return Opened(name, COMPARISONS[name], settings)


def measure(opened: Opened, method: str) -> dict[str, Any]:
    """The row of one method; all methods of the case are rendered together when the first row is asked for."""
    if not opened.found:
        opened.found = _compare(opened)
    return opened.found[method]


def _compare(opened: Opened) -> dict[str, dict[str, Any]]:
    case, methods = opened.comparison.case, opened.comparison.methods
    motion = cases.load(case, RES)
    start = {
        "bench": NAME, "case": opened.name, "family": opened.name.split(":")[0],
        "settings": {"res": RES, "spp": SPP, "scene": case.scene, "parameter": case.param, "motion": motion.label,
                     **case.limits, **case.load, "budget": opened.settings.budget},
    }  # fmt: skip
    built = {
        name: integrator_specs.build({"type": "psdr_path", **case.limits, **options})
        for name, options in methods.items()
    }
    renders = {name: renders_of(integrator, motion, SPP) for name, integrator in built.items()}
    images: dict[str, list] = {name: [] for name in methods}
    seconds: dict[str, list] = {name: [] for name in methods}
    failed: dict[str, str] = {}
    for k in range(WARM_UP + MAX_ROUNDS):
        enough = sum(map(sum, seconds.values())) > opened.settings.budget * len(methods)
        if k >= WARM_UP + MIN_ROUNDS and enough:
            break
        for name in [name for name in methods if name not in failed]:
            try:
                image, took = renders[name](FIRST_SEED + k)
            except PsdrError as error:
                failed[name] = str(error)
                continue
            if k >= WARM_UP:
                images[name].append(image)
                seconds[name].append(took)
    first = next(iter(methods))
    return {
        name: {**start, "method": name, "status": "cannot", "error": failed[name]} if name in failed
        else {**start, "method": name, "status": "ok", **_figures(images, seconds, name, first),
              "plan": _plan_of(built[name])}
        for name in methods
    }  # fmt: skip


def _figures(images: dict[str, list], seconds: dict[str, list], name: str, first: str) -> dict[str, Any]:
    """Time, variance, and the difference from the first method of the case in units of its standard error."""
    mine = finite(np.stack(images[name]), np.array(seconds[name]), 0.0)
    ratio = np.array(seconds[name]) / np.array(seconds[first])
    variance = float(mine.images.var(axis=0, ddof=1).mean())
    row = {
        "renders": len(mine.images), "seconds": rows.summary(mine.seconds), "time_ratio": rows.summary(ratio),
        "variance": variance, "cost": variance * float(np.median(mine.seconds)), "not_finite": mine.not_finite,
        "rms": float(np.sqrt(np.mean(mine.images.mean(0) ** 2))),
    }  # fmt: skip
    if name != first and images[first]:
        row |= _difference(mine.images, np.stack(images[first]))
    return row


def _difference(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """RMS and maximum of the z-scores of pixel blocks, and the relative difference of the images' means."""
    # methods share random numbers: the error is that of the difference, render by render
    blocks = np.stack([block_means(x - y, BLOCK) for x, y in zip(a, b, strict=True)])
    error = blocks.std(axis=0, ddof=1) / np.sqrt(len(blocks))
    scale = np.sqrt(np.mean(b.mean(0) ** 2))
    seen = error > 0
    z = blocks.mean(0)[seen] / np.maximum(error[seen], ROUNDING * scale)
    largest = float(np.abs(blocks.mean(0)).max() / scale) if scale > 0 else 0.0
    rms = float(np.sqrt(np.mean(z**2))) if z.size else 0.0
    return {"rms_z": rms, "max_z": float(np.abs(z).max()) if z.size else 0.0, "largest_difference": largest}


def _plan_of(integrator: Any) -> dict[str, Any] | None:
    plan = getattr(integrator, "plan", None)
    if plan is None:
        return None
    return {"form": plan.form, "reason": plan.form_reason, "spp": {t.name: t.spp for t in plan.running}}
