"""What psdr_jit does not model, said by name before a ray is traced.

A silent zero is a defect, and so is refusing a scene for something that does not matter. Hence: terms that
only exist while something moves (see `SceneFacts.geometry_moves`) are checked only then, and material and
radiance gradients of the same scene go through.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from ..core.compat import VERTEX_TEXCOORDS
from ..core.memory import Memory
from ..core.warn_once import warn_once
from ..errors import PsdrError, SceneError, UnsupportedError, UnsupportedWarning, ZeroDerivativeWarning
from .capabilities import CONE_PARAMETERS, COPIES, SUN_SKIES, SUPPORTED_SENSORS, UNSUPPORTED_SHAPES
from .facts import SceneFacts, ShapeFacts
from .size import overflow, too_low_for_shadows


@dataclass(frozen=True)
class Finding:
    """One thing that stands in the way (`category` an error) or is missing (`category` a warning)."""

    category: type[PsdrError] | type[UserWarning]
    subject: str  # name of the shape, emitter or sensor; "" if it is the scene as a whole
    message: str

    @property
    def is_error(self) -> bool:
        return issubclass(self.category, PsdrError)


def require_supported(facts: SceneFacts, memory: Memory | None = None) -> None:
    """Raise if the derivative of this scene would be wrong, warn if a part of it is missing.

    All errors go into one message, under the type of the first. The text of a warning names the shape or emitter;
    `memory` remembers which parts have been said already.
    """
    found = list(findings(facts))
    errors = [finding for finding in found if finding.is_error]
    if errors:
        text = "\n".join(f"- {error.message}" for error in errors) if len(errors) > 1 else errors[0].message
        raise errors[0].category(text if len(errors) == 1 else f"{len(errors)} obstacles:\n{text}")
    for finding in found:
        warn_once(finding.message, finding.category, memory if finding.category is UnsupportedWarning else None)


def findings(facts: SceneFacts) -> Iterator[Finding]:
    """Everything `require_supported` reports, as data."""
    for check in CHECKS:
        yield from check(facts)


def check_parameters(facts: SceneFacts) -> Iterator[Finding]:
    """Without anything to differentiate, the answer is 0."""
    if facts.still:
        yield Finding(ZeroDerivativeWarning, "", f"the derivative is 0: {facts.still}")
    elif not facts.anything_enabled:
        yield Finding(
            ZeroDerivativeWarning, "",
            "the derivative is 0: no scene parameter has gradients enabled; after params = mi.traverse(scene), call "
            "dr.enable_grad(params['shape.to_world']) (or assign a value that depends on a variable with "
            "gradients), then params.update(), and render with mi.render(scene, params)",
        )  # fmt: skip


def check_variant(facts: SceneFacts) -> Iterator[Finding]:
    """Polarised light is carried by Mueller matrices, which no term here knows."""
    if facts.polarized:
        yield Finding(
            UnsupportedError, "",
            f"variant '{facts.variant}' is polarised, which psdr_jit does not model; use "
            f"'{facts.variant.replace('_polarized', '')}'",
        )  # fmt: skip


def check_media(facts: SceneFacts) -> Iterator[Finding]:
    """Media are refused always: like Mitsuba's `path`, every term here would treat them as vacuum."""
    for shape in facts.shapes:
        if shape.has_medium:
            yield Finding(
                UnsupportedError, shape.name,
                f"shape '{shape.name}' bounds a participating medium, which psdr_jit (like 'path') ignores; "
                "remove the medium, or differentiate with 'prbvolpath'",
            )  # fmt: skip
    if facts.sensor.has_medium:
        yield Finding(
            UnsupportedError, facts.sensor.name,
            f"sensor '{facts.sensor.name}' is inside a participating medium, which psdr_jit (like 'path') "
            "ignores; remove the medium, or differentiate with 'prbvolpath'",
        )  # fmt: skip


