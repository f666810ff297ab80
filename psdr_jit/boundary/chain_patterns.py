"""Steps inside surfaces that chains meet: checkerboards, texel borders, slopes of bump maps, faces of one colour each,
seams of meshes.

A family of lines a·(u, v) + b = k (`scene/patterns.py`) divides a surface into cells ⌊a·(u, v) + b⌋. Two chains that
end in different cells have crossed a line, on which F = a·(u, v) + b − k = 0; where the texture coordinates of a round
shape start anew, F is the distance from there. Attributes by face step along the edges of a mesh, and what is stored by
vertex along some of them: they divide the mesh into charts, and two chains that end in different ones have crossed an
edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.upload import uploaded
from ..edges.copy_table import CopyTable, number_of, values_of_shapes
from ..edges.edge_shapes import edge_shapes
from ..edges.scene_patterns import steps_of
from ..edges.seams import charts
from ..edges.segments import known_topology
from ..plan.job import Job
from ..scene.facts import ShapeFacts

#: Number of no family.
NO_FAMILY = 0

#: How far beside a line its sides are looked at, in cells: textures round otherwise than what tells cells apart.
INSET = 2e-3


@dataclass
class Family:
    """Parallel lines on one shape, by number. Detached."""

    a: mi.Vector2f
    b: mi.Float
    first: mi.Float  # there is no line below this one ...
    last: mi.Float  # ... and beyond this one

    def place(self, uv: mi.Point2f) -> mi.Float:
        return dr.dot(self.a, uv) + self.b

    def cell(self, uv: mi.Point2f) -> mi.Float:
        return dr.clip(dr.floor(self.place(uv)), self.first - 1, self.last)


@dataclass(frozen=True)
class ChainPatterns:
    """All families of a scene. Host object."""

    copies: CopyTable | None  # of what instances show: shapes as the tables below know them
    families: Family  # number 0 has no lines
    start: mi.UInt32  # by registry index of a shape: number of its first family
    count: mi.UInt32  # and how many it has
    most: int
    charted: mi.UInt32  # by registry index: number of the first face in `chart`, 0: no edges are steps
    chart: mi.UInt32  # by face; number 0 is none
    seam: mi.UInt32  # by registry index: the texture coordinate that starts anew, plus 1; 0: none does

    @staticmethod
    def of(job: Job) -> ChainPatterns | None:
        """None if nothing steps."""
        shapes = list(edge_shapes(job).facts)
        found = [steps_of(job, s) if s.patterns else ([], False) for s in shapes]
        parts = [
            np.arange(s.faces) if between_faces else _charts(job, s)
            for s, (_, between_faces) in zip(shapes, found, strict=True)
        ]
        if not any(families for families, _ in found) and all(part is None for part in parts):
            return None
        columns, start, count = [(0.0, 0.0, 0.0, 0.0, 0.0)], [], []
        for families, _ in found:
            start.append(len(columns))
            count.append(len(families))
            columns += [(*f.a, f.b, max(f.first, -LARGEST), min(f.last, LARGEST)) for f in families]
        a0, a1, b, first, last = (uploaded(mi.Float, np.array(column)) for column in zip(*columns, strict=True))

        widths = [0 if part is None else len(part) for part in parts]
        faces = [1 + sum(widths[:i]) if width else 0 for i, width in enumerate(widths)]
        chart = uploaded(mi.UInt32, np.concatenate([[0], *(part for part in parts if part is not None)]))
        seams = [SEAMS.get(s.plugin, 0) if s.patterns else 0 for s in shapes]
        families = Family(mi.Vector2f(a0, a1), b, first, last)
        numbers = [s.index for s in shapes]
        tables = [
            values_of_shapes(job, dict(zip(numbers, values, strict=True)))
            for values in (start, count, faces, seams)
        ]
        dr.eval(families, tables, chart)
        return ChainPatterns(CopyTable.of(job), families, tables[0], tables[1], max(count), tables[2], chart, tables[3])

    def crossed(self, a, b, active: mi.Bool) -> tuple[mi.Bool, mi.UInt32, mi.Float]:
        """`(has one been, its family, where)` between two hits of one surface; no family: it was an edge between faces.

        Where: the share of the way from a to b, as if texture coordinates changed evenly.
        """
        shape = dr.select(active, number_of(self.copies, a), 0)
        start, count = dr.gather(mi.UInt32, self.start, shape), dr.gather(mi.UInt32, self.count, shape)
        first = dr.gather(mi.UInt32, self.charted, shape)
        charted = active & (first != 0)
        chart_a, chart_b = (dr.gather(mi.UInt32, self.chart, first + end.prim_index, charted) for end in (a, b))
        differs = charted & (chart_a != chart_b)
        number, where = mi.UInt32(NO_FAMILY), mi.Float(0.5)
        for i in range(self.most):
            family = self.family(start + i, active & (i < count))
            place_a, place_b, cell_a = family.place(a.uv), family.place(b.uv), family.cell(a.uv)
            apart = active & (i < count) & (cell_a != family.cell(b.uv))
            border = cell_a + dr.select(place_b > place_a, 1, 0)
            where = dr.select(apart & ~differs, (border - place_a) / (place_b - place_a), where)
            number = dr.select(apart & ~differs, start + i, number)
            differs |= apart
        return differs, number, where

    def family(self, number: mi.UInt32, active) -> Family:
        return dr.gather(Family, self.families, number, active)

    def line(self, number: mi.UInt32, a, b) -> tuple[mi.Vector2f, mi.Float, mi.Float]:
        """Of the line between two hits, `(g, F, side)`: F at the first, which changes by g·(du, dv), and on which
        side that is meant to be, ±1.
        """
        family = self.family(number, number != NO_FAMILY)
        cell_a, cell_b = family.cell(a.uv), family.cell(b.uv)
        F, side = family.place(a.uv) - dr.maximum(cell_a, cell_b), dr.select(cell_a > cell_b, mi.Float(1), -1)
        seam = dr.gather(mi.UInt32, self.seam, number_of(self.copies, a), number != NO_FAMILY)
        s = dr.select(seam == 1, a.uv.x, a.uv.y)
        F_seam = s - dr.round(s)
        anew = (seam != 0) & (dr.abs(F_seam) * dr.norm(family.a) < dr.abs(F))
        along = dr.select(seam == 1, mi.Vector2f(1, 0), mi.Vector2f(0, 1))
        side = dr.select(anew, dr.select(s < 0.5, mi.Float(1), -1), side)
        return dr.select(anew, along, family.a), dr.select(anew, F_seam, F), side


#: Texture coordinate, plus 1, that starts anew on round shapes.
SEAMS = {"sphere": 1, "cylinder": 1, "disk": 2}

#: Numbers of lines are floats: no line lies beyond this one.
LARGEST = 2.0**24


def _charts(job: Job, facts: ShapeFacts) -> np.ndarray | None:
    """(F,) the chart of each face of a mesh; None: it has no seams."""
    if facts.kind != "mesh" or not (facts.smooth or facts.painted):
        return None
    mesh = edge_shapes(job).shapes[facts.index]
    topology = known_topology(mesh, job.call.memory)
    return charts(mesh, facts.painted, (topology.host, topology.device), job.call.memory)
