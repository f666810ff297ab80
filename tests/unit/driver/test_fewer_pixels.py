"""A pilot draws large films with fewer pixels, and these see what the film's pixels do."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.driver import fewer_pixels, pilot
from psdr_jit.driver.film_noise import coarse
from psdr_jit.plan.call import Call
from psdr_jit.scene import io as scene_io

SENSORS = [
    {"type": "perspective", "fov": 40, "fov_axis": "y", "principal_point_offset_x": 0.1, "shutter_close": 0.5},
    {"type": "thinlens", "fov": 40, "aperture_radius": 0.3, "focus_distance": 3.0},
    {"type": "orthographic", "near_clip": 0.5},
]
CROPPED = {"width": 900, "height": 600, "crop_width": 690, "crop_height": 510, "crop_offset_x": 210,
           "crop_offset_y": 90, "sample_border": True, "pixel_format": "rgba"}  # fmt: skip


def call_of(sensor):
    return replace(Call(*[None] * 9), sensor=sensor, film=sensor.film())


@pytest.mark.parametrize("given", SENSORS, ids=lambda given: given["type"])
def test_the_view_stays(llvm, given):
    """Also with a crop window, whose size and place are multiples of the three pixels that become one."""
    pose = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0.2, 0], [0, 1, 0])
    sensor = mi.load_dict({**given, "to_world": pose, "film": {"type": "hdrfilm", **CROPPED}})
    small = fewer_pixels.on_fewer_pixels(call_of(sensor))
    assert tuple(small.film.size()) == (300, 200) and tuple(small.film.crop_size()) == (230, 170)
    assert small.film.sample_border() and small.film.rfilter() == sensor.film().rfilter()
    assert coarse(np.zeros((510, 690))).shape == tuple(small.film.crop_size())[::-1]
    at = mi.Point2f([0.1, 0.5, 0.9], [0.8, 0.5, 0.3])
    (seen, _), (ray, _) = (s.sample_ray(0.1, 0.5, at, at) for s in (small.sensor, sensor))
    for value in ("o", "d", "maxt"):
        assert np.allclose(getattr(seen, value), getattr(ray, value), rtol=1e-5, atol=1e-5), value
    assert small.sensor.shutter_open_time() == sensor.shutter_open_time()


def test_small_films_and_unknown_sensors_stay(llvm):
    small = call_of(mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 256, "height": 64}}))
    assert fewer_pixels.on_fewer_pixels(small) is small
    probe = call_of(mi.load_dict({"type": "irradiancemeter", "film": {"type": "hdrfilm", "width": 600, "height": 8}}))
    assert fewer_pixels.on_fewer_pixels(probe) is probe


def test_a_pilot_of_a_large_film_draws_a_small_one(llvm, monkeypatch):
    """And tells how samples are spread over the large one; the sensor's own pose stays attached."""
    drawn, measure = [], pilot.measure

    def watched(job_of, *rest):
        drawn.append(job_of("spatial", 0, 1))
        return measure(job_of, *rest)

    monkeypatch.setattr(pilot, "measure", watched)
    scene = scene_io.load_scene(scene_io.shipped_scene("reflected_light.xml"), res=300)
    params = mi.traverse(scene)
    name = "camera.to_world"
    dx = mi.Float(0)
    dr.enable_grad(dx)
    params[name] = mi.Transform4f().translate(mi.Vector3f(dx, 0, 0)) @ dr.detach(params[name])
    params.update()
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2})
    image = mi.render(scene, params, integrator=integrator, spp=2, seed=1)
    dr.forward(dx)
    gradient = np.array(dr.grad(image))
    assert len(drawn) == 1 and max(drawn[0].film.crop_size()) == 150
    assert gradient.shape[0] == 300 and np.isfinite(gradient).all() and np.abs(gradient).max() > 0