def check_sensor(facts: SceneFacts) -> Iterator[Finding]:
    """Moving edges must be projected onto the film."""
    if facts.geometry_moves and facts.sensor.plugin not in SUPPORTED_SENSORS:
        alike = "; crop none, set sample_border to false, or give each of its sensors the rfilter of the batch"
        way_out = alike if facts.sensor.plugin == "batch" else ""
        yield Finding(
            UnsupportedError, facts.sensor.name,
            f"sensor '{facts.sensor.name}' ({facts.sensor.plugin}) has no primary boundary term{way_out}; "
            f"use {', '.join(sorted(SUPPORTED_SENSORS))}, or differentiate materials and radiance only",
        )  # fmt: skip


def check_shapes(facts: SceneFacts) -> Iterator[Finding]:
    """Shapes without an edge set, and malformed ones.

    A static shape without edges is refused as well while anything moves: it casts shadows onto moving
    surfaces, is seen past moving edges, and its outline moves over the film with the camera. Only when
    nothing moves do its silhouettes stand still in every view.
    """
    if not facts.shapes:
        yield Finding(UnsupportedError, "", "the scene has no shapes: there is nothing to scatter light; add one")
    for shape in facts.shapes:
        label = f"shape '{shape.name}' ({shape.plugin})"
        if shape.bad_vertices:
            yield Finding(
                SceneError, shape.name,
                f"{label} has {shape.bad_vertices} vertices with NaN or infinite coordinates; repair the "
                "mesh, or lower the step size of the optimisation",
            )  # fmt: skip
        if shape.is_mesh and shape.faces == 0:
            yield Finding(SceneError, shape.name, f"{label} has no faces; remove it or fix its file")
        if not facts.geometry_moves:
            continue
        if shape.kind == "unsupported":
            way_out = UNSUPPORTED_SHAPES.get(shape.plugin, "use a mesh")
            yield Finding(
                UnsupportedError, shape.name,
                f"{label} has no edge set, so its silhouettes would be missing from the derivative of this "
                f"geometry; {way_out}, or differentiate materials and radiance only",
            )  # fmt: skip
        if shape.pose_fault:
            yield Finding(SceneError, shape.name, f"{label} {shape.pose_fault}")


def check_instances(facts: SceneFacts) -> Iterator[Finding]:
    """What is instanced rests: Mitsuba does not turn the normals of an instance that moves."""
    for shape in facts.shapes:
        if not shape.moves or (shape.kind != "instance" and not shape.group):
            continue
        what = "an instance" if shape.kind == "instance" else f"a shape of shapegroup '{shape.group}'"
        yield Finding(
            UnsupportedError, shape.name,
            f"shape '{shape.name}' ({shape.plugin}) is {what} that moves "
            f"({', '.join(shape.geometry or shape.shading)}), which is not modelled: instances take part while "
            f"something else is differentiated; {COPIES}",
        )  # fmt: skip


def check_specular(facts: SceneFacts) -> Iterator[Finding]:
    """Directions follow delta lobes; what cannot be followed is refused, what is not sampled behind them is named."""
    if not facts.geometry_moves:
        return
    beside = next((s.name for s in facts.shapes if s.kind == "grid" and s.group), "")
    for shape in facts.shapes:
        if not shape.delta_lobes:
            continue
        label = f"shape '{shape.name}' has the BSDF '{shape.bsdf}' with perfectly specular or pass-through lobes"
        lobes = ", ".join(shape.delta_lobes)
        others = beside and f"an instance shows the grid '{beside}' beside it"
        obstacle = shape.delta_obstacle or others
        if obstacle:
            yield Finding(
                UnsupportedError, shape.name,
                f"{label} ({lobes}) through which motion is not followed, because {obstacle}; use a rough BSDF (such "
                "as roughconductor, roughdielectric or roughplastic), or differentiate materials and radiance only",
            )  # fmt: skip
        elif steps := [f"{step} of '{e.name}'" for e in facts.emitters for step in e.steps]:
            yield Finding(
                UnsupportedWarning, shape.name,
                f"{label} ({lobes}): what the sensor sees by way of them of {', '.join(steps)} is missing from the "
                "derivative. Use a rough BSDF, or a light without steps, where it matters",
            )  # fmt: skip


