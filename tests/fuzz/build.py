"""From plain data to a Mitsuba scene."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mitsuba as mi
import numpy as np
from fuzz.meshes import MESHES, in_four

UV = np.array([[0.5, 0.1], [0.13, 0.21], [0.07, 0.5]])  # texture coordinates of a mesh: a slanted projection
RAW = {"raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}


def build(scene: dict[str, Any]) -> mi.Scene:
    """The scene of a case."""
    return mi.load_dict(_resolved(scene), optimize=False)


def _resolved(item: dict[str, Any]) -> Any:
    """What `mi.load_dict` takes, of one object and all that it holds."""
    made = {key: _resolved(value) if isinstance(value, dict) else value for key, value in item.items()}
    if "to_world" in made:
        made["to_world"] = pose_of(made["to_world"])
    if "texels" in made:
        grey = np.array(made.pop("texels"), dtype=np.float32)
        if made["type"] == "envmap":
            return {**made, "bitmap": mi.Bitmap(np.repeat(grey[..., None], 3, axis=2))}
        return {**made, **RAW, "bitmap": mi.Bitmap(grey if grey.ndim == 3 else grey[..., None])}
    return MADE[made["type"]](made) if made["type"] in MADE else made


def pose_of(steps: list) -> mi.ScalarTransform4f:
    """The product of the steps, the last of which is applied first."""
    pose = mi.ScalarTransform4f()
    for name, *numbers in steps:
        if name == "look_at":
            origin, target, up = numbers
            pose = pose.look_at(origin=origin, target=target, up=up)
        else:
            if name == "rotate":  # Mitsuba takes the axis as it is: one that is not of length 1 shears
                axis = np.array(numbers[0], dtype=float)
                numbers[0] = (axis / np.linalg.norm(axis)).tolist()
            pose = getattr(pose, name)(*numbers)
    return pose


def _mesh(item: dict[str, Any]) -> mi.Mesh:
    """A mesh by name; Mitsuba computes the normals of a smooth one. `divided`: each face into four."""
    points, faces = MESHES[item["mesh"]](item["segments"])
    if item.get("divided"):
        points, faces = in_four(points, faces)
    uv = points @ UV[:, :2] + 0.5
    matrix = np.array(item["to_world"].matrix, dtype=float)
    points = points @ matrix[:3, :3].T + matrix[:3, 3]
    props = mi.Properties()
    for name in ("bsdf", "emitter"):
        if name in item:
            props[name] = mi.load_dict(item[name])
    props["face_normals"] = not item["smooth"]
    mesh = mi.Mesh(item["mesh"], len(points), len(faces), has_vertex_normals=item["smooth"],
                   has_vertex_texcoords=True, props=props)  # fmt: skip
    params = mi.traverse(mesh)
    params["vertex_positions"] = points.ravel().astype(np.float32)
    params["vertex_texcoords"] = uv.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    return mesh


def _grid(item: dict[str, Any]) -> dict[str, Any]:
    """A bumpy ball, or a ring, in the unit cube."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, item.pop("values"))] * 3, indexing="ij")
    height, often, phase = item.pop("bumps")
    ring = item.pop("body") == "ring"
    f = np.hypot(np.hypot(x, y) - 0.55, z) - 0.28 if ring else np.sqrt(x * x + y * y + z * z) - 0.7
    f += (0.5 if ring else 1.0) * height * np.sin(often * x + phase) * np.cos(often * y) * np.cos(0.7 * often * z)
    return {**item, "grid": mi.TensorXf(f[..., None].astype(np.float32))}


def _curve(item: dict[str, Any]) -> mi.Shape:
    """From a file, as Mitsuba reads the points of curves."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "points.txt"
        path.write_text("".join(" ".join(map(str, p)) + "\n" for p in item.pop("points")))
        return mi.load_dict({**item, "filename": str(path)})


def _ellipsoids(item: dict[str, Any]) -> dict[str, Any]:
    bodies = np.array(item.pop("bodies"), dtype=np.float32)
    turns = bodies[:, 6:] / np.linalg.norm(bodies[:, 6:], axis=1, keepdims=True)
    given = {"centers": bodies[:, :3], "scales": bodies[:, 3:6], "quaternions": turns}
    return {**item, **{name: mi.TensorXf(np.ascontiguousarray(value)) for name, value in given.items()}}


#: What is made of shapes that are not given as Mitsuba takes them.
MADE = {"mesh": _mesh, "sdfgrid": _grid, "bsplinecurve": _curve, "linearcurve": _curve, "ellipsoids": _ellipsoids}
