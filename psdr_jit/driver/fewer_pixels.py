"""What a pilot draws in place of a large film: the same view with fewer pixels.

The variance of a pixel for a number of samples per pixel is about the same at any resolution: inside of surfaces their
samples are as many, and on an outline, of P pixels in all, √P pixels share √P times the derivative. What the pilot
keeps is no finer than `film_noise.MOST_CELLS` either way; weights made of it leave every estimate unbiased.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core.film import film_like
from ..core.sensor_frame import KINDS
from ..plan.call import Call
from .film_noise import pixels_per_cell


def on_fewer_pixels(call: Call) -> Call:
    """The call with a sensor of its own, which rests and has a pixel for each cell of `film_noise.coarse`.

    The same call where the film is no larger than that, or the sensor is of a kind that is not known inside out.
    """
    columns, rows = (int(n) for n in call.film.crop_size())
    n = pixels_per_cell(rows, columns)
    kind, ordinary = KINDS.get(call.sensor.class_name()), call.film.class_name() == "HDRFilm"
    if n == 1 or kind is None or not ordinary:
        return call
    sensor = _copy(call.sensor, kind, _fewer(call.film, n))
    return replace(call, sensor=sensor, film=sensor.film())


def _fewer(film: mi.Film, n: int) -> mi.Film:
    """With one pixel in place of n × n."""
    size, offset, crop = ([int(k) for k in v] for v in (film.size(), film.crop_offset(), film.crop_size()))
    crop = [-(-k // n) for k in crop]
    size = [max(-(-k // n), window) for k, window in zip(size, crop, strict=True)]
    offset = [min(k // n, of - window) for k, of, window in zip(offset, size, crop, strict=True)]
    return film_like(film, tuple(size), (tuple(offset), tuple(crop)), film.sample_border())


def _copy(sensor: mi.Sensor, kind: str, film: mi.Film) -> mi.Sensor:
    """The same view on another film, detached. `kind`: one of `core.sensor_frame.KINDS`."""
    given = {
        "type": kind, "film": film, "sampler": sensor.sampler(), "shutter_open": sensor.shutter_open(),
        "shutter_close": sensor.shutter_open() + sensor.shutter_open_time(),
    }  # fmt: skip
    if kind == "thinlens":
        given["aperture_radius"] = 1.0  # has to be given, see below
    with dr.suspend_grad():
        copy = mi.load_dict(given)
        params, values = mi.traverse(copy), mi.traverse(sensor)
        for name in params.keys():
            if not name.startswith(("film.", "sampler.")):
                params[name] = dr.detach(values[name])
        params.update()
    return copy