def check_delta_weights(facts: SceneFacts) -> Iterator[Finding]:
    """What delta lobes under others are worth is not known."""
    for shape in facts.shapes:
        watched = shape.shading if shape.delta_lobes and shape.lost_varies and not facts.geometry_moves else ()
        enabled = list(shape.lost_weights) + [f"{shape.name}.{name}" for name in watched]
        if enabled:
            yield Finding(
                UnsupportedError, shape.name,
                f"{', '.join(enabled)}: the derivative through a perfectly specular or pass-through lobe "
                f"({', '.join(shape.delta_lobes)} of shape '{shape.name}') is not modelled and would be 0; use a rough "
                "BSDF (such as roughconductor, roughdielectric or roughplastic), or do not enable this parameter",
            )  # fmt: skip
        if shape.blends_delta:
            yield Finding(
                UnsupportedError, shape.name,
                f"shape '{shape.name}' has a blendbsdf of a smooth and a perfectly specular BSDF, whose sampling "
                "density Mitsuba does not report; use a rough BSDF in place of the specular one",
            )  # fmt: skip


def check_extent(facts: SceneFacts) -> Iterator[Finding]:
    """Single precision: what is too large overflows, images of what is small or far away lack a part."""
    if text := overflow(facts):
        yield Finding(SceneError, "", text)
    elif facts.geometry_moves and (text := too_low_for_shadows(facts)):
        yield Finding(UnsupportedWarning, "", text)


def check_surface_steps(facts: SceneFacts) -> Iterator[Finding]:
    """Steps inside a surface slide along it as soon as a ray does, and not all of them are edges."""
    for shape in facts.shapes:
        if shape.jumps and (facts.geometry_moves or VERTEX_TEXCOORDS in shape.shading):
            yield _missing_steps(shape.name, f"shape '{shape.name}'", shape.jumps)
        if shape.patterns and VERTEX_TEXCOORDS in shape.shading:
            yield Finding(
                UnsupportedWarning, shape.name,
                f"shape '{shape.name}' has steps inside its surface ({', '.join(shape.patterns)}), which slide "
                "with its texture coordinates: this part of the derivative is missing; use smooth textures",
            )  # fmt: skip
    for emitter in facts.emitters:
        if emitter.jumps and (facts.geometry_moves or _uv_moves(facts.shapes, emitter.shape)):
            yield _missing_steps(emitter.name, f"emitter '{emitter.name}' ({emitter.plugin})", emitter.jumps)


def _uv_moves(shapes: tuple[ShapeFacts, ...], index: int) -> bool:
    return index >= 0 and VERTEX_TEXCOORDS in shapes[index].shading


def _missing_steps(subject: str, label: str, jumps: tuple[str, ...]) -> Finding:
    return Finding(
        UnsupportedWarning, subject,
        f"{label} has steps inside its surface ({', '.join(jumps)}): where they slide, their part of the "
        "derivative is missing; use a smooth texture or material in their place",
    )  # fmt: skip


def check_emitters(facts: SceneFacts) -> Iterator[Finding]:
    """Lights whose emission ends in a step, or in a slope as good as one, that no edge stands for; turned skies."""
    for emitter in facts.emitters:
        label = f"emitter '{emitter.name}' ({emitter.plugin})"
        if emitter.pose_fault:
            yield Finding(UnsupportedWarning, emitter.name, f"{label} {emitter.pose_fault}")
        if emitter.rim == "thin" and (facts.geometry_moves or CONE_PARAMETERS & set(emitter.radiance)):
            yield Finding(
                UnsupportedWarning, emitter.name,
                f"{label} has a rim so thin that few samples meet it: its part of the derivative is mostly noise; set "
                "beam_width equal to cutoff_angle, which is a step that is sampled, or well below it",
            )  # fmt: skip
        if emitter.plugin in SUN_SKIES and (facts.camera_moves or emitter.pose):
            yield Finding(
                UnsupportedWarning, emitter.name,
                f"{label} has a sun disc whose rim is not sampled: it is missing where the disc is seen by "
                "a turning camera or the sky itself turns; set sun_scale=0 and add a directional light",
            )  # fmt: skip


CHECKS = (
    check_parameters,
    check_variant,
    check_media,
    check_sensor,
    check_shapes,
    check_instances,
    check_specular,
    check_delta_weights,
    check_extent,
    check_surface_steps,
    check_emitters,
)
