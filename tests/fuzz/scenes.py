"""A seed makes a small scene, one parameter, one direction and an integrator, as plain data that can be printed.

Drawn from what the support table (`psdr_jit.scene.capabilities.SUPPORT`) answers with "yes". `build` makes a Mitsuba
scene of it. The data is that of `mi.load_dict`, with poses as lists of steps, meshes by name, textures as texels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from fuzz import lights, materials
from fuzz.draw import Draw
from fuzz.meshes import CLOSED, MESHES, OPEN

Case = dict[str, Any]  # seed, scene, param, how (keywords of `perturb`), integrator

SALT = 0x5CE4E  # keeps these streams apart from others with the same seeds
ANALYTIC = ("rectangle", "disk", "sphere", "cylinder")
SOLID = (*CLOSED, "cube", "sphere")
CUTTABLE = (*MESHES, "cube", "sphere")  # whose curve with a mesh is looked for
FLOOR_SIZE = 2.5  # half a side [scene units]
DISTANCE = 4.0  # of the camera from the middle of the scene
TRIES = 20  # to find a place where a disk or a cylinder cuts nothing
LIFT = 0.05  # of glass above what it would rest on


def case_of(seed: int) -> Case:
    """The case of this seed, always the same."""
    draw = Draw(np.random.default_rng([SALT, seed]))
    movable: dict[str, list[tuple[str, dict]]] = {"shape": [], "camera": [], "light": [], "value": []}
    scene = {"type": "scene", **_floor(draw, movable), **_objects(draw, movable)}
    scene |= lights.some(draw, movable)
    scene["camera"] = _camera(draw, movable)
    kind = draw.weighted({"shape": 12, "camera": 3, "light": 2, "value": 3})
    param, how = draw.one(movable[kind] or movable["shape"])
    return {"seed": seed, "scene": scene, "param": param, "how": how, "integrator": _integrator(draw)}


def _integrator(draw: Draw) -> dict:
    spec = {"type": "psdr_path", "max_depth": draw.weighted({1: 1, 2: 4, 3: 4, 4: 2}),
            "form": draw.weighted({"spatial": 3, "material": 2, "mixed": 1, "auto": 2}),
            "rr_depth": draw.weighted({1000: 4, 2: 1})}  # fmt: skip
    return {**spec, "hide_emitters": True} if draw.chance(0.12) else spec


# ------------------------------------------------------------------------------------------ shapes


def _floor(draw: Draw, movable: dict) -> dict:
    """What the objects stand on, its top at height 0; sometimes nothing."""
    kind = draw.weighted({"rectangle": 5, "sheet": 1, "slab": 2, "": 1})
    if not kind:
        return {}
    bsdf = materials.reflecting(draw, "floor.bsdf", movable, textured=0.35)
    if kind == "rectangle":
        shape = {"type": "rectangle", "to_world": [["rotate", [1, 0, 0], -90], ["scale", FLOOR_SIZE]]}
    elif kind == "slab":
        shape = {"type": "cube", "to_world": [["translate", [0, -0.1, 0]], ["scale", [FLOOR_SIZE, 0.1, FLOOR_SIZE]]]}
    else:
        steps = [["translate", [0, -0.25, 0]], ["scale", [FLOOR_SIZE, 0.8, FLOOR_SIZE]]]
        shape = {"type": "mesh", "mesh": "sheet", "segments": 8, "smooth": draw.chance(0.5), "to_world": steps}
    shape["bsdf"] = bsdf
    _add_motion(draw, movable, "floor", shape)
    return {"floor": shape}


def _objects(draw: Draw, movable: dict) -> dict:
    placed: list[tuple[str, np.ndarray, float]] = []
    shapes = {}
    for k in range(draw.weighted({1: 3, 2: 4, 3: 2})):
        name = f"object{k}"
        kind = draw.one([*ANALYTIC, "cube", *CLOSED, *CLOSED, *OPEN])
        size = draw.number(0.25, 0.6)
        centre, turned = _place(draw, kind, size, placed)
        placed.append((kind, np.array(centre), size))
        shape = _shape(draw, kind)
        steps = [["translate", centre]]
        if turned == "any":
            steps.append(["rotate", draw.unit(), draw.number(0, 180, 1)])
        elif turned == "upright":
            steps.append(["rotate", [0, 1, 0], draw.number(0, 180, 1)])
        shape["to_world"] = [*steps, ["scale", size]]
        if draw.chance(0.12):
            shape["emitter"] = {"type": "area", "radiance": draw.number(1, 4)}
            movable["value"].append((f"{name}.emitter.radiance.value", {}))
        else:
            shape["bsdf"] = materials.any_of(draw, f"{name}.bsdf", movable, closed=kind in SOLID)
            if turned == "upright" and shape["bsdf"]["type"] == "roughdielectric":
                # what is seen of a floor that coincides with the glass is rounding, and the image jumps as they part
                lift(shape)
        for _ in range(3):  # objects are moved more often than floors
            _add_motion(draw, movable, name, shape)
        shapes[name] = shape
    return shapes


def lift(shape: dict) -> None:
    """Raise a shape off what it would rest on."""
    _, (x, y, z) = shape["to_world"][0]
    shape["to_world"][0] = ["translate", [x, round(y + LIFT, 3), z]]


def _shape(draw: Draw, kind: str) -> dict:
    if kind not in MESHES:
        return {"type": kind}
    segments = draw.one([6, 8, 12, 16] if kind in ("ball", "torus") else [3, 5, 7])
    return {"type": "mesh", "mesh": kind, "segments": segments, "smooth": draw.chance(0.4)}


def _place(draw: Draw, kind: str, size: float, placed: list) -> tuple[list[float], str]:
    """Centre of an object, and how it may be turned: above the floor, on it, sunk into it or into another one."""
    for _ in range(TRIES):
        x, z = draw.number(-0.8, 0.8), draw.number(-0.8, 0.8)
        if kind not in CUTTABLE:
            centre, turned = [x, round(1.8 * size + draw.number(0.05, 0.5), 3), z], "any"
        else:
            way = draw.weighted({"above": 3, "on": 2, "sunk": 3, "into": 2 if placed else 0})
            centre, turned = _by_way(draw, way, [x, 0, z], size, placed)
        if all(_may_meet(kind, other) or np.linalg.norm(np.array(centre) - c) > 2 * (size + s)
               for other, c, s in placed):  # fmt: skip
            break
    return centre, turned


def _may_meet(kind: str, other: str) -> bool:
    return kind in CUTTABLE and other in CUTTABLE and not kind == other == "sphere"


def _by_way(draw: Draw, way: str, centre: list, size: float, placed: list) -> tuple[list[float], str]:
    x, _, z = centre
    if way == "above":
        return [x, round(1.8 * size + draw.number(0.02, 0.5), 3), z], "any"
    if way == "on":
        return [x, size, z], "upright"
    if way == "sunk":
        return [x, round(size * draw.number(0, 0.8), 3), z], "any"
    _, other, s = draw.one(placed)
    apart = np.array(draw.unit()) * draw.number(0.5, 0.9) * (size + s)
    return [round(float(v), 3) for v in other + apart], "any"


def _add_motion(draw: Draw, movable: dict, name: str, shape: dict) -> None:
    """One random motion of this shape: moved, turned, or one vertex of it."""
    param = f"{name}.to_world" if shape["type"] in ANALYTIC else f"{name}.vertex_positions"
    ways = {"move": 3, "turn": 0 if shape["type"] == "sphere" else 2, "vertex": 2 if shape["type"] == "mesh" else 0}
    way = draw.weighted(ways)
    if way == "vertex":  # of the mesh in `build`, whose corners are shared by its faces
        count = len(MESHES[shape["mesh"]](shape["segments"])[0])
        movable["shape"].append((param, {"index": int(draw.rng.integers(3 * count))}))
    else:
        movable["shape"].append((param, {"direction" if way == "move" else "rotate": draw.unit()}))


# ------------------------------------------------------------------------------------------ sensors


def _camera(draw: Draw, movable: dict) -> dict:
    turn, height = np.deg2rad(draw.number(-60, 60, 1)), np.deg2rad(draw.number(8, 65, 1))
    origin = DISTANCE * np.array([np.sin(turn) * np.cos(height), np.sin(height), np.cos(turn) * np.cos(height)])
    aim = ["look_at", [round(float(v), 3) for v in origin], [draw.number(-0.2, 0.2), 0.3, 0], [0, 1, 0]]
    camera = {"type": draw.weighted({"perspective": 6, "thinlens": 2, "orthographic": 2}), "film": _film(draw)}
    camera["to_world"] = [aim]
    if camera["type"] == "orthographic":
        camera["to_world"].append(["scale", draw.number(1.2, 1.8)])
    else:
        camera["fov"] = draw.number(28, 50, 1)
        movable["camera"].append(("camera.x_fov", {}))
    if camera["type"] == "thinlens":
        camera |= {"aperture_radius": draw.number(0.02, 0.15), "focus_distance": draw.number(3, 5)}
        movable["camera"] += [("camera.aperture_radius", {}), ("camera.focus_distance", {})]
    for _ in range(2):
        movable["camera"].append(("camera.to_world", {draw.one(["direction", "rotate"]): draw.unit()}))
    return camera


def _film(draw: Draw) -> dict:
    size = draw.one([16, 20, 24])
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "luminance",
            "rfilter": {"type": draw.one(["box", "gaussian", "tent"])}}  # fmt: skip
    if draw.chance(0.2):
        film |= {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": size - 6, "crop_height": size - 4}
    return film
