"""Patches of surfaces with bump or normal maps as one sensor sees them: which of them curves may cross there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from ..core.sensor_frame import SensorFrame, towards_viewer, viewpoint
from .bent_cells import Cell, Cells, uniform_cell
from .bent_looks import ON_TRIANGLE, Looks, Seen, least, most
from .bent_rows import BentRows
from .bent_surface import BentSurface
from .film_cover import LEAST_LENGTH, LENS_CENTRE, PatchOnFilm
from .points import facing
from .surface_points import SurfacePoint

#: How much farther normals may be bent elsewhere, as a factor.
BENT_FARTHER = 1.5

#: Samples of a patch on the film for each that finds a curve on it, about: weighed thrice, the variance was least.
TRIES = 3.0

#: How far beside the film patches are cut into cells [px]: about as far as reconstruction filters reach.
BESIDE_FILM = 4


@dataclass(frozen=True)
class SeenPatches:
    """Those of `rows`."""

    rows: BentRows
    surface: BentSurface
    frame: SensorFrame

    @cached_property
    def corners(self) -> list[SurfacePoint]:
        q = (self.rows.q0, self.rows.q1, self.rows.q2)
        return [self.surface.place(self.rows, corner, mi.Bool(True)) for corner in q]

    @cached_property
    def looks(self) -> Looks:
        places = [mi.Point2f(*place) for place in ON_TRIANGLE.places]
        looks = Looks.of(self.surface, self.rows, places, ON_TRIANGLE)
        dr.eval(looks.at)
        return looks

    def film_weights(self, border: int) -> mi.Float:
        """By row, the size of the patch on the film [px], in proportion to the step and to how much of it is crossed by
        curves.
        """
        crossed = self.looks.step * self._seen.crossed()
        if self._cells is not None:
            crossed = dr.select(self._cells.number > 0, self._cells.crossed(self.rows), crossed)
        return dr.select(self._may_turn, self._cover(border, TRIES * crossed), 0)

    def cell(self, row: mi.UInt32, rows: BentRows, t: mi.Float, active: mi.Bool) -> Cell:
        """The texel of `row` that t ∈ [0, 1) picks; `rows`: what it is like."""
        return uniform_cell(rows, t, active) if self._cells is None else self._cells.pick(row, rows, t, active)

    @cached_property
    def _cells(self) -> Cells | None:
        wanted = self._may_turn & (self._cover(BESIDE_FILM, mi.Float(LEAST_LENGTH)) > 0)
        pixels = self.frame.crop_size[0] * self.frame.crop_size[1]
        return Cells.of(self.surface, self.rows, wanted, self._eye, self._slack, pixels)

    @property
    def _eye(self) -> mi.Vector4f:
        return viewpoint(self.frame, mi.Point2f(LENS_CENTRE))

    @property
    def _slack(self) -> mi.Float:
        """How far viewpoints may be from there [m]."""
        return self.frame.aperture if self.frame.kind == "thinlens" else mi.Float(0)

    @cached_property
    def _seen(self) -> Seen:
        return self.looks.seen(self._eye, self._slack)

    def _cover(self, border: int, share: mi.Float) -> mi.Float:
        """By row, the size of the patch on the film times `share` [px]."""
        patch = PatchOnFilm.of([corner.x for corner in self.corners], self.frame)
        size = dr.norm(patch.upper - patch.lower)
        return patch.cover(self.frame, border, size * share, size / 4 + patch.reach)

    @cached_property
    def _may_turn(self) -> mi.Bool:
        """By row: may bent normals turn from the viewer, on a side of the surface from which it may be looked at?"""
        seen, front, back = self._seen, mi.Bool(False), mi.Bool(False)
        lowest, highest = least(seen.cos), most(seen.cos)
        beyond = highest - lowest + seen.blur + BENT_FARTHER * dr.max(most(self.looks.sines))
        for corner in self.corners:
            view = towards_viewer(self._eye, corner.x)
            cos = facing(self.surface.normal(self.rows, corner), view)
            reach = self.surface.bulge * dr.norm(view) + self._slack
            front, back = front | (cos > -reach), back | (cos < reach)
        return (lowest <= beyond) & (highest >= -beyond) & ((front & self.rows.front) | (back & self.rows.back))
