"""`look_at` inverts the sensor's own `sample_ray`, and its film Jacobian is that of finite differences."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.core.sensor_frame import look_at, sensor_frame
from psdr_jit.errors import UnsupportedError

N = 256
SENSORS = {
    "perspective": {"type": "perspective", "fov": 40.0},
    "perspective-y-fov": {"type": "perspective", "fov": 35.0, "fov_axis": "y"},
    "principal-point": {
        "type": "perspective", "fov": 40.0, "principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1
    },
    "thinlens": {"type": "thinlens", "fov": 40.0, "aperture_radius": 0.2, "focus_distance": 3.0},
    "orthographic": {"type": "orthographic"},
}  # fmt: skip
FILMS = {
    "plain": {},
    "crop": {"crop_offset_x": 7, "crop_offset_y": 3, "crop_width": 21, "crop_height": 17},
}


def make(sensor: str, film: str) -> mi.Sensor:
    T = mi.ScalarTransform4f
    pose = T().look_at([1, 2, 4], [0, 0.2, 0], [0, 1, 0.1])
    if sensor == "orthographic":
        pose = pose @ T().scale([1.5, 1.5, 1])
    film_dict = {"type": "hdrfilm", "width": 48, "height": 32, **FILMS[film]}
    return mi.load_dict({**SENSORS[sensor], "to_world": pose, "near_clip": 0.5, "far_clip": 30.0, "film": film_dict})


def numbers(seed: int):
    rng = mi.PCG32(N, initstate=seed)
    return [rng.next_float32() for _ in range(5)]


def points(sensor: mi.Sensor, film: mi.Point2f, aperture: mi.Point2f, z: mi.Float) -> tuple:
    """Rays through film positions, and the points at depth `z` on them."""
    ray, _ = sensor.sample_ray(0, 0.5, film, aperture)
    axis = sensor.world_transform() @ mi.Vector3f(0, 0, 1)
    eye = sensor.world_transform() @ mi.Point3f(0)
    t = (z - dr.dot(ray.o - eye, axis)) / dr.dot(ray.d, axis)
    return ray, ray(t)


@pytest.mark.parametrize("film", FILMS)
@pytest.mark.parametrize("sensor", SENSORS)
def test_look_at_inverts_sample_ray(variant, sensor, film):
    s = make(sensor, film)
    a, b, c, d, e = numbers(0)
    position, aperture = mi.Point2f(a, b), mi.Point2f(c, d)
    ray, x = points(s, position, aperture, 1 + 8 * e)
    view = look_at(sensor_frame(s), x, aperture)
    assert dr.all(view.valid)
    crop = s.film()
    expected = position * mi.Vector2f(crop.crop_size()) + mi.Vector2f(crop.crop_offset())
    assert np.abs(np.array(view.film - position)).max() < 2e-5
    assert np.abs(np.array(view.p - expected)).max() < 1e-3
    assert np.abs(np.array(view.ω - ray.d)).max() < 1e-5
    assert np.abs(np.array(view.o - ray.o)).max() < 1e-5
    assert np.abs(np.array(view.o + view.r * view.ω - x)).max() < 1e-5
    # the inverse can fail: another lens point sees x elsewhere
    if sensor == "thinlens":
        elsewhere = look_at(sensor_frame(s), x, 1 - aperture)
        assert np.abs(np.array(elsewhere.p - expected)).max() > 0.5


@pytest.mark.parametrize("film", FILMS)
@pytest.mark.parametrize("sensor", SENSORS)
def test_film_jacobian(variant, sensor, film):
    """Area of one pixel at x, seen perpendicularly: |∂x/∂p_x × ∂x/∂p_y · ω| on the plane z = const."""
    s = make(sensor, film)
    a, b, c, d, e = numbers(1)
    position, aperture, z = mi.Point2f(a, b), mi.Point2f(c, d), 1 + 8 * e
    _, x = points(s, position, aperture, z)
    view = look_at(sensor_frame(s), x, aperture)
    size, h = s.film().crop_size(), 0.5  # [px]; the map from film to plane is linear
    tangents = []
    for axis in range(2):
        step = mi.Vector2f(h / size[0], 0) if axis == 0 else mi.Vector2f(0, h / size[1])
        _, above = points(s, position + step, aperture, z)
        _, below = points(s, position - step, aperture, z)
        tangents.append((above - below) / (2 * h))
    area = dr.abs(dr.dot(dr.cross(*tangents), view.ω))
    ratio = np.array(view.J_px / area)
    assert np.abs(ratio - 1).max() < 2e-3, (ratio.min(), ratio.max())


@pytest.mark.parametrize("sensor", ["perspective", "thinlens", "orthographic"])
def test_clipping_planes(llvm, sensor):
    s = make(sensor, "plain")
    half = mi.Point2f(0.5)
    for z, inside in ((0.2, False), (1.0, True), (29.0, True), (31.0, False), (-2.0, False)):
        axis = s.world_transform() @ mi.Vector3f(0, 0, z)
        x = mi.Point3f((s.world_transform() @ mi.Point3f(0)) + axis)
        assert bool(look_at(sensor_frame(s), x, half).valid[0]) is inside, z


def test_other_sensors_are_refused_by_name(llvm):
    with pytest.raises(UnsupportedError, match="perspective"):
        sensor_frame(mi.load_dict({"type": "distant", "film": {"type": "hdrfilm", "width": 1, "height": 1}}))
