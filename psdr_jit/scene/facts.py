"""What is in a scene, what of it moves, and what carries a gradient: facts as plain data, no judgement.

`checks` judges them, `plan` decides from them which terms exist.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from ..core.compat import VERTEX_NORMALS, VERTEX_POSITIONS, VERTEX_TEXCOORDS
from ..core.memory import Memory
from .capabilities import (
    ANALYTIC_SHAPES,
    CURVE_SHAPES,
    ELLIPSOID_SHAPES,
    GRID_SHAPES,
    INSTANCING,
    UNSUPPORTED_SHAPES,
)
from .delta_lobes import bending, blends_delta, delta_lobes, lobes_not_followed, lost_weights
from .emitter_facts import EmitterFacts, emitter_facts
from .graph import (
    SceneGraph,
    is_black,
    is_cubic,
    is_painted,
    jumping_textures,
    non_finite_vertices,
    plugin_name,
    sees_frame,
)
from .guard import require_derivatives
from .instances import require_codes, shape_groups
from .patterns import missing_on_curves, missing_patterns
from .pose_faults import shape_pose_fault
from .shading_normals import is_shaded_smoothly


@dataclass(frozen=True)
class ShapeFacts:
    """One shape. Parameter tuples name those with gradients enabled; empty means: does not depend on θ."""

    name: str
    index: int  # in scene.shapes(); -1 inside a shape group
    group: str  # id of the shape group that it is in, "" if it is in none
    plugin: str  # as written in XML, for example "obj" or "sphere"
    kind: str  # "mesh", "analytic", "curve", "grid", "ellipsoids", "instance" or "unsupported"
    is_mesh: bool  # has vertex and face buffers; true of "rectangle" as well
    faces: int  # 0 unless is_mesh
    bad_vertices: int  # with NaN or infinite coordinates; 0 while a function is being frozen
    smooth: bool  # shaded with vertex normals that are not those of its faces, or may become others
    has_texcoords: bool
    is_emitter: bool
    has_medium: bool
    pose_fault: str  # why Mitsuba does not render its pose as it says, and the way out; "" if it does
    bsdf: str  # plugin, as written in XML
    bsdf_flags: int  # mi.BSDFFlags
    black: bool  # it scatters nothing
    delta_lobes: tuple[str, ...]  # "dielectric: DeltaReflection", ...
    lost_weights: tuple[str, ...]  # enabled parameters of delta lobes whose derivative is not known, full names
    lost_varies: bool  # such a parameter, enabled or not, varies over the surface
    bends: tuple[str, ...]  # enabled parameters that turn the directions of its delta lobes, full names
    delta_obstacle: str  # why directions cannot be followed through them, "" if they can
    blends_delta: bool  # a "blendbsdf" of a delta lobe and a smooth one
    painted: bool  # a texture of its BSDF or light may differ from point to point
    patterns: tuple[str, ...]  # textures that step inside the surface, "checkerboard 'floor'", ...
    jumps: tuple[str, ...]  # whatever else is discontinuous inside the surface
    sees_frame: bool  # its BSDF depends on how the shading frame is turned about the normal
    geometry: tuple[str, ...]  # parameters that move the surface
    shading: tuple[str, ...]  # vertex normals, texture coordinates and attributes
    material: tuple[str, ...]  # of the BSDF and its textures

    @property
    def moves(self) -> bool:
        """Something of it slides that edges stand for: its surface, or where its normals turn from the viewer."""
        return bool(self.geometry) or (self.smooth and VERTEX_NORMALS in self.shading)

    @property
    def opaque(self) -> bool:
        """No light passes through the surface."""
        return not self.bsdf_flags & int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)


@dataclass(frozen=True)
class SensorFacts:
    """The sensor that is rendered."""

    name: str
    plugin: str  # as written in XML, for example "perspective"
    has_medium: bool
    shutter_open_time: float  # [s]
    pose: tuple[str, ...]  # enabled parameters: pose and intrinsics, neither film nor sampler
    coverage: bool  # its film has an alpha channel


@dataclass(frozen=True)
class SceneFacts:
    """Everything the plan and the checks need to know about one scene and one sensor."""

    variant: str
    polarized: bool
    shapes: tuple[ShapeFacts, ...]
    emitters: tuple[EmitterFacts, ...]
    sensor: SensorFacts
    enabled: tuple[str, ...]  # all parameters with gradients enabled, as `mi.traverse(scene)` names them
    extent: float  # diagonal of the scene's bounding box [scene units], 0 without shapes
    reach: float  # largest coordinate of that box [scene units]
    still: str = ""  # why nothing counts as enabled though gradients are
    places_move: bool = False  # places on the film follow what is seen there, whatever the camera does

    @property
    def anything_enabled(self) -> bool:
        return bool(self.enabled)

    @property
    def camera_moves(self) -> bool:
        return bool(self.sensor.pose)

    @property
    def view_moves(self) -> bool:
        """Camera rays move."""
        return self.camera_moves or self.places_move

    @cached_property
    def shapes_move(self) -> bool:
        return any(shape.moves for shape in self.shapes)

    @cached_property
    def emitters_move(self) -> bool:
        """A light without a shape changes its pose. A moving area light counts as a moving shape."""
        return any(emitter.pose for emitter in self.emitters)

    @cached_property
    def paths_bend(self) -> bool:
        """Directions behind delta lobes turn: an index of refraction depends on θ."""
        return any(shape.bends for shape in self.shapes)

    @cached_property
    def geometry_moves(self) -> bool:
        """Paths and discontinuities may move: a shape, a light's pose, the camera or refraction depends on θ."""
        return self.shapes_move or self.emitters_move or self.camera_moves or self.paths_bend

    @cached_property
    def has_delta_emitters(self) -> bool:
        return any(emitter.delta for emitter in self.emitters)

    @cached_property
    def has_delta_lobes(self) -> bool:
        return any(shape.delta_lobes for shape in self.shapes)

    @cached_property
    def scatters(self) -> bool:
        """Some surface sends light in more directions than its delta lobes have."""
        return any(shape.bsdf_flags & int(mi.BSDFFlags.Smooth) and not shape.black for shape in self.shapes)

    @cached_property
    def has_light_steps(self) -> bool:
        """Some light throws steps of its own on the surfaces: a picture, or a cone with a hard rim."""
        return any(emitter.steps for emitter in self.emitters)

    @cached_property
    def has_infinite_emitters(self) -> bool:
        return any(emitter.infinite for emitter in self.emitters)

    @cached_property
    def has_area_emitters(self) -> bool:
        return any(emitter.shape >= 0 for emitter in self.emitters)

    def __str__(self) -> str:
        def listed(names: tuple[str, ...]) -> str:
            return ", ".join(names) or "-"

        lines = [f"sensor {self.sensor.name} ({self.sensor.plugin}): enabled {listed(self.sensor.pose)}"]
        for s in self.shapes:
            lines.append(
                f"shape {s.name} ({s.plugin}, {s.kind}, {s.faces} faces, {s.bsdf}): geometry "
                f"{listed(s.geometry)}; shading {listed(s.shading)}; material {listed(s.material)}"
            )
        for e in self.emitters:
            lines.append(f"emitter {e.name} ({e.plugin}): pose {listed(e.pose)}; radiance {listed(e.radiance)}")
        return "\n".join(lines)


