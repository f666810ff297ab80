"""How often samples of each pixel have found something, where finds are what a sample's time goes into."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .varying import varying


class FilmTally:
    """Numbers of finds on the pixels of the crop window. Host object with a device table."""

    def __init__(self, film: mi.Film):
        self._size, self._offset = tuple(map(int, film.crop_size())), tuple(map(int, film.crop_offset()))
        self._finds = dr.zeros(mi.UInt32, self._size[0] * self._size[1])
        dr.make_opaque(self._finds)

    def add(self, p: mi.Point2f) -> None:
        """One find at each of the film positions `p` [px]; beside the window, of the nearest pixel."""
        q = mi.Point2i(dr.floor(p - varying(mi.Point2f, self._offset)))
        q = mi.Point2u(dr.clip(q, 0, varying(mi.Point2i, self._size) - 1))
        pixel = q.y * varying(mi.UInt32, self._size[0]) + q.x
        dr.scatter_add(self._finds, dr.full(mi.UInt32, 1, dr.width(p)), pixel)

    @property
    def finds(self) -> np.ndarray:
        """(H, W)."""
        return np.array(self._finds, np.float64).reshape(self._size[::-1])
