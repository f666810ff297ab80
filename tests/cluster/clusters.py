"""What tests of workers share."""

from __future__ import annotations

from psdr_jit.scene import io as scene_io

FILE = str(scene_io.shipped_scene("cbox.xml"))
RES = {"res": 16, "max_depth": 3}
BOX = "small-box.vertex_positions"
