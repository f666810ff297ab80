"""Mirrors, glass, plastic, windows and masks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

from benchmarks import meshes
from benchmarks.check_lists.common import (
    LAMP,
    MOVE,
    POINT,
    Listed,
    Motion,
    T,
    checkered,
    glowing,
    ground,
    lamp,
    moved,
    scene_of,
    sky,
    turned,
    unit,
    view,
)  # fmt: skip
from benchmarks.check_lists.smooth import round_mesh

NAME = "specular"

MIRROR, GLASS = {"type": "conductor"}, {"type": "psdr_dielectric", "int_ior": 1.5}
PLASTIC = {"type": "psdr_plastic", "int_ior": 1.5, "diffuse_reflectance": 0.5}
BODY = "body.vertex_positions"


def card(x: float, y: float, z: float, size: float = 0.5, **bsdf: Any) -> dict:
    pose = T().translate([x, y, z]).rotate(unit(0.3, 1, 0.1), 35).scale(size)
    two = {"type": "twosided", "of": {"type": "diffuse", "reflectance": checkered()}}
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf or two}


def wall(z: float, tilt: float, size: float = 1.6, **bsdf: Any) -> dict:
    pose = T().translate([0.1, 0.1, z]).rotate(unit(1, 0.3, 0), tilt).scale(size)
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf or MIRROR}


def in_mirror(depth: int = 3, **more: dict) -> mi.Scene:
    parts = {"card": card(0.7, 0.2, 0.6), "mirror": wall(-1.5, -7), "lamp": lamp(*LAMP)}
    return scene_of(depth, view((-0.9, 0.7, 3.4), (0.1, 0.1, -1.4), 40), **parts, **more)


def facing_mirrors() -> mi.Scene:
    pose = T().translate([-0.2, -0.1, 2.2]).rotate(unit(0.1, 1, 0), 172).scale([1.9, 0.5, 1])
    return in_mirror(6, opposite={"type": "rectangle", "to_world": pose, "bsdf": MIRROR})


def body_of(kind: str, bsdf: dict, at: tuple = (0.05, 0.1, 0.1)) -> Any:
    """A slab, a cube, a ball of facets, a smooth-shaded ball or a sphere."""
    pose = T().translate(list(at)).rotate(unit(0.3, 1, 0.2), 31)
    if kind in ("slab", "cube"):
        return {"type": "cube", "to_world": pose.scale([0.9, 0.6, 0.15] if kind == "slab" else 0.5), "bsdf": bsdf}
    if kind == "sphere":
        return {"type": "sphere", "to_world": pose.scale(0.75), "bsdf": bsdf}
    points, faces = round_mesh(64 if kind == "smooth ball" else 10)
    make = meshes.smooth_mesh if kind == "smooth ball" else meshes.flat_mesh
    return make("body", 0.75 * points + np.array(at), faces, mi.load_dict(bsdf))


def before_background(kind: str, glows: bool) -> mi.Scene:
    """Glass before a picture that glows, or that a lamp in front lights."""
    pose = T().translate([0.2, -0.1, -1.9]).rotate(unit(0.2, 1, 0), 8).scale(5)
    texture = checkered() | {"to_uv": T().rotate(unit(0, 0, 1), 20).scale([5, 5, 1])}
    shown = {"emitter": {"type": "area", "radiance": texture}} if glows else {
        "bsdf": {"type": "diffuse", "reflectance": texture}}  # fmt: skip
    parts = {"picture": {"type": "rectangle", "to_world": pose, **shown}, "body": body_of(kind, GLASS)}
    lights = {} if glows else {"lamp": lamp((1.9, 2.2, 2.3), 0.9, 9)}
    return scene_of(5 if glows else 6, view((0.4, 0.6, 4.3)), **parts, **lights)


LIGHTS: dict[str, Callable[[], dict]] = {
    "area light": lambda: lamp(*LAMP),
    "sky": lambda: sky(bright_spot(), to_world=T().rotate(unit(0.2, 1, 0.1), 50)),
    "point light": lambda: POINT,
}


def bright_spot() -> np.ndarray:
    y, x = np.mgrid[0:32, 0:65]
    one = 0.4 + np.exp(-((x % 64 - 20) ** 2 + (y - 9) ** 2) / 30) * 3
    return np.stack([one, 0.8 * one + 0.1, 0.6 * one + 0.2], -1)


def plastic_ball(light: str) -> mi.Scene:
    parts = {"body": body_of("smooth ball", PLASTIC), "floor": ground(-0.9), "light": LIGHTS[light]()}
    return scene_of(3, view((0.7, 1.3, 4.3), (0, -0.2, 0)), **parts)


def plastic_floor(light: str, depth: int = 3, **floor: Any) -> mi.Scene:
    matt = {"type": "diffuse", "reflectance": 0.6}
    parts = {"body": body_of("cube", matt), "floor": ground(-0.9, **(floor or PLASTIC)), "light": LIGHTS[light]()}
    return scene_of(depth, view((0.7, 1.3, 4.3), (0, -0.2, 0)), **parts)


def window() -> mi.Scene:
    pane = {"type": "rectangle", "to_world": T().translate([0.6, 1.5, 1.0]).rotate(unit(1, 0.3, 0.2), -50).scale(1.1),
            "bsdf": {"type": "thindielectric"}}  # fmt: skip
    parts = {"body": body_of("cube", {"type": "diffuse"}), "floor": ground(-0.9), "pane": pane}
    return scene_of(4, view((0.7, 1.3, 4.3), (0, -0.2, 0)), **parts, lamp=lamp(*LAMP))


def mask(opacity: Any) -> mi.Scene:
    bsdf = {"type": "mask", "opacity": opacity, "of": {"type": "twosided", "of": {"type": "diffuse"}}}
    pose = T().translate([0.3, 0.4, 0.3]).rotate(unit(1, 0.3, 0.2), -60).scale(0.8)
    sheet = {"type": "rectangle", "to_world": pose, "bsdf": bsdf}
    return scene_of(4, view((0.7, 1.6, 4.3), (0, -0.2, 0)), sheet=sheet, floor=ground(-0.9), lamp=lamp(*LAMP))


def holes() -> dict:
    data = (np.random.default_rng(3).random((5, 6, 1)) > 0.45).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True, "filter_type": "nearest"}


def reflected() -> mi.Scene:
    """What a mirror throws onto a wall that the lamp itself does not reach."""
    pose = T().translate([0.1, -0.9, 0.6]).rotate(unit(1, 0.1, 0.2), -78).scale(0.6)
    glow = T().look_at(origin=[0.4, 1.4, 1.6], target=[0.1, -0.9, 0.6], up=[0, 0, 1]).scale(0.35)
    mirror = {"type": "rectangle", "to_world": pose, "bsdf": MIRROR}
    parts = {"mirror": mirror, "wall": wall(-1.4, 4, 2.2, type="diffuse"), "lamp": glowing(glow, 15.0)}
    return scene_of(3, view((0.9, 0.9, 4.3), (0.1, 0.1, -1.4), 40), **parts)


def specular() -> Iterator[Listed]:
    yield from mirrored()
    yield from refracted()
    for light in LIGHTS:
        yield Listed(NAME, f"plastic ball, {light}", partial(plastic_ball, light), moved(BODY))
        yield Listed(NAME, f"plastic floor, {light}", partial(plastic_floor, light), moved(BODY))
    yield Listed(NAME, "window before the light", window, moved(BODY))
    yield Listed(NAME, "half-opaque mask", partial(mask, 0.5), moved("sheet.to_world"))
    yield Listed(NAME, "mask with holes", lambda: mask(holes()), moved("sheet.to_world"))


def mirrored() -> Iterator[Listed]:
    turning = turned("mirror.to_world")
    for motion in (moved("card.to_world"), moved("mirror.to_world"), turning, moved("camera.to_world")):
        yield Listed(NAME, f"card in a mirror, {_said(motion)}", in_mirror, motion)
    for motion in (moved("card.to_world"), turning):
        yield Listed(NAME, f"two facing mirrors, {_said(motion)}", facing_mirrors, motion)
    yield Listed(NAME, "mirror floor", partial(plastic_floor, "area light", 4, **MIRROR), moved(BODY))
    for motion in (moved("mirror.to_world"), turning):
        yield Listed(NAME, f"reflected light, {_said(motion)}", reflected, motion)


def refracted() -> Iterator[Listed]:
    for kind in ("slab", "cube", "smooth ball", "sphere"):
        pose = moved("body.to_world" if kind == "sphere" else BODY)
        motions = (pose, moved("picture.to_world"), moved("camera.to_world"), Motion("body.bsdf.eta", MOVE, 1.0))
        for what, glows in (("glowing", True), ("lit", False)):
            for motion in motions:
                name = f"glass {kind}, {what} picture, {_said(motion)}"
                yield Listed(NAME, name, partial(before_background, kind, glows), motion)
    yield Listed(NAME, "glass ball of facets, turned", partial(before_background, "facets", True), turned(BODY))


def _said(motion: Motion) -> str:
    what = motion.param.split(".")[0] if not motion.param.endswith("eta") else "index"
    return f"{what} {'turned' if motion.rotate is not None else 'moved'}"
