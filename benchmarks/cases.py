"""What is measured: one derivative of a shipped scene per phenomenon. Data only; `scenes/README.md` has the oracles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from benchmarks import meshes
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.scene import io as scene_io

X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
NO_ROULETTE = 100  # a roulette depth beyond every max_depth used here: variances of different methods compare


@dataclass(frozen=True)
class Case:
    """A derivative of a shipped scene, by one of direction, rotate and index, or none for plain values.

    `load`: overrides of the file's `<default>` values. `sensor` of the scene and path lengths are those of `limits`.
    """

    name: str
    scene: str  # file name in scenes/, without .xml
    param: str
    depth: int
    direction: Any = None
    rotate: Any = None
    index: int | None = None
    load: dict = field(default_factory=dict)
    mesh: Callable[[], tuple] | None = None  # vertices and faces of the shape that is differentiated, for the file's

    @property
    def limits(self) -> dict[str, int]:
        """Path lengths that every method gets."""
        return {"max_depth": self.depth, "rr_depth": NO_ROULETTE}

    @property
    def file_stem(self) -> str:
        return self.name.replace(" ", "_").replace(",", "")


SMALL_BOX = "small-box.vertex_positions"
BLOCKER = "blocker.vertex_positions"
CONTACT, FLOATING, SUNK = ({"lift": lift} for lift in (0.0, 0.06, -0.01))  # height of the Cornell box's small box

CASES = (
    # closed forms
    Case("emitter size", "emitter_scale", "square.vertex_positions", 2, (-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0)),
    Case("half-plane", "half_plane", "plane.vertex_positions", 2, X),
    # shadows
    Case("area shadow", "area_shadow", BLOCKER, 2, X),
    Case("moving light", "area_shadow", "light.to_world", 2, X),
    Case("point shadow", "point_shadow", BLOCKER, 2, X),
    Case("spot shadow", "spot_shadow", BLOCKER, 2, X),
    Case("directional shadow", "directional_shadow", "blocker.to_world", 2, X),
    Case("environment light", "environment_shadow", BLOCKER, 3, X),
    Case("many occluders", "many_occluders", "occluders.vertex_positions", 2, X),
    # everything at once
    Case("cbox floating", "cbox", SMALL_BOX, 4, X, load=FLOATING),
    Case("cbox contact", "cbox", SMALL_BOX, 4, X, load=CONTACT),
    Case("cbox sunk", "cbox", SMALL_BOX, 4, X, load=SUNK),
    Case("hidden light", "baffled_light", BLOCKER, 3, X),
    Case("branching", "branching", "tree.vertex_positions", 3, rotate=Y),
    Case("rough glass, IOR", "rough_glass", "ball.bsdf.eta", 5),
    Case("rough glass, spot moved", "rough_glass", "lamp.to_world", 5, X),
    # shapes
    Case("seamed cube", "seamed_cube", "cube.vertex_positions", 2, rotate=(0, 1, 0.3)),
    Case("smooth sphere", "smooth_ball_shadow", BLOCKER, 2, X),
    Case("flat sphere", "faceted_ball", BLOCKER, 3, rotate=(1, 1, 0)),
    # cameras
    Case("camera pose", "area_shadow", "camera.to_world", 2, X),
    Case("thin lens", "thinlens_shadow", BLOCKER, 2, X),
    Case("orthographic", "camera_orthographic", "camera.to_world", 2, X),
    # materials
    Case("glossy reflection", "glossy_floor", BLOCKER, 3, X),
    Case("textured mover", "textured_emitter", "card.vertex_positions", 2, X),
    Case("patterned floor", "patterns", "floor.to_world", 2, X),
    Case("patterned ball", "patterns", "ball.to_world", 2, rotate=(1, 1, 0)),
    Case("smooth ball turned", "smooth_ball_shadow", BLOCKER, 3, rotate=(1, 1, 0)),
    # mirrors, glass, plastic, windows and masks
    Case("two mirrors", "mirrors", BLOCKER, 6, X),
    Case("mirror turned", "mirrors", "mirror.to_world", 3, rotate=X),
    Case("mirror floor", "shiny_floor", BLOCKER, 4, X, load={"floor": "conductor"}),
    Case("plastic floor", "shiny_floor", BLOCKER, 3, X),
    Case("glass ball", "glass", "body.to_world", 6, X),
    Case("glass ball, IOR", "glass", "body.bsdf.eta", 6),
    Case("glass cube", "glass", "body.vertex_positions", 6, rotate=Y, load={"body": "cube"}),
    Case("window", "window", BLOCKER, 4, X),
    Case("mask", "mask_shadow", "sheet.to_world", 3, X),
    Case("reflected light", "reflected_light", "mirror.to_world", 3, rotate=X),
    Case("material only", "cbox", "white.reflectance.value", 4, load=CONTACT),
)
QUICK = ("area shadow", "point shadow", "cbox contact", "material only")


def load(case: Case, res: int, **overrides: Any) -> Perturbation:
    """The case's scene at `res` x `res` pixels, and the curve along which it is differentiated."""
    path = scene_io.shipped_scene(f"{case.scene}.xml")
    scene = scene_io.load_scene(path, **{"res": res, **case.load, **overrides})
    if case.mesh is not None:
        scene = meshes.replaced(scene, case.param.split(".")[0], *case.mesh())
    return perturbed(scene, case)


def perturbed(scene: Any, case: Case) -> Perturbation:
    return perturb(scene, case.param, case.direction, rotate=case.rotate, index=case.index)
