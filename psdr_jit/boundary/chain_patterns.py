"""Steps inside surfaces that chains meet: checkerboards, texel borders, slopes of bump maps, faces of one colour each.

A family of lines a·(u, v) + b = k (`scene/patterns.py`) divides a surface into cells ⌊a·(u, v) + b⌋. Two chains that
end in different cells have crossed a line, on which F = a·(u, v) + b − k = 0; where the texture coordinates of a round
shape start anew, F is the distance from there. Attributes by face step along the edges of a mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.upload import uploaded
from ..edges.scene_patterns import steps_of
from ..plan.job import Job
from ..plan.probe_motion import registry_table

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

    families: Family  # number 0 has no lines
    start: mi.UInt32  # by registry index of a shape: number of its first family
    count: mi.UInt32  # and how many it has
    most: int
    by_face: mi.UInt32  # by registry index: 1 if the faces differ
    seam: mi.UInt32  # by registry index: the texture coordinate that starts anew, plus 1; 0: none does

    @staticmethod
    def of(job: Job) -> ChainPatterns | None:
        """None if nothing steps."""
        chosen = [s for s in job.facts.shapes if s.patterns and s.index >= 0]
        if not chosen:
            return None
        found = [steps_of(job, facts) for facts in chosen]
        columns, start, count = [(0.0, 0.0, 0.0, 0.0, 0.0)], [], []
        for families, _ in found:
            start.append(len(columns))
            count.append(len(families))
            columns += [(*f.a, f.b, max(f.first, -LARGEST), min(f.last, LARGEST)) for f in families]
        a0, a1, b, first, last = (uploaded(mi.Float, np.array(column)) for column in zip(*columns, strict=True))

        def by_registry(values: list[int]) -> mi.UInt32:
            tables = (registry_table(job.scene, {s.index}) * v for s, v in zip(chosen, values, strict=True))
            return sum(tables, registry_table(job.scene, set()))

        faces = [int(between_faces) for _, between_faces in found]
        seams = [SEAMS.get(s.plugin, 0) for s in chosen]
        families = Family(mi.Vector2f(a0, a1), b, first, last)
        tables = [by_registry(values) for values in (start, count, faces, seams)]
        dr.eval(families, tables)
        return ChainPatterns(families, tables[0], tables[1], max(count), tables[2], tables[3])

    def crossed(self, a, b, active: mi.Bool) -> tuple[mi.Bool, mi.UInt32, mi.Float]:
        """`(has one been, its family, where)` between two hits of one surface; no family: it was an edge between faces.

        Where: the share of the way from a to b, as if texture coordinates changed evenly.
        """
        shape = dr.select(active, dr.reinterpret_array(mi.UInt32, a.shape), 0)
        start, count = dr.gather(mi.UInt32, self.start, shape), dr.gather(mi.UInt32, self.count, shape)
        differs = active & (dr.gather(mi.UInt32, self.by_face, shape) != 0) & (a.prim_index != b.prim_index)
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
        seam = dr.gather(mi.UInt32, self.seam, dr.reinterpret_array(mi.UInt32, a.shape), number != NO_FAMILY)
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
