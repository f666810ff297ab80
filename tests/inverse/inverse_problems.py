"""Small optimisations that several tests run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi

from psdr_jit import Parameter, Pose
from psdr_jit.derivative import integrator_specs
from psdr_jit.inverse.problem import Problem, make_problem
from psdr_jit.inverse.settings import Settings
from psdr_jit.inverse.targets import rendered
from psdr_jit.scene import io as scene_io

BOX, LAMP = "blocker.vertex_positions", "lamp.position"
CONFIG = """
scene = "{scene}"
iterations = {iterations}
spp = 4
seed = 7
checkpoint_every = 5
[defaults]
res = 16
[integrator]
max_depth = 2
[[target]]
render = 64
[[variable]]
kind = "pose"
parameter = "blocker.vertex_positions"
learning_rate = 0.02
turn_axes = "y"
turn_rate = 1.0
start_shift = [0.2, 0.0, -0.1]
[[variable]]
kind = "parameter"
parameter = "lamp.intensity.value"
learning_rate = 0.1
lower = 0.5
start_at = 8.0
"""


def scene_of(name: str = "point_shadow", **defaults: Any) -> mi.Scene:
    return scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), **{"res": 16, "max_depth": 2, **defaults})


def target_of(scene: mi.Scene, sensor: int = 0, spp: int = 256) -> Any:
    return rendered(scene, sensor, mi.load_dict({"type": "path", "max_depth": 2}), spp)


def box_and_lamp() -> list[Any]:
    return [
        Pose(BOX, 0.02, turn_rate=1.0, turn_axes="y", start_shift=(0.2, 0, -0.1)),
        Parameter("lamp.intensity.value", 0.1, lower=0.5, start_at=8.0),
    ]


def problem_of(variables: Any = None, loss: Any = "l2", targets: Any = None, **settings: Any) -> Problem:
    scene = scene_of()
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2})
    targets = target_of(scene) if targets is None else targets
    return make_problem(
        scene, variables or box_and_lamp(), targets, loss, integrator, Settings(**{"spp": 4, **settings})
    )


def write_config(folder: Path, iterations: int = 20, **replaced: str) -> Path:
    text = CONFIG.format(scene=scene_io.shipped_scene("point_shadow.xml"), iterations=iterations)
    for old, new in replaced.items():
        text = text.replace(old, new)
    path = folder / "config.toml"
    path.write_text(text, encoding="utf-8")
    return path
