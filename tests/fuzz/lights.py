"""Random lights above the scene."""

from __future__ import annotations

from fuzz.draw import Draw

Movable = dict[str, list[tuple[str, dict]]]

KINDS = ("rectangle", "sphere", "disk", "mesh", "point", "spot", "directional", "constant", "envmap")


def some(draw: Draw, movable: Movable) -> dict:
    """One or two of them, by name."""
    found = {}
    for k in range(draw.weighted({1: 3, 2: 2})):
        kind = draw.weighted({"rectangle": 5, "sphere": 2, "disk": 1, "mesh": 2, "point": 3, "spot": 2,
                              "directional": 2, "constant": 2, "envmap": 2})  # fmt: skip
        if kind in ("constant", "envmap") and any(light["type"] in ("constant", "envmap") for light in found.values()):
            kind = "point"  # a scene has one environment
        found[f"light{k}"] = _light(draw, kind, f"light{k}", movable)
    return found


def _light(draw: Draw, kind: str, name: str, movable: Movable) -> dict:
    place = [draw.number(-1.5, 1.5), draw.number(1.8, 2.6), draw.number(-0.5, 1.5)]
    target = [draw.number(-0.5, 0.5), 0, draw.number(-0.5, 0.5)]
    aim = ["look_at", place, target, [0.1, 0, 1]]
    moves, turns = {"direction": draw.unit()}, {"rotate": draw.unit()}
    if kind in ("rectangle", "sphere", "disk", "mesh"):
        return _area(draw, kind, name, aim, movable)
    if kind == "point":
        movable["light"].append((f"{name}.position", moves))
        return {"type": "point", "position": place, "intensity": draw.number(5, 12)}
    if kind == "spot":
        movable["light"] += [(f"{name}.to_world", moves), (f"{name}.to_world", turns)]
        return {"type": "spot", "to_world": [aim], "intensity": draw.number(10, 20),
                "cutoff_angle": draw.number(25, 40, 1), "beam_width": draw.number(5, 18, 1)}  # fmt: skip
    movable["light"].append((f"{name}.to_world", turns))
    if kind == "directional":
        return {"type": "directional", "to_world": [aim], "irradiance": draw.number(1, 3)}
    if kind == "envmap":
        turned = ["rotate", draw.unit(), draw.number(0, 180, 1)]
        return {"type": "envmap", "texels": draw.texels(4, 8, 0.1, 1.5), "to_world": [turned]}
    movable["light"][-1] = (f"{name}.radiance.value", {})
    return {"type": "constant", "radiance": draw.number(0.3, 1)}


def _area(draw: Draw, kind: str, name: str, aim: list, movable: Movable) -> dict:
    param = f"{name}.vertex_positions" if kind == "mesh" else f"{name}.to_world"
    movable["light"] += [(param, {"direction": draw.unit()}), (param, {"rotate": draw.unit()})]
    movable["value"].append((f"{name}.emitter.radiance.value", {}))
    shape = {"type": kind, "to_world": [aim, ["scale", draw.number(0.15, 0.45)]]}
    if kind == "mesh":
        smooth = draw.chance(0.4)
        shape |= {"mesh": draw.one(["box", "ball", "prism"]), "segments": draw.one([5, 8]), "smooth": smooth}
    return {**shape, "emitter": {"type": "area", "radiance": draw.number(4, 12)}}
