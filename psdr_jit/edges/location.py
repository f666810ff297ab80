"""Where on which edge: what travels from the sampling of an edge to its motion."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class EdgeLocation:
    """A point of the edge table; detached, one entry per sample."""

    row: mi.UInt32  # of the table
    t: mi.Float  # parameter in [0, 1) along the row
    x: mi.Point3f  # the point [m]
    local: mi.Point3f  # on a contour, which is elsewhere for every viewpoint: its material point, in object space
    scale: mi.Float  # on a contour: size of its shape [m]
