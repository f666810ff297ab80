"""Random scenes with mirrors, glass, plastic, windows and masks: those of `scenes`, with other materials.

A stream of its own, so that the scenes without them stay what they are.
"""

from __future__ import annotations

import numpy as np
from fuzz.draw import Draw
from fuzz.scenes import SOLID, Case, case_of, lift

SALT = 0x61A55  # keeps these streams apart from others with the same seeds
SHARE = 0.6  # of the objects; of each scene, one at least
FLOOR_SHARE = 0.3
NOT_SHOWN = "but not what mirrors and smooth glass show of it"  # in the warning about light of points


def specular_case_of(seed: int) -> Case:
    """The case of this seed, always the same: that of `case_of`, but that some materials have delta lobes."""
    draw, case = Draw(np.random.default_rng([SALT, seed])), case_of(seed)
    scene = case["scene"]
    free = [name for name, shape in scene.items()
            if isinstance(shape, dict) and "bsdf" in shape and "emitter" not in shape
            and not case["param"].startswith(f"{name}.bsdf")]  # fmt: skip
    chosen = [name for name in free if draw.chance(FLOOR_SHARE if name == "floor" else SHARE)]
    for name in chosen or free[-1:]:
        shape = scene[name]
        closed = shape.get("mesh", shape["type"]) in SOLID and name != "floor"
        shape["bsdf"] = _solid(draw) if closed else _thin(draw)
        if closed and _rests(shape):
            lift(shape)  # what is seen of a floor that coincides with glass is rounding
    case["integrator"] |= {
        "form": draw.one(["spatial", "auto"]),
        "max_depth": draw.weighted({2: 2, 3: 4, 4: 3, 5: 1}),
    }
    return case


def bidirectional_case_of(seed: int) -> Case:
    """The same by `psdr_bdpt`, which wants a smooth filter for the light of points by way of mirrors and glass."""
    case = specular_case_of(seed)
    case["integrator"] |= {"type": "psdr_bdpt"}
    case["accepted"] = [NOT_SHOWN]  # by the image as well, of which differences are taken
    film = case["scene"]["camera"]["film"]
    if film["rfilter"]["type"] == "box":
        film["rfilter"] = {"type": "gaussian"}
    return case


def _rests(shape: dict) -> bool:
    (_, centre), (_, size) = shape["to_world"][0], shape["to_world"][-1]
    return centre[1] == size


def _solid(draw: Draw) -> dict:
    make = draw.weighted({_glass: 3, _mirror: 2, _plastic: 2, _mask: 1})
    return make(draw)


def _thin(draw: Draw) -> dict:
    make = draw.weighted({_two_sided_mirror: 3, _window: 2, _two_sided_plastic: 2, _mask: 2})
    return make(draw)


def _glass(draw: Draw) -> dict:
    return {"type": "dielectric", "int_ior": draw.number(1.2, 1.6)}


def _mirror(draw: Draw) -> dict:
    return {"type": "conductor", "material": "none", "specular_reflectance": draw.number(0.4, 0.9)}


def _two_sided_mirror(draw: Draw) -> dict:
    return {"type": "twosided", "bsdf": _mirror(draw)}


def _plastic(draw: Draw) -> dict:
    return {"type": "plastic", "diffuse_reflectance": draw.number(0.2, 0.8)}


def _two_sided_plastic(draw: Draw) -> dict:
    return {"type": "twosided", "bsdf": _plastic(draw)}


def _window(draw: Draw) -> dict:
    return {"type": "thindielectric", "int_ior": draw.number(1.2, 1.6)}


def _mask(draw: Draw) -> dict:
    below = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": draw.number(0.2, 0.8)}}
    return {"type": "mask", "opacity": draw.number(0.2, 0.8), "bsdf": below}
