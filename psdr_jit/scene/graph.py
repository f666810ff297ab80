"""Finding out what a loaded scene does not say by itself: who owns what, which textures jump, what is hard.

Mitsuba keeps no record of the properties a plugin was made from. What traversal shows is read from there; the
rest is probed on the object, without tracing a ray.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import positions_buffer
from ..core.joining import joined
from ..core.memory import Memory
from .capabilities import FRAME_FREE_PLUGINS, JUMPING_PLUGINS
from .names import plugin_name, traverse
from .params import parameter_value

HARD_RIM, THIN_RIM = 1e-6, 1e-3
"""A spot's rim, relative to its cone: narrower than the first, by rounding alone, it is a step; narrower than the
second, few samples meet it."""


class SceneGraph:
    """The objects of a scene and a sensor, with those of their parameters that have gradients enabled.

    `mi.traverse` visits a shared object once and under one name; here every owner finds it.
    """

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor, counts: Callable[[object], bool], memory: Memory):
        """`counts(value)`: does this parameter value, whose gradients are enabled, count as such? `memory`: of whoever
        asks, for what takes long to find out."""
        self._counts = counts
        self.memory = memory
        params = traverse(scene)
        self._nodes = list(params.hierarchy)  # keeps the nodes, and with them their ids, alive
        self._values: dict[int, dict[str, object]] = {}  # id(node) -> parameter -> value
        self._enabled: dict[str, int] = {}  # traversed name -> id(node)
        self._collect(params, "")
        if sensor not in params.hierarchy:  # loaded on its own, as multi-view loops do
            params = mi.traverse(sensor)
            self._nodes += params.hierarchy
            self._collect(params, "sensor.")
        self._children = {id(node): child_objects(node) for node in self._nodes}

    def _collect(self, params, prefix: str) -> None:
        for name, (_, _, node, _) in params.properties.items():
            value = parameter_value(params, name)
            self._values.setdefault(id(node), {})[_last(name)] = value
            if _grad_enabled(value) and self._counts(value):
                self._enabled[prefix + name] = id(node)

    def enabled_names(self) -> tuple[str, ...]:
        return tuple(self._enabled)

    def value(self, node: mi.Object, parameter: str):
        """The current value of one of the node's own parameters, or None if it has no such parameter."""
        return self._values.get(id(node), {}).get(parameter)

    def enabled_of(self, node: mi.Object) -> tuple[str, ...]:
        """The node's own enabled parameters, by their last name."""
        return tuple(_last(name) for name, owner in self._enabled.items() if owner == id(node))

    def enabled_full(self, node: mi.Object) -> tuple[str, ...]:
        """The node's own enabled parameters, by their full names."""
        return self._enabled_in([node])

    def enabled_below(self, node: mi.Object | None, skip: tuple[type, ...] = ()) -> tuple[str, ...]:
        """Enabled parameters of everything that `node` refers to, by their full names."""
        return self._enabled_in(self.walk(node, skip)[1:])

    def enabled_from(self, node: mi.Object | None) -> tuple[str, ...]:
        """Enabled parameters of `node` and everything that it refers to, by their full names."""
        return self._enabled_in(self.walk(node))

    def _enabled_in(self, nodes: list[mi.Object]) -> tuple[str, ...]:
        ids = {id(node) for node in nodes}
        return tuple(name for name, owner in self._enabled.items() if owner in ids)

    def walk(self, node: mi.Object | None, skip: tuple[type, ...] = ()) -> list[mi.Object]:
        """`node` and then all it refers to, each object once, without entering those of types `skip`."""
        found, todo = {}, [] if node is None else [node]
        while todo:
            node = todo.pop()
            if id(node) not in found:
                found[id(node)] = node
                todo += [child for child in self._children_of(node) if not isinstance(child, skip)]
        return list(found.values())

    def _children_of(self, node: mi.Object) -> list[mi.Object]:
        known = self._children.get(id(node))
        return child_objects(node) if known is None else known

    def nodes(self) -> list[mi.Object]:
        return list(self._nodes)

    def name(self, node: mi.Object, index: int) -> str:
        """The id given in the scene file, or the plugin and a number."""
        known = node.id()
        return known if known and not known.startswith("_unnamed_") else f"{plugin_name(node)} #{index}"


def child_objects(node: mi.Object) -> list[mi.Object]:
    """The objects that `node` refers to directly, in the order in which it names them."""
    return [child for _, child in named_children(node)]


def named_children(node: mi.Object) -> list[tuple[str, mi.Object]]:
    """The objects that `node` refers to directly, with the names that it gives them."""
    callback = _children_callback()()
    node.traverse(callback)
    return callback.found


@cache
def _children_callback() -> type:
    """The traversal callback, made when first needed: its base exists with a variant only."""

    class Children(mi.TraversalCallback):
        def __init__(self):
            super().__init__()
            self.found = []

        def put(self, name, value, flags, cpptype=None):
            if isinstance(value, mi.Object):
                self.found.append((name, value))

    return Children


def _last(name: str) -> str:
    return name.rsplit(".", 1)[-1]


def _grad_enabled(value) -> bool:
    return value is not None and not isinstance(value, (bool, int, float, str)) and dr.grad_enabled(value)


