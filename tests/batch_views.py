"""A shipped scene seen by several sensors at once."""

from __future__ import annotations

import mitsuba as mi

from psdr_jit.scene import io as scene_io

RES, VIEWS = 24, 3
ORIGINS = ([0.7, 2.2, 4], [-1.5, 1.8, 3.5], [2.5, 2.0, 2.5])


def batch_of(scene_file: str = "point_shadow") -> mi.Scene:
    """The shipped scene seen by a batch of three sensors."""
    text = scene_io.shipped_scene(f"{scene_file}.xml").read_text()
    start, end = text.index("<sensor"), text.index("</sensor>") + len("</sensor>")

    def lookat(origin) -> str:
        where = ", ".join(map(str, origin))
        return f'<transform name="to_world"><lookat origin="{where}" target="0, -0.5, 0" up="0, 1, 0"/></transform>'

    def film(width) -> str:
        size = f'<integer name="width" value="{width}"/><integer name="height" value="{RES}"/>'
        return f'<film type="hdrfilm">{size}<string name="pixel_format" value="rgb"/></film>'

    views = "".join(
        f'<sensor type="perspective" id="view{k}"><float name="fov" value="40"/>{lookat(o)}{film(8)}</sensor>'
        for k, o in enumerate(ORIGINS)
    )
    batch = f'<sensor type="batch" id="views">{views}{film(RES * VIEWS)}</sensor>'
    return mi.load_string(text[:start] + batch + text[end:], optimize=False)
