"""Random materials: whatever is supported while geometry moves, one level of nesting deep."""

from __future__ import annotations

from fuzz.draw import Draw

Movable = dict[str, list[tuple[str, dict]]]


def any_of(draw: Draw, path: str, movable: Movable, closed: bool) -> dict:
    """A material of an object; `path` is its name among the scene's parameters. Glass for closed shapes only."""
    if closed and draw.chance(0.15):
        return rough_glass(draw, path, movable)
    return reflecting(draw, path, movable)


def reflecting(draw: Draw, path: str, movable: Movable, textured: float = 0.2) -> dict:
    """One-sided or two-sided, and sometimes a blend of two."""
    if draw.chance(0.6):
        return {"type": "twosided", "bsdf": _one_sided(draw, f"{path}.brdf_0", movable, textured)}
    return _one_sided(draw, path, movable, textured)


def _one_sided(draw: Draw, path: str, movable: Movable, textured: float) -> dict:
    if draw.chance(0.12):
        return blend(draw, path, movable, textured)
    return _plain(draw, path, movable, textured)


def _plain(draw: Draw, path: str, movable: Movable, textured: float) -> dict:
    make = draw.weighted({diffuse: 5, rough_conductor: 1, rough_plastic: 1, principled: 1})
    return make(draw, path, movable, textured)


def blend(draw: Draw, path: str, movable: Movable, textured: float) -> dict:
    parts = {f"bsdf_{k}": _plain(draw, f"{path}.bsdf_{k}", movable, 0.0) for k in range(2)}
    return {"type": "blendbsdf", "weight": colour(draw, f"{path}.weight", movable, textured), **parts}


def diffuse(draw: Draw, path: str, movable: Movable, textured: float) -> dict:
    return {"type": "diffuse", "reflectance": colour(draw, f"{path}.reflectance", movable, textured)}


def rough_conductor(draw: Draw, path: str, movable: Movable, _: float) -> dict:
    bsdf = {"type": "roughconductor", "distribution": draw.one(["ggx", "beckmann"])}
    movable["value"].append((f"{path}.alpha.value", {}))
    return {**bsdf, "alpha": draw.number(0.25, 0.6)}


def rough_plastic(draw: Draw, path: str, movable: Movable, textured: float) -> dict:
    reflectance = colour(draw, f"{path}.diffuse_reflectance", movable, textured)
    return {"type": "roughplastic", "alpha": draw.number(0.25, 0.6), "diffuse_reflectance": reflectance}


def principled(draw: Draw, path: str, movable: Movable, textured: float) -> dict:
    movable["value"].append((f"{path}.roughness.value", {}))
    return {"type": "principled", "base_color": colour(draw, f"{path}.base_color", movable, textured),
            "roughness": draw.number(0.4, 0.8), "metallic": draw.one([0.0, 0.5]), "specular": 0.5}  # fmt: skip


def rough_glass(draw: Draw, path: str, movable: Movable) -> dict:
    movable["value"].append((f"{path}.alpha.value", {}))
    return {"type": "roughdielectric", "alpha": draw.number(0.3, 0.6), "int_ior": draw.number(1.2, 1.6)}


def colour(draw: Draw, path: str, movable: Movable, textured: float) -> dict | float:
    """A grey, or a picture of a few texels, interpolated."""
    if draw.chance(textured):
        movable["value"].append((f"{path}.data", {}))
        return {"type": "bitmap", "texels": draw.texels(4, 4, 0.1, 0.9)}
    movable["value"].append((f"{path}.value", {}))
    return draw.number(0.2, 0.8)