def analyse(
    scene: mi.Scene, sensor: mi.Sensor | int = 0, counts: Callable[[object], bool] = lambda value: True,
    memory: Memory | None = None,
) -> SceneFacts:  # fmt: skip
    """Collect the facts about `scene` as seen by `sensor` (the sensor itself, or its number).

    `counts(value)`: whether a parameter value with gradients enabled counts as such. Gradients that are merely
    suspended (`dr.suspend_grad`) are enabled. `memory` keeps what meshes have been found to be. Costs milliseconds and
    one synchronisation, so it can be repeated whenever parameters change.
    """
    require_derivatives()
    with dr.resume_grad():
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        graph = SceneGraph(scene, sensor, counts, memory or Memory())
        scene_shapes = list(scene.shapes())
        groups = shape_groups(graph.nodes())
        require_codes([s for s in scene_shapes if plugin_name(s) in INSTANCING], groups)
        places = [(shape, i, "") for i, shape in enumerate(scene_shapes)]
        places += [(shape, -1, name) for name, members in groups.items() for shape in members]
        shapes = [shape for shape, _, _ in places]
        bad_vertices = non_finite_vertices(shapes)
        return SceneFacts(
            variant=mi.variant(),
            polarized=mi.is_polarized,
            shapes=tuple(_shape_facts(graph, *place, bad) for place, bad in zip(places, bad_vertices, strict=True)),
            emitters=tuple(emitter_facts(graph, e, i, shapes) for i, e in enumerate(scene.emitters())),
            sensor=_sensor_facts(graph, sensor),
            enabled=graph.enabled_names(),
            extent=_extent(scene),
            reach=max(map(abs, [*scene.bbox().min, *scene.bbox().max])) if scene.bbox().valid() else 0.0,
        )


