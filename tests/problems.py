"""One record per phenomenon: scene file, parameter, direction, and how finite differences are taken of it.

Steps are chosen so that no edge crosses the corner of a pixel block on its way: there an image has a kink, and its
central difference is not its derivative.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)


@dataclass(frozen=True)
class Problem:
    """A derivative that can be checked. Exactly one of direction, rotate and index, or none for plain values."""

    scene: str  # file name in scenes/, without .xml
    param: str
    eps: float  # half step of finite differences, in units of the direction
    direction: Any = None
    rotate: Any = None
    index: int | None = None
    load: dict = field(default_factory=dict)  # overrides of the scene file's <default> values
    options: dict = field(default_factory=dict)  # of the integrators on both sides
    slow: bool = False  # not in the default suite: takes long, or other problems there have its terms and shapes
    fd_samples: int = 1  # of the thorough run's finite differences, by comparison
    tag: str = ""  # tells apart problems of one scene and parameter

    @property
    def id(self) -> str:
        motion = self.tag or ("rotate" if self.rotate else "move" if self.direction else "value")
        return f"{self.scene}-{self.param}-{motion}"

    @property
    def how(self) -> dict:
        """Keyword arguments of `psdr_jit.perturbation.perturb`."""
        return {"direction": self.direction, "rotate": self.rotate, "index": self.index}


GAUSSIAN = {"rfilter": "gaussian"}
RGBA = {"pixel_format": "rgba"}
HIDDEN = {"hide_emitters": True}
DEPTH_3 = {"max_depth": 3}

PROBLEMS = (
    # light that moves or changes
    Problem("textured_emitter", "card.vertex_positions", 0.004, direction=X, slow=True),
    Problem("textured_emitter", "card.vertex_positions", 0.004, rotate=(0, 1, 1), slow=True),
    Problem("textured_emitter", "card.emitter.radiance.data", 0.01),
    Problem("textured_emitter", "card.vertex_texcoords", 0.003),
    Problem("coloured_emitter", "card.vertex_color", 0.01),
    Problem("coloured_emitter", "card.vertex_positions", 0.004, direction=X, slow=True),
    Problem("emitter_sphere", "bulb.to_world", 0.002, direction=X, slow=True),
    Problem("emitter_sphere", "bulb.to_world", 0.002, direction=Y, slow=True),
    Problem("emitter_mesh", "card.vertex_positions", 0.005, direction=Y, slow=True),
    Problem("emitter_mesh", "card.vertex_positions", 0.005, rotate=(1, 1, 0), slow=True),
    Problem("emitter_mesh", "card.vertex_positions", 0.005, index=1, tag="stretch", slow=True),
    Problem("point_light", "lamp.position", 0.006, direction=X),
    Problem("spot_light", "lamp.to_world", 0.004, rotate=X, slow=True),
    Problem("spot_light", "lamp.to_world", 0.004, direction=Y, slow=True),
    Problem("directional_light", "sun.to_world", 0.004, rotate=Y),
    Problem("envmap_rotation", "sky.to_world", 0.004, rotate=Y),
    # shapes that move
    Problem("lit_box", "box.vertex_positions", 0.005, rotate=Y),
    Problem("lit_box", "box.vertex_positions", 0.006, direction=X, slow=True),
    Problem("lit_box", "light.to_world", 0.02, direction=X),
    Problem("seamed_cube", "cube.vertex_positions", 0.005, rotate=(0, 1, 0.3), slow=True),
    Problem("seamed_cube", "cube.vertex_positions", 0.005, direction=X, slow=True),
    Problem("seamed_cube", "cube.vertex_positions", 0.005, rotate=Z, load=GAUSSIAN, tag="gaussian", slow=True),
    Problem("emissive_card", "card.vertex_positions", 0.004, rotate=Z, slow=True),
    Problem("sphere_silhouette", "ball.to_world", 0.006, direction=X),
    Problem("sphere_silhouette", "ball.to_world", 0.006, direction=Z, slow=True),
    Problem("envmap_rotation", "ball.to_world", 0.006, direction=X, slow=True),
    Problem("disk_rim", "disk.to_world", 0.005, rotate=Y),
    Problem("cylinder_outline", "tube.to_world", 0.002, rotate=X, slow=True),
    Problem("cylinder_outline", "tube.to_world", 0.005, direction=Z),
    Problem("rectangle_moved", "plate.to_world", 0.005, rotate=(1, 1, 0), slow=True),
    Problem("sliding_texture", "floor.vertex_positions", 0.005, direction=X),
    Problem("icosphere", "ball.vertex_positions", 0.004, rotate=(1, 1, 0)),
    Problem("smooth_mesh", "ball.vertex_positions", 0.005, direction=X, slow=True),
    Problem("two_sided", "tent.vertex_positions", 0.005, rotate=Y, slow=True),
    # cameras
    Problem("camera_perspective", "camera.to_world", 0.001, rotate=Y, slow=True),
    Problem("camera_perspective", "camera.to_world", 0.004, direction=Z, slow=True),
    Problem("camera_perspective", "camera.x_fov", 0.05, slow=True),
    Problem("camera_perspective", "camera.principal_point_offset_x", 0.0005, slow=True),
    Problem("camera_orthographic", "camera.to_world", 0.005, direction=X, slow=True),
    Problem("camera_orthographic", "camera.to_world", 0.0005, rotate=Y, slow=True),
    Problem("camera_thinlens", "camera.to_world", 0.004, direction=X, slow=True),
    Problem("camera_thinlens", "camera.focus_distance", 0.05, slow=True),
    Problem("camera_thinlens", "camera.aperture_radius", 0.01, slow=True),
    Problem("camera_crop", "camera.to_world", 0.0003, rotate=Y, slow=True),
    Problem(
        "camera_crop", "camera.principal_point_offset_x", 0.0005,
        load={"rfilter": "gaussian", "sample_border": "true"}, tag="gaussian-border", slow=True,
    ),  # fmt: skip
    Problem("camera_orthographic_scaled", "camera.to_world", 0.005, direction=X, slow=True),
    # materials
    Problem("sliding_texture", "floor.bsdf.reflectance.data", 0.01),
    Problem("rough_conductor", "ball.bsdf.alpha.value", 0.004),
    Problem("rough_conductor", "ball.to_world", 0.006, direction=X, slow=True),
    Problem("rough_dielectric", "ball.bsdf.alpha.value", 0.004, slow=True),
    Problem("rough_dielectric", "ball.to_world", 0.006, direction=X, slow=True),
    # films and options
    Problem("disk_rim", "disk.to_world", 0.002, direction=X, load=RGBA, tag="alpha-environment"),
    Problem("textured_emitter", "card.vertex_positions", 0.004, direction=X, load=RGBA, tag="alpha", slow=True),
    Problem("hidden_emitter", "card.vertex_positions", 0.005, direction=X, load=RGBA, options=HIDDEN, slow=True),
    # edges in contact
    Problem("concave_corner", "camera.to_world", 0.002, direction=X, slow=True),
    Problem("stacked_cubes", "camera.to_world", 0.0006, direction=Y, slow=True),
    Problem("three_sheets", "camera.to_world", 0.002, direction=X),
    Problem("inside_out", "boxes.vertex_positions", 0.004, rotate=Z, slow=True),
    # shadows, and what surfaces see of each other
    Problem("area_shadow", "blocker.vertex_positions", 0.004, direction=X),
    Problem("area_shadow", "light.to_world", 0.01, direction=X, slow=True),
    Problem("area_shadow", "floor.to_world", 0.005, direction=Y, slow=True),
    Problem("area_shadow", "camera.to_world", 0.004, direction=X),
    Problem("area_shadow", "blocker.vertex_positions", 0.004, direction=X, load=DEPTH_3, tag="indirect", slow=True),
    Problem("point_shadow", "blocker.vertex_positions", 0.003, direction=X),
    Problem("point_shadow", "lamp.position", 0.004, direction=X, slow=True),
    Problem("directional_shadow", "blocker.to_world", 0.003, direction=X, slow=True),
    Problem("directional_shadow", "sun.to_world", 0.002, rotate=Z, slow=True),
    Problem("ball_shadow", "blocker.to_world", 0.004, direction=X, slow=True),
    Problem("ball_shadow", "blocker.to_world", 0.004, direction=X, load=DEPTH_3, tag="indirect", slow=True),
    Problem("spot_shadow", "blocker.vertex_positions", 0.003, direction=X, slow=True),
    Problem("tube_shadow", "blocker.to_world", 0.004, direction=X, slow=True),
    Problem("curve_shadow", "blocker.control_points", 0.004, direction=Y, load=GAUSSIAN, slow=True),
    Problem("curve_shadow", "blocker.control_points", 0.004, direction=X, load=DEPTH_3, tag="indirect", slow=True),
    Problem("curve_shadow", "blocker.control_points", 0.004, index=10, load=DEPTH_3, tag="bent", slow=True),
    Problem("curve_shadow", "blocker.control_points", 0.004, index=7, load=GAUSSIAN, tag="swollen", slow=True),
    Problem("curve_shadow", "camera.to_world", 0.004, direction=X, load=DEPTH_3 | GAUSSIAN, slow=True),
    Problem("curve_shadow", "light.to_world", 0.01, direction=X, slow=True),
    Problem("rod_shadow", "blocker.control_points", 0.004, direction=Y, load=GAUSSIAN, slow=True),
    Problem("rod_shadow", "blocker.control_points", 0.004, index=5, load=DEPTH_3, tag="bent", slow=True),
    Problem("rod_shadow", "blocker.control_points", 0.004, index=7, load=GAUSSIAN, tag="swollen", slow=True),
    Problem("rod_shadow", "camera.to_world", 0.004, direction=X, load=DEPTH_3 | GAUSSIAN, slow=True),
    Problem("rod_shadow", "light.to_world", 0.01, direction=X, slow=True),
    Problem("ellipsoids_shadow", "blocker.data", 0.004, index=1, load=GAUSSIAN, tag="moved", slow=True),
    Problem("ellipsoids_shadow", "blocker.data", 0.004, index=18, load=DEPTH_3, tag="turned", slow=True),
    Problem("ellipsoids_shadow", "camera.to_world", 0.004, direction=X, load=DEPTH_3 | GAUSSIAN, slow=True),
    Problem("ellipsoids_shadow", "light.to_world", 0.01, direction=X, slow=True),
    Problem("grid_shadow", "blocker.to_world", 0.004, direction=Y, load=GAUSSIAN, slow=True),
    Problem("grid_shadow", "blocker.to_world", 0.004, direction=X, load=DEPTH_3 | GAUSSIAN, tag="indirect", slow=True),
    Problem("grid_shadow", "blocker.grid", 0.004, load=GAUSSIAN, slow=True),
    Problem("grid_shadow", "camera.to_world", 0.004, direction=X, load=DEPTH_3 | GAUSSIAN, slow=True),
    Problem("grid_shadow", "light.to_world", 0.01, direction=X, slow=True),
    Problem("thinlens_shadow", "blocker.vertex_positions", 0.004, direction=X, slow=True),
    Problem("environment_shadow", "blocker.vertex_positions", 0.006, direction=X, slow=True),
    Problem("constant_shadow", "blocker.vertex_positions", 0.006, direction=X, slow=True),
    Problem("faceted_ball", "blocker.vertex_positions", 0.004, rotate=(1, 1, 0), slow=True, fd_samples=8),
    Problem("faceted_ball", "blocker.vertex_positions", 0.004, direction=X, slow=True),
    Problem("smooth_ball_shadow", "blocker.vertex_positions", 0.005, direction=X, slow=True),
    Problem("glossy_floor", "blocker.vertex_positions", 0.005, direction=X, slow=True),
    Problem("baffled_light", "blocker.vertex_positions", 0.005, direction=X, slow=True, fd_samples=6),
    Problem("cbox", "small-box.vertex_positions", 0.005, direction=X, load={"res": 32, "max_depth": 3}, slow=True),
    # leaves and boxes about a pixel wide: a larger step would take their corners across the borders of pixels
    Problem("branching", "tree.vertex_positions", 0.001, rotate=Y, load={"res": 64}, slow=True),
    Problem("many_occluders", "occluders.vertex_positions", 0.002, direction=X, slow=True),
    # longer paths through rough glass are too noisy for this comparison
    Problem("rough_glass", "ball.bsdf.eta", 0.015, load=DEPTH_3, slow=True),
    Problem("rough_glass", "lamp.to_world", 0.004, direction=X, load=DEPTH_3, slow=True),
    # steps inside surfaces
    Problem("patterns", "floor.to_world", 0.004, direction=X, slow=True),
    Problem("patterns", "ball.to_world", 0.004, rotate=(1, 1, 0), slow=True),
    Problem("patterns", "camera.to_world", 0.0005, rotate=Y, slow=True),
    Problem("painted_curves", "camera.to_world", 0.004, direction=X, load=DEPTH_3 | GAUSSIAN, slow=True),
    Problem("painted_curves", "spline.control_points", 0.004, direction=(1, 1, 0), load=GAUSSIAN, slow=True),
    Problem("painted_curves", "rods.control_points", 0.004, direction=X, load=DEPTH_3 | GAUSSIAN, slow=True),
    Problem("painted_curves", "rods.control_points", 0.004, index=5, load=GAUSSIAN, tag="bent", slow=True),
    # shapes that cut into each other
    Problem("sunk_box", "box.vertex_positions", 0.003, direction=Y),
    Problem("sunk_box", "box.vertex_positions", 0.003, direction=X, slow=True),
    Problem("sunk_ball", "ball.to_world", 0.005, direction=X, slow=True),
    Problem("sunk_ball", "floor.to_world", 0.005, direction=Y, slow=True),
    Problem("cbox", "small-box.vertex_positions", 0.005, direction=X, load={"res": 32, "max_depth": 3, "lift": -0.05},
            tag="sunk", slow=True),
)  # fmt: skip


def named(scene: str, param: str, tag: str = "") -> Problem:
    """The first problem of this scene and parameter."""
    return next(p for p in PROBLEMS if (p.scene, p.param) == (scene, param) and tag in p.id)
