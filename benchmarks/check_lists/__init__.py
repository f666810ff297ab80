"""What `checks.py` can look at besides the shipped scenes: lists of one kind of surface in everything that can happen.

    smooth     smooth-shaded meshes × materials × motions × path lengths
    patterns   steps inside surfaces × motions, near and behind a bounce; pictures and cones that lights bring along
    specular   mirrors, glass, plastic, windows and masks
    caustics   what glass and mirrors gather, by `psdr_bdpt`

Scenes are made here, apart from those of the charts and of the tests. Nothing in them is symmetric: a difference across
a coordinate that is zero cannot tell a sign.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from benchmarks.check_lists.caustics import caustics
from benchmarks.check_lists.common import Listed
from benchmarks.check_lists.patterns import patterns
from benchmarks.check_lists.smooth import smooth
from benchmarks.check_lists.specular import specular

LISTS: dict[str, Callable[[], Iterator[Listed]]] = {
    "smooth": smooth, "patterns": patterns, "specular": specular, "caustics": caustics,
}  # fmt: skip