def jumping_textures(graph: SceneGraph, owner: mi.Object | None) -> tuple[str, ...]:
    """Textures and adapters below `owner` whose value steps from one surface point to the next."""
    found = {}
    for node in graph.walk(owner, skip=(mi.Shape,)):
        plugin = plugin_name(node)
        if plugin in JUMPING_PLUGINS or (isinstance(node, mi.Texture) and is_piecewise_constant(node, plugin)):
            found[f"{plugin} '{node.id()}'" if node.id() else plugin] = None
    return tuple(found)


def sees_frame(graph: SceneGraph, bsdf: mi.BSDF | None) -> bool:
    """Whether a BSDF depends on how the shading frame is turned about the normal: brushed metal, normal maps."""
    known = [node for node in graph.walk(bsdf, skip=(mi.Shape,)) if isinstance(node, mi.BSDF)]
    turned = any(node.flags() & int(mi.BSDFFlags.Anisotropic) for node in known)
    return turned or any(plugin_name(node) not in FRAME_FREE_PLUGINS for node in known)


def is_black(graph: SceneGraph, bsdf: mi.BSDF | None) -> bool:
    """Whether a BSDF scatters nothing and stays so, like the one that Mitsuba gives lights without one.

    False where that is not known: other plugins, and while a function is being frozen.
    """
    if bsdf is None or plugin_name(bsdf) != "diffuse" or graph.enabled_from(bsdf):
        return False
    values = [on_host_or_none(graph.value(texture, "value")) for texture in child_objects(bsdf)]
    return all(value is not None and not value.any() for value in values)


def varies(texture: mi.Texture) -> bool:
    """Whether a texture may differ from point to point. Attributes of meshes do, though Mitsuba denies it."""
    return texture.is_spatially_varying() or plugin_name(texture) == "mesh_attribute"


def is_painted(graph: SceneGraph, owner: mi.Object | None) -> bool:
    """Whether a texture below `owner` may differ from point to point. Flags of BSDFs do not tell, in Mitsuba 3.9."""
    return any(isinstance(node, mi.Texture) and varies(node) for node in graph.walk(owner, skip=(mi.Shape,)))


def is_piecewise_constant(texture: mi.Texture, plugin: str) -> bool:
    """Whether a texture varies over the surface and yet has no derivative with respect to the position.

    That is what `filter_type=nearest` means, which neither traversal nor `to_string` reveals. The value is
    recorded, never evaluated: whether it is attached to the position is known without a kernel launch.
    """
    if plugin == "mesh_attribute":
        return 'name = "face_' in str(texture)
    if not texture.is_spatially_varying():
        return False
    with dr.resume_grad():  # without derivatives everything would look constant
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.uv, si.p = mi.Point2f(0.3, 0.4), mi.Point3f(0.3, 0.4, 0.5)
        dr.enable_grad(si.uv, si.p)
        for lookup in (texture.eval, texture.eval_3, texture.eval_1):
            try:
                return not dr.grad_enabled(lookup(si))
            except RuntimeError:  # raw data has no spectral value, and coloured data no scalar one
                continue
    return False


def rim_of_cone(graph: SceneGraph, emitter: mi.Emitter) -> str:
    """How a spot light's intensity drops to zero: "soft", "thin" (few samples meet the slope) or "hard" (in a step).

    "" for other lights, and while a function is being frozen.
    """
    cutoff, beam = (on_host_or_none(graph.value(emitter, name)) for name in ("cutoff_angle", "beam_width"))
    if cutoff is None or beam is None:
        return ""
    width = np.min(cutoff - beam)
    return "hard" if width <= HARD_RIM * cutoff.max() else "thin" if width <= THIN_RIM * cutoff.max() else "soft"


def is_cubic(graph: SceneGraph, shape: mi.Shape) -> bool:
    """Has a grid as many values along each axis? Mitsuba 3.9 mixes the axes up where it has not."""
    return len(set(graph.value(shape, "grid").shape[:3])) == 1


def non_finite_vertices(shapes: list[mi.Shape]) -> list[int]:
    """Number of vertices of each shape with a NaN or infinite coordinate; one synchronisation in all."""
    meshes = [i for i, shape in enumerate(shapes) if shape.is_mesh() and shape.vertex_count() > 0]
    result = [0] * len(shapes)
    if not meshes or dr.flag(dr.JitFlag.FreezingScope):  # values cannot be read while freezing
        return result
    finite = dr.isfinite(joined([dr.detach(positions_buffer(shapes[i])) for i in meshes]))
    if bool(dr.all(finite)[0]):
        return result
    end = np.cumsum([shapes[i].vertex_count() for i in meshes])
    for i, of_mesh in zip(meshes, np.split(np.array(finite).reshape(-1, 3), end[:-1]), strict=True):
        result[i] = int(np.count_nonzero(~of_mesh.all(axis=1)))
    return result


def on_host_or_none(value) -> np.ndarray | None:
    """`value` on the host, or None while a function is being frozen: its values are not available then."""
    if value is None or dr.flag(dr.JitFlag.FreezingScope):
        return None
    return np.array(dr.detach(value), dtype=np.float64).squeeze()
