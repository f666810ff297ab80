"""Curves along which shapes cut into each other, as rows of the edge table with a motion of their own.

A point x of the curve stays on both surfaces, so its velocity w satisfies n_a·w = n_a·v_a and n_b·w = n_b·v_b with v
the material velocities; along the curve w is arbitrary. With the dual basis g_a, g_b of the normals in their plane,

    w = g_a (n_a·v_a) + g_b (n_b·v_b),        g_a = (n_a − c n_b) / (1 − c²),  c = n_a·n_b,

which needs no derivative of the intersection points themselves.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.memory import Memory, Slot, key_of
from ..core.surface_code import registry_index
from ..core.upload import uploaded
from ..errors import UnsupportedWarning
from ..scene.names import shown_name
from . import intersections as cut
from .moved_along import segments_moved_along
from .overlaps import box_of, crossing
from .parts import crosses_itself, cut_parts
from .round_cuts import ball_mesh, cylinder_mesh
from .rows import EdgeRows
from .solids import Ball, Drum, Solid, state_of, triangles
from .topology import EdgeTopology

#: Pieces into which the full circle of a ball, or ellipse of a cylinder, in a plane is cut.
ARC_PIECES = 64

#: By two shapes: their states, and the junctions found for these.
PAIRS: Slot[dict[tuple[str | int, str | int], tuple]] = Slot(dict)

#: Edges of a mesh up to which it is looked at anew in every place whether it cuts itself: a cost per call.
FEW_EDGES = 500

#: By mesh: its topology, and whether it cut itself when that was new.
CUTTING: Slot[dict[str | int, tuple[EdgeTopology, bool]]] = Slot(dict)

#: The junctions (by identity) that were uploaded last, and their table.
UPLOADED: Slot[tuple | None] = Slot(lambda: None)


@dataclass
class Sheet:
    """One of the two surfaces at a junction; detached, one entry per junction."""

    shape: mi.UInt32  # registry index
    prim: mi.UInt32
    uv_start: mi.Point2f  # position on the primitive at both ends of the segment
    uv_end: mi.Point2f
    n: mi.Normal3f  # unit; outward where the surface is closed
    centre: mi.Point3f  # of a ball, or a point of the axis of a cylinder
    axis: mi.Vector3f  # unit, of a cylinder; 0 for others
    is_round: mi.Bool  # a ball or a cylinder


@dataclass
class JunctionRows:
    a: Sheet
    b: Sheet
    arc_centre: mi.Point3f
    arc_radius: mi.Float  # 0: a straight segment
    arc_axis: mi.Vector3f  # of the cylinder on which the arc is; 0 on balls


@dataclass(frozen=True)
class JunctionTable:
    """Junctions as rows of the edge table, and what only they have."""

    edges: EdgeRows
    rows: JunctionRows
    pairs: tuple[tuple[Solid, Solid | Ball | Drum], ...] = ()  # of what they are


def find_junctions(solids: list[Solid], balls: tuple[Ball | Drum, ...], memory: Memory) -> JunctionTable | None:
    """All intersection curves; None if there are none. Pairs whose shapes rest are taken from `memory`."""
    found, pairs, changed = [], [], False
    for a, b in _pairs(solids, balls, memory):
        key = (key_of(a.mesh), key_of(b.mesh if isinstance(b, Solid) else b.shape))
        state = (state_of(a), state_of(b))
        known = memory[PAIRS].get(key)
        if known is None or [s.key for s in known[0]] != [s.key for s in state]:
            known = (state, _within(a, memory) if a is b else _pair(a, b, memory))
            memory[PAIRS][key] = known
            changed = True
        if known[1] is not None:
            found.append(known[1])
            pairs.append((a, b))
    if not found:
        return None
    table = memory[UPLOADED]
    if changed or table is None or table[0] != [id(f) for f in found]:
        table = ([id(f) for f in found], _upload(found), found)
        memory[UPLOADED] = table
    return replace(table[1], pairs=tuple(pairs))


def _pairs(
    solids: list[Solid], balls: tuple[Ball | Drum, ...], memory: Memory
) -> list[tuple[Solid, Solid | Ball | Drum]]:
    """Pairs that may intersect, by their bounding boxes; at least one is a mesh. A mesh of several surfaces, or that
    cuts itself, pairs with itself.
    """
    items = [*solids, *balls]
    boxes = [box_of(item.mesh if isinstance(item, Solid) else item.shape) for item in items]
    pairs = [(items[i], items[j]) for i, j in crossing(boxes) if i < len(solids)]
    return pairs + [(solid, solid) for solid in solids if solid.parts or _cuts_itself(solid, memory)]


def _cuts_itself(solid: Solid, memory: Memory) -> bool:
    """Does, or may, a connected surface of the mesh cut itself? A large one is looked at when its topology is new."""
    key = key_of(solid.mesh)
    known = memory[CUTTING].get(key)
    if known is None or known[0] is not solid.topology:
        known = (solid.topology, len(solid.topology) <= FEW_EDGES or _crosses(solid))
        memory[CUTTING][key] = known
    return known[1]


def _crosses(solid: Solid) -> bool:
    """Does a connected surface of the mesh cut itself? Not where it would take too long to know: that is rare."""
    try:
        return crosses_itself(triangles(solid), solid.parts)
    except cut.TooManyPairs:
        return False


def _pair(a: Solid, b: Solid | Ball | Drum, memory: Memory) -> tuple | None:
    """Columns of the junctions of one pair, as NumPy arrays: `(start, end, sheet a, sheet b, arcs, a, b)`."""
    mesh_a = triangles(a)
    if not isinstance(b, Solid):
        return _round(a, mesh_a, b)
    mesh_b = triangles(b)
    try:
        found = segments_moved_along((a, mesh_a), (b, mesh_b), memory, lambda: cut.mesh_mesh(mesh_a, mesh_b))
    except cut.TooManyPairs:
        return _too_many(f"shapes '{shown_name(a.mesh)}' and '{shown_name(b.mesh)}'")
    return _between(a, mesh_a, b, mesh_b, found)


def _round(a: Solid, mesh: cut.TriangleMesh, b: Ball | Drum) -> tuple | None:
    """As `_pair`, of a mesh and a round body."""
    if isinstance(b, Ball):
        centre, radius = b.place()
        arcs = ball_mesh(centre, radius, mesh, ARC_PIECES)
    else:
        tube = b.tube()
        centre, arcs = tube.base, cylinder_mesh(tube, mesh, ARC_PIECES)
    if len(arcs.face) == 0:
        return None
    radial = (arcs.start + arcs.end) / 2 - centre
    radial -= arcs.axis * np.einsum("ij,ij->i", radial, arcs.axis)[:, None]
    n = radial / np.linalg.norm(radial, axis=1, keepdims=True)
    sheet = _sheet(a, mesh, arcs.face, arcs.start, arcs.end)
    curve = (arcs.centre, arcs.radius, arcs.axis)
    return arcs.start, arcs.end, sheet, _round_sheet(b, n, centre, arcs.axis), curve, a, b


def _within(solid: Solid, memory: Memory) -> tuple | None:
    """As `_pair`, of the surfaces that one mesh consists of, or of one that cuts itself."""
    mesh = triangles(solid)

    def look() -> cut.Segments:
        return cut.mesh_itself(mesh) if _cuts_itself(solid, memory) else cut_parts(mesh, solid.parts)

    try:
        found = segments_moved_along((solid, mesh), (solid, mesh), memory, look)
    except cut.TooManyPairs:
        return _too_many(f"parts of shape '{shown_name(solid.mesh)}'")
    return _between(solid, mesh, solid, mesh, found)


def _too_many(which: str) -> None:
    warnings.warn(
        f"{which} overlap with too many triangles to look for the curve along which they cut into each other: its part "
        "of the derivative is missing",
        UnsupportedWarning,
        stacklevel=3,
    )


def _between(a: Solid, mesh_a: cut.TriangleMesh, b: Solid, mesh_b: cut.TriangleMesh, found: cut.Segments):
    """Columns of the junctions along the segments that were `found`; faces that are nearly parallel are left out."""
    sheet_a = _sheet(a, mesh_a, found.face_a, found.start, found.end)
    sheet_b = _sheet(b, mesh_b, found.face_b, found.start, found.end)
    steep = np.linalg.norm(np.cross(sheet_a["n"], sheet_b["n"]), axis=1) > cut.PARALLEL
    if not steep.any():
        return None
    sheet_a, sheet_b = ({k: v[steep] for k, v in sheet.items()} for sheet in (sheet_a, sheet_b))
    arcs = (np.zeros((steep.sum(), 3)), np.zeros(steep.sum()), np.zeros((steep.sum(), 3)))
    return found.start[steep], found.end[steep], sheet_a, sheet_b, arcs, a, b


def _sheet(solid: Solid, mesh: cut.TriangleMesh, face: np.ndarray, start: np.ndarray, end: np.ndarray) -> dict:
    corners = mesh.corners(face)
    n = cut.unit_normals(corners)
    shells = np.zeros(len(mesh.faces))
    shells[solid.topology.f0] = np.array(solid.shell)
    border = solid.topology.border
    shells[solid.topology.f1[~border]] = np.array(solid.shell)[~border]
    shell = shells[face]
    return {
        "shape": np.full(len(face), registry_index(solid.mesh)),
        "prim": face,
        "uv_start": cut.barycentric(start, corners)[:, 1:],
        "uv_end": cut.barycentric(end, corners)[:, 1:],
        "n": n * np.where(shell < 0, -1, 1)[:, None],
        "centre": np.zeros((len(face), 3)),
        "axis": np.zeros((len(face), 3)),
        "is_round": np.zeros(len(face), bool),
        "shell": np.abs(shell),
        "index": np.full(len(face), solid.index),
    }


def _round_sheet(body: Ball | Drum, n: np.ndarray, centre: np.ndarray, axis: np.ndarray) -> dict:
    count = len(n)
    return {
        "shape": np.full(count, registry_index(body.shape)),
        "prim": np.zeros(count, int),
        "uv_start": np.zeros((count, 2)),
        "uv_end": np.zeros((count, 2)),
        "n": n,
        "centre": np.broadcast_to(centre, (count, 3)),
        "axis": axis,
        "is_round": np.ones(count, bool),
        "shell": np.zeros(count),  # its normal turns along an arc: nothing is pruned by it
        "index": np.zeros(count, int),
    }


def _upload(found: list[tuple]) -> JunctionTable:
    """Concatenate the pairs and turn them into device arrays."""
    start, end = (np.concatenate([f[k] for f in found]) for k in (0, 1))
    a, b = ({key: np.concatenate([f[k][key] for f in found]) for key in found[0][k]} for k in (2, 3))
    centre, radius, axis = (np.concatenate([f[4][k] for f in found]) for k in (0, 1, 2))
    moves = np.concatenate([np.full(len(f[0]), f[5].moves or f[6].moves) for f in found])
    # The halves of the faces in front of each other make a concave edge if the edge runs along n_b × n_a.
    along = np.einsum("ij,ij->i", end - start, np.cross(b["n"], a["n"])) >= 0
    swap = ~along[:, None]
    start, end = np.where(swap, end, start), np.where(swap, start, end)
    for sheet in (a, b):
        sheet["uv_start"], sheet["uv_end"] = (
            np.where(swap, sheet["uv_end"], sheet["uv_start"]),
            np.where(swap, sheet["uv_start"], sheet["uv_end"]),
        )
    count = len(start)
    arc = a["is_round"] | b["is_round"]
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", a["n"], b["n"]), -1, 1))
    zeros = uploaded(mi.UInt32, np.zeros(count, np.uint32))
    none = mi.Vector2u(zeros, zeros)
    edges = EdgeRows(
        v0=zeros, v1=zeros, p0=_point(start), p1=_point(end),
        n0=mi.Normal3f(_point(a["n"])), n1=mi.Normal3f(_point(b["n"])),
        angle=uploaded(mi.Float, angle), blur=uploaded(mi.Float, np.zeros(count)),
        inset0=uploaded(mi.Float, np.zeros(count)), inset1=uploaded(mi.Float, np.zeros(count)),
        border=_flags(count, False), seam=_flags(count, True), smooth=_flags(count, False), pattern=_flags(count, True),
        traced=_flags(count, True), moves=uploaded(mi.Bool, moves),
        shell0=uploaded(mi.Float, np.where(arc, 0, a["shell"])),
        shell1=uploaded(mi.Float, np.where(arc, 0, b["shell"])),
        shape0=_index(a["index"]), shape1=_index(np.where(b["is_round"], a["index"], b["index"])),
        prim0=_index(a["prim"]), prim1=_index(b["prim"]), corner0=none, corner1=mi.Vector2u(none),
    )  # fmt: skip
    rows = JunctionRows(_device_sheet(a), _device_sheet(b), _point(centre), uploaded(mi.Float, radius),
                        mi.Vector3f(_point(axis)))  # fmt: skip
    dr.eval(edges, rows)
    return JunctionTable(edges, rows)


def _device_sheet(s: dict) -> Sheet:
    return Sheet(
        _index(s["shape"]), _index(s["prim"]), _point2(s["uv_start"]), _point2(s["uv_end"]),
        mi.Normal3f(_point(s["n"])), _point(s["centre"]), mi.Vector3f(_point(s["axis"])),
        uploaded(mi.Bool, s["is_round"]),
    )  # fmt: skip


def _flags(count: int, value: bool) -> mi.Bool:
    return uploaded(mi.Bool, np.full(count, value))


def _index(values: np.ndarray) -> mi.UInt32:
    return uploaded(mi.UInt32, np.asarray(values, np.uint32))


def _point(values: np.ndarray) -> mi.Point3f:
    return mi.Point3f(*(uploaded(mi.Float, column) for column in np.asarray(values, np.float32).T))


def _point2(values: np.ndarray) -> mi.Point2f:
    return mi.Point2f(*(uploaded(mi.Float, column) for column in np.asarray(values, np.float32).T))
