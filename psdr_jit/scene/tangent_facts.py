"""What moves, and how fast, once the direction of the derivative is known (forward mode only).

Tangents are those that `dr.forward` or `mi.render` has left on the scene's parameters.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.ad import array_of, tangents
from ..core.compat import VERTEX_NORMALS, mesh_positions
from ..core.joining import joined
from ..core.memory import Memory
from .facts import SceneFacts, analyse

#: Deviation from a common rigid motion that counts as rounding, relative to the largest speed.
RIGID = 1e-5

#: Points of an object's own frame whose motion is that of the frame.
FRAME = np.array([[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]], float).T


def facts_along_tangents(scene: mi.Scene, sensor: mi.Sensor, memory: Memory | None = None) -> SceneFacts:
    """The facts with only those parameters enabled that have a tangent; none, if all moves as one rigid body."""
    facts = analyse(scene, sensor, has_tangent, memory)
    only_poses = not any(s.material or set(s.shading) - {VERTEX_NORMALS} for s in facts.shapes)
    only_poses &= not any(e.radiance for e in facts.emitters)
    if facts.geometry_moves and only_poses and moves_as_one(scene, sensor, facts):
        still = analyse(scene, sensor, lambda value: False, memory)
        return replace(still, still="everything moves together, as one rigid body")
    return facts if facts.anything_enabled else replace(facts, still="no parameter has a tangent in this direction")


def has_tangent(value) -> bool:
    """Is the tangent of this parameter value anything but 0?"""
    with dr.resume_grad():
        grad = dr.grad(array_of(value))
    return bool(np.any(np.array(grad)))


def vertex_speeds(meshes: tuple[mi.Mesh, ...]) -> mi.Float:
    """Speed of every vertex, mesh after mesh. Detached."""
    with dr.resume_grad():
        velocities = tangents(*(mesh_positions(mesh) for mesh in meshes))
    velocities = velocities if len(meshes) > 1 else (velocities,)
    return joined([dr.norm(mi.Vector3f(v)) for v in velocities])


def moves_as_one(scene: mi.Scene, sensor: mi.Sensor, facts: SceneFacts) -> bool:
    """Do all shapes, lights and the sensor share one rigid motion, to first order? Then no image changes."""
    if facts.sensor.pose != ("to_world",):
        return False
    points, turns = [_frame_motion(sensor)], []
    for shape, facts_of in zip(scene.shapes(), facts.shapes, strict=False):
        if facts_of.index < 0 or not facts_of.moves or facts_of.kind in ("curve", "grid", "ellipsoids"):
            return False
        points.append(_mesh_motion(shape) if facts_of.is_mesh else _frame_motion(shape))
        if facts_of.shading:
            turns.append(_normal_motion(shape))
    for emitter, facts_of in zip(scene.emitters(), facts.emitters, strict=True):
        if facts_of.shape >= 0 or facts_of.plugin == "constant":
            continue
        if facts_of.pose not in (("to_world",), ("position",)):
            return False
        moved = _point_motion(emitter) if facts_of.pose == ("position",) else _frame_motion(emitter)
        if facts_of.infinite:  # only its directions matter
            turns.append((moved[0][1:] - moved[0][0], moved[1][1:] - moved[1][0]))
        else:
            points.append(moved)
    return _is_rigid(points, turns)


def _is_rigid(points: list, turns: list) -> bool:
    """Is there one v(x) = a + ω × x for all `points`, (positions, velocities), whose ω also makes the `turns`?"""
    x, v = (np.concatenate([p[k] for p in points]) for k in (0, 1))
    d, turned = (np.concatenate([t[k] for t in turns]) if turns else np.zeros((0, 3)) for k in (0, 1))
    directions = np.concatenate([x, d])
    matrix = np.zeros((len(directions), 3, 6))
    matrix[: len(x), :, :3] = np.eye(3)
    for axis in range(3):
        matrix[:, :, 3 + axis] = np.cross(np.eye(3)[axis], directions)
    wanted = np.concatenate([v, turned])
    twist = np.linalg.lstsq(matrix.reshape(-1, 6), wanted.ravel(), rcond=None)[0]
    return bool(np.abs(matrix @ twist - wanted).max() <= RIGID * np.abs(wanted).max())


def _mesh_motion(mesh: mi.Mesh) -> tuple[np.ndarray, np.ndarray]:
    with dr.resume_grad():
        positions = mesh_positions(mesh)
        velocity = tangents(positions)
    return np.array(dr.detach(positions), float).T, np.array(velocity, float).T


def _normal_motion(mesh: mi.Mesh) -> tuple[np.ndarray, np.ndarray]:
    with dr.resume_grad():
        n = mi.Normal3f(mesh.vertex_normal(dr.arange(mi.UInt32, mesh.vertex_count())))
        turn = tangents(n)
    return np.array(dr.detach(n), float).T, np.array(turn, float).T


def _frame_motion(node: mi.Object) -> tuple[np.ndarray, np.ndarray]:
    with dr.resume_grad():
        matrix = mi.traverse(node)["to_world"].matrix
        value, grad = (np.array(m, float).reshape(4, 4) for m in (dr.detach(matrix), dr.grad(matrix)))
    return (value @ FRAME)[:3].T, (grad @ FRAME)[:3].T


def _point_motion(node: mi.Object) -> tuple[np.ndarray, np.ndarray]:
    with dr.resume_grad():
        position = mi.traverse(node)["position"]
        return np.array(dr.detach(position), float).reshape(1, 3), np.array(dr.grad(position), float).reshape(1, 3)