def _extent(scene: mi.Scene) -> float:
    box = scene.bbox()
    return math.dist(box.max, box.min) if box.valid() else 0.0


def _shape_facts(graph: SceneGraph, shape: mi.Shape, index: int, group: str, bad_vertices: int) -> ShapeFacts:
    others = (mi.BSDF, mi.Emitter, mi.Sensor, mi.Medium, mi.Shape)  # what is left are texture attributes
    is_mesh, plugin, bsdf = shape.is_mesh(), plugin_name(shape), shape.bsdf()
    enabled = graph.enabled_of(shape)
    shading = tuple(name for name in enabled if _only_shades(name))
    jumps = jumping_textures(graph, bsdf)
    steps = jumps + jumping_textures(graph, shape.emitter())
    weights, varies = lost_weights(graph, bsdf)
    if plugin in INSTANCING:
        kind = "instance"
    elif plugin in GRID_SHAPES and is_cubic(graph, shape):
        kind = "grid"
    elif plugin in ELLIPSOID_SHAPES and not group and not graph.value(shape, "extent_adaptive_clamping"):
        kind = "ellipsoids"
    elif plugin in UNSUPPORTED_SHAPES or (group and plugin in CURVE_SHAPES):
        kind = "unsupported"
    elif plugin in ANALYTIC_SHAPES:
        kind = "analytic"
    elif plugin in CURVE_SHAPES:
        kind = "curve"
    else:  # a shape plugin of somebody else is fine as long as it is made of triangles
        kind = "mesh" if is_mesh else "unsupported"
    missing_of = missing_on_curves if kind == "curve" else missing_patterns
    missing, jumps = missing_of(steps), missing_of(jumps)
    return ShapeFacts(
        name=graph.name(shape, index),
        index=index,
        group=group,
        plugin=plugin,
        kind=kind,
        is_mesh=is_mesh,
        faces=shape.face_count() if is_mesh else 0,
        bad_vertices=bad_vertices,
        smooth=kind == "mesh" and is_shaded_smoothly(shape, graph.memory, enabled),
        has_texcoords=is_mesh and shape.has_vertex_texcoords(),
        is_emitter=shape.is_emitter(),
        has_medium=shape.is_medium_transition(),
        pose_fault=shape_pose_fault(graph, shape, plugin),
        bsdf=plugin_name(bsdf) if bsdf is not None else "none",
        bsdf_flags=bsdf.flags() if bsdf is not None else 0,
        black=is_black(graph, bsdf),
        delta_lobes=delta_lobes(graph, bsdf),
        lost_weights=weights,
        lost_varies=varies,
        bends=bending(graph, bsdf),
        delta_obstacle=lobes_not_followed(graph, bsdf) if delta_lobes(graph, bsdf) else "",
        blends_delta=blends_delta(graph, bsdf),
        painted=is_painted(graph, bsdf) or is_painted(graph, shape.emitter()),
        patterns=tuple(dict.fromkeys(step for step in steps if step not in missing)),
        jumps=jumps,
        sees_frame=sees_frame(graph, bsdf),
        geometry=tuple(name for name in enabled if name not in shading),
        shading=shading + graph.enabled_below(shape, skip=others),
        material=graph.enabled_from(bsdf),
    )


def _only_shades(parameter: str) -> bool:
    """Whether a mesh parameter leaves the surface where it is."""
    attribute = parameter.startswith(("vertex_", "face_")) and parameter != VERTEX_POSITIONS
    return attribute or parameter in (VERTEX_NORMALS, VERTEX_TEXCOORDS)


def _sensor_facts(graph: SceneGraph, sensor: mi.Sensor) -> SensorFacts:
    return SensorFacts(
        name=graph.name(sensor, 0),
        plugin=plugin_name(sensor),
        has_medium=sensor.get_medium() is not None,
        shutter_open_time=float(sensor.shutter_open_time()),
        pose=graph.enabled_of(sensor) + graph.enabled_below(sensor, skip=(mi.Film, mi.Sampler, mi.Medium, mi.Shape)),
        coverage=mi.has_flag(sensor.film().flags(), mi.FilmFlags.Alpha),
    )

