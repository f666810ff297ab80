"""Random scenes with bump and normal maps: those of `scenes`, with maps over some of their materials.

A stream of its own, so that the scenes without them stay what they are.
"""

from __future__ import annotations

import numpy as np
from fuzz.draw import Draw
from fuzz.scenes import Case, case_of

SALT = 0xBE27  # keeps these streams apart from others with the same seeds
SHARE = 0.6  # of the shapes; of each scene, one at least
FLAT_IN_PART = 0.3  # of the normal maps
TEXELS = {3: 3, 6: 3, 16: 2, 60: 1}  # along a side of a map
MOVES = ("vertex_positions", "to_world", "x_fov", "aperture_radius", "focus_distance", "position", "direction")


def bent_case_of(seed: int) -> Case:
    """The case of this seed, always the same: that of `case_of`, but that some normals are bent."""
    draw, case = Draw(np.random.default_rng([SALT, seed])), case_of(seed)
    scene = case["scene"]
    shapes = [name for name, item in scene.items() if isinstance(item, dict) and _may_have_map(item)]
    for name in [name for name in shapes if draw.chance(SHARE)] or shapes[-1:]:
        bsdf = scene[name]["bsdf"]
        if bsdf["type"] == "twosided":
            bsdf["bsdf"] = _below_map(draw, bsdf["bsdf"])
        else:
            scene[name]["bsdf"] = _below_map(draw, bsdf)
    if not case["param"].endswith(MOVES):  # names of materials are others now
        objects = [name for name in shapes if name.startswith("object")]
        if objects and draw.chance(0.7):
            name = draw.one(objects)
            analytic = scene[name]["type"] in ("sphere", "disk", "cylinder", "rectangle")
            case["param"] = f"{name}.{'to_world' if analytic else 'vertex_positions'}"
        else:
            case["param"] = "camera.to_world"
        case["how"] = {draw.one(["direction", "rotate"]): draw.unit()}
    return case


def _may_have_map(item: dict) -> bool:
    return "bsdf" in item and item["bsdf"]["type"] != "roughdielectric"


def _below_map(draw: Draw, bsdf: dict) -> dict:
    side = draw.weighted(TEXELS)
    if draw.chance(0.35):
        picture = {"type": "bitmap", "texels": draw.texels(side, side, 0, 1)}
        return {"type": "bumpmap", "arbitrary": picture, "scale": draw.number(0.02, 0.6) / side, "bsdf": bsdf}
    steep = draw.one([0.1, 0.3, 0.8])
    bent = np.stack([draw.rng.uniform(-steep, steep, (side, side)) for _ in range(2)] + [np.ones((side, side))], -1)
    if draw.chance(FLAT_IN_PART):
        bent[: side // 2 + 1, :, :2] = 0
    bent = 0.5 + 0.5 * bent / np.linalg.norm(bent, axis=-1, keepdims=True)
    picture = {"type": "bitmap", "texels": np.round(bent, 3).tolist()}
    return {"type": "normalmap", "normalmap": picture, "flip_invalid_normals": draw.chance(0.8), "bsdf": bsdf}
