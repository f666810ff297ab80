"""Perfectly specular and pass-through lobes: where they are, what scales them, and whether they can be followed."""

from __future__ import annotations

import mitsuba as mi

from .capabilities import BENDING_PARAMETERS, SMOOTH_PARAMETERS, WEIGHED_PLUGINS
from .graph import SceneGraph, named_children, plugin_name, varies

BENT_NORMALS = frozenset({"bumpmap", "normalmap"})

DELTA_KINDS = ("Null", "DeltaReflection", "DeltaTransmission", "Delta1D")
"""The lobes (names in `mi.BSDFFlags`) that have no value to evaluate, only samples."""


def delta_lobes(graph: SceneGraph, bsdf: mi.BSDF | None) -> tuple[str, ...]:
    """The perfectly specular and pass-through lobes of a BSDF, each with the nested plugin it comes from."""
    lobes = {}
    for node in graph.walk(bsdf):
        if not isinstance(node, mi.BSDF):
            continue
        nested = [child for child in graph.walk(node)[1:] if isinstance(child, mi.BSDF)]
        for kind in DELTA_KINDS:
            bit = int(getattr(mi.BSDFFlags, kind))
            # an adapter such as "twosided" repeats the flags of what it wraps: blame the innermost plugin
            if node.flags() & bit and not any(child.flags() & bit for child in nested):
                lobes[f"{plugin_name(node)}: {kind}"] = None
    return tuple(lobes)


def lost_weights(graph: SceneGraph, bsdf: mi.BSDF | None) -> tuple[tuple[str, ...], bool]:
    """Enabled parameters of delta lobes whose derivative is not known (full names), and whether one such varies.

    A BSDF that only wraps others (`mask`, `blendbsdf`, `normalmap`) counts when one of those has a delta lobe.
    """
    if all(plugin_name(node) in WEIGHED_PLUGINS for node in graph.walk(bsdf) if isinstance(node, mi.BSDF)):
        return (), False
    enabled, varying = {}, False
    for node in graph.walk(bsdf):
        if not isinstance(node, mi.BSDF) or not _has_delta_lobe(node):
            continue
        own = [
            child
            for name, child in named_children(node)
            if not isinstance(child, mi.BSDF) and (plugin_name(node), name) not in SMOOTH_PARAMETERS
        ]
        for child in own:
            enabled |= dict.fromkeys(graph.enabled_from(child))
            varying |= isinstance(child, mi.Texture) and varies(child)
        enabled |= dict.fromkeys(graph.enabled_full(node))
    return tuple(enabled), varying


def bending(graph: SceneGraph, bsdf: mi.BSDF | None) -> tuple[str, ...]:
    """Enabled parameters that turn the directions of delta lobes, by their full names."""
    nodes = [node for node in graph.walk(bsdf, skip=(mi.Shape,)) if isinstance(node, mi.BSDF)]
    turning = [n for n in nodes if any((plugin_name(n), name) in BENDING_PARAMETERS for name in graph.enabled_of(n))]
    return tuple(name for node in turning for name in graph.enabled_full(node))


def lobes_not_followed(graph: SceneGraph, bsdf: mi.BSDF | None) -> str:
    """Why directions that leave a BSDF by its delta lobes cannot be told from the surface alone; "" if they can."""
    nodes = [node for node in graph.walk(bsdf, skip=(mi.Shape,)) if isinstance(node, mi.BSDF)]
    if not any(_has_delta_lobe(node) for node in nodes):
        return "'hair' has a lobe that it never samples" if any(plugin_name(n) == "hair" for n in nodes) else ""
    for node in nodes:
        name = plugin_name(node)
        inner = [child for child in graph.walk(node, skip=(mi.Shape,))[1:] if isinstance(child, mi.BSDF)]
        if not any(_has_delta_lobe(child) for child in inner):
            continue
        if name in BENT_NORMALS:
            return f"'{name}' bends the normals of a perfectly specular material"
        if name == "mask":
            return "'mask' covers a perfectly specular material"
    return ""


def blends_delta(graph: SceneGraph, bsdf: mi.BSDF | None) -> bool:
    """Whether a `blendbsdf` mixes a delta lobe with a smooth one."""
    blends = [node for node in graph.walk(bsdf) if plugin_name(node) == "blendbsdf"]
    return any(_has_delta_lobe(node) and node.flags() & int(mi.BSDFFlags.Smooth) for node in blends)


def _has_delta_lobe(bsdf: mi.BSDF) -> bool:
    if plugin_name(bsdf) == "hair":  # says that it has a null lobe, and never samples it
        return False
    return any(bsdf.flags() & int(getattr(mi.BSDFFlags, kind)) for kind in DELTA_KINDS)
