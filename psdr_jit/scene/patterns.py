"""Steps inside surfaces: which textures of a shape step, and along which lines in its texture coordinates.

A checkerboard steps at multiples of half a period, a bitmap with `filter_type=nearest` at its texel borders, and the
normals of a bump map, which are the slopes of a bilinear bitmap, at its texel centres, all after `to_uv`: families of
parallel lines a·(u, v) + b = k. Lines across which nothing changes, and textures of one colour,
are left out. Plain numbers on the host; nothing here depends on where the surface is.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .capabilities import PATTERN_PLUGINS, PATTERNS_ON_CURVES
from .graph import child_objects, is_piecewise_constant, plugin_name, varies

#: Texels of a bitmap that are looked at outside of its unit square, to see how it goes on there.
PROBES = 1024

#: Wavelength at which colours are compared in spectral variants [nm]; three more follow at this distance.
WAVELENGTH, APART = 450.0, 50.0


@dataclass(frozen=True)
class StepFamily:
    """The lines a·(u, v) + b = k, for integers k."""

    a: np.ndarray  # (2,)
    b: float
    steps: np.ndarray  # bool: is there a step at k, by k modulo the length of this array?
    first: float = -np.inf  # no steps below this k ...
    last: float = np.inf  # ... and beyond this one

    def within(self, low: float, high: float) -> np.ndarray:
        """The k in [low, high] at which there are steps."""
        k = np.arange(np.ceil(max(low, self.first)), np.floor(min(high, self.last)) + 1)
        return k[self.steps[k.astype(np.int64) % len(self.steps)]]


def missing_patterns(jumps: tuple[str, ...]) -> tuple[str, ...]:
    """Those of `graph.jumping_textures` whose steps are no edges."""
    return _not_of(PATTERN_PLUGINS, jumps)


def missing_on_curves(jumps: tuple[str, ...]) -> tuple[str, ...]:
    """Those of `graph.jumping_textures` whose steps are no edges where they lie on a curve."""
    return _not_of(PATTERNS_ON_CURVES, jumps)


def _not_of(plugins: frozenset[str], jumps: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(jump for jump in jumps if jump.split(" ")[0] not in plugins)


def steps_of_light(emitter: mi.Emitter, plugin: str, rim: str, jumps: tuple[str, ...]) -> tuple[str, ...]:
    """Of a projector or a spot: the steps that slide over surfaces as the light moves against them, and are edges.

    `rim`: of `graph.rim_of_cone`; `jumps`: of `graph.jumping_textures`.
    """
    own = {"projector": ("its frame",), "spot": ("the rim of its cone",) if rim == "hard" else ()}.get(plugin)
    if own is None or emitter.sampling_weight() == 0:  # what is never sampled lights nothing
        return ()
    missing = missing_patterns(jumps)
    return (*own, *(jump for jump in jumps if jump not in missing))


def pattern_textures(shape: mi.Shape) -> list[mi.Object]:
    """The textures and bump maps that step inside of `shape`, on its BSDF and on its emitter, each once."""
    return stepping_textures([shape.bsdf(), shape.emitter()])


def pattern_textures_on_curve(curve: mi.Shape) -> list[mi.Object]:
    """The same of a curve: those whose steps on it are edges."""
    return [node for node in pattern_textures(curve) if plugin_name(node) in PATTERNS_ON_CURVES]


def stepping_textures(owners: list[mi.Object | None]) -> list[mi.Object]:
    """The textures and bump maps below `owners` that step, each once."""
    found, todo = {}, [node for node in owners if node is not None]
    while todo:
        node = todo.pop()
        if id(node) not in found and not isinstance(node, mi.Shape):
            found[id(node)] = node
            todo += child_objects(node)
    return [node for node in found.values() if _steps(node, plugin_name(node))]


def _steps(node: mi.Object, plugin: str) -> bool:
    if plugin not in PATTERN_PLUGINS:
        return False
    return plugin in ("checkerboard", "bumpmap") or is_piecewise_constant(node, plugin)


def steps_between_faces(textures: list[mi.Object]) -> bool:
    """Is one of them an attribute by face, which steps along the edges of a mesh?"""
    return any(plugin_name(texture) == "mesh_attribute" for texture in textures)


def texture_values(textures: list[mi.Object]) -> list:
    """Everything on which `step_families` depends, detached: the same objects while nothing has changed."""
    values = [mi.traverse(texture) for texture in textures]
    return [params[key] for params in values for key, _ in params]


def step_families(texture: mi.Object) -> list[StepFamily]:
    """Along which lines a texture or bump map steps; empty for attributes of meshes and for textures of one colour."""
    plugin = plugin_name(texture)
    if plugin == "mesh_attribute":
        return []
    if plugin == "bumpmap":
        heights = [child for child in child_objects(texture) if plugin_name(child) == "bitmap"]
        return [family for bitmap in heights for family in _slopes(bitmap)]
    to_uv = np.array(mi.traverse(texture)["to_uv"].matrix, float)[:2]
    return _checkers(texture, to_uv) if plugin == "checkerboard" else _texels(texture, to_uv)


def _checkers(texture: mi.Texture, to_uv: np.ndarray) -> list[StepFamily]:
    colours = [child for child in child_objects(texture) if isinstance(child, mi.Texture)]
    if not any(varies(colour) for colour in colours):
        two = _values(texture, _preimages(to_uv, np.array([[0.25, 0.25], [0.75, 0.25]])))
        if (two[0] == two[1]).all():
            return []
    everywhere = np.ones(1, bool)
    return [StepFamily(2 * row[:2], 2 * row[2], everywhere) for row in to_uv]


def _slopes(bitmap: mi.Texture) -> list[StepFamily]:
    """Where the slopes of a bilinear bitmap step. Those of a nearest-neighbour one are 0 for Mitsuba."""
    if is_piecewise_constant(bitmap, "bitmap"):
        return []
    params = mi.traverse(bitmap)
    to_uv, (height, width) = np.array(params["to_uv"].matrix, float)[:2], dr.shape(params["data"])[:2]
    everywhere = np.ones(1, bool)
    return [StepFamily(n * row[:2], n * row[2] - 0.5, everywhere) for n, row in ((width, to_uv[0]), (height, to_uv[1]))]


def _texels(texture: mi.Texture, to_uv: np.ndarray) -> list[StepFamily]:
    data = np.array(dr.detach(mi.traverse(texture)["data"]), float)
    data = data.reshape(*data.shape[:2], -1)
    mode = _wrap_mode(texture, to_uv, data.shape[1], data.shape[0])
    families = []
    for axis, row in ((1, to_uv[0]), (0, to_uv[1])):
        count = data.shape[axis]
        other = tuple(i for i in range(3) if i != axis)
        differs = (data != np.roll(data, 1, axis)).any(axis=other)  # from texel k − 1 to texel k
        if differs.any():
            families.append(StepFamily(count * row[:2], count * row[2], *_lines_of(mode, differs)))
    return families


def _lines_of(mode: str | None, differs: np.ndarray) -> tuple:
    """`(steps, first, last)` of a family of texel borders, given which neighbours differ."""
    count = len(differs)
    if mode == "repeat":
        return differs, -np.inf, np.inf
    inner = np.concatenate([[False], differs[1:]])
    if mode == "clamp":
        return inner, 1, count - 1
    if mode == "mirror":
        return np.concatenate([inner, [False], inner[:0:-1]]), -np.inf, np.inf
    return np.ones(1, bool), -np.inf, np.inf


def _wrap_mode(texture: mi.Texture, to_uv: np.ndarray, width: int, height: int) -> str | None:
    """How a bitmap goes on outside of the unit square, which no parameter tells; None if that cannot be told apart."""
    rng = np.random.default_rng(0)
    size = np.array([width, height])
    texel = rng.integers(0, size, (PROBES, 2))
    axis = rng.integers(0, 2, PROBES)
    own, beyond = np.arange(PROBES), texel.copy()
    beyond[own, axis] = -1 - texel[own, axis]  # to the left of the unit square, or above it
    maps = {"repeat": size[axis] - 1 - texel[own, axis], "mirror": texel[own, axis], "clamp": 0 * axis}
    seen = _values(texture, _preimages(to_uv, (beyond + 0.5) / size))
    agree = []
    for mode, along in maps.items():
        inside = texel.copy()
        inside[own, axis] = along
        if (_values(texture, _preimages(to_uv, (inside + 0.5) / size)) == seen).all():
            agree.append(mode)
    return agree[0] if len(agree) == 1 else None


def _preimages(to_uv: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Texture coordinates (N, 2) that `to_uv` maps to `points`."""
    return (points - to_uv[:, 2]) @ np.linalg.pinv(to_uv[:, :2]).T


def _values(texture: mi.Texture, uv: np.ndarray) -> np.ndarray:
    """Values (N, channels) of `texture` at texture coordinates (N, 2)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(*(mi.Float(column) for column in uv.T.astype(np.float32)))
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(*(WAVELENGTH + APART * i for i in range(len(si.wavelengths))))
    for lookup in (texture.eval, texture.eval_3, texture.eval_1):
        try:
            found = np.array(dr.detach(lookup(si)))
        except RuntimeError:  # raw data has no spectral value, and coloured data no scalar one
            continue
        found = np.atleast_2d(found).T
        return np.broadcast_to(found, (len(uv), found.shape[1]))
    return np.zeros((len(uv), 1))
