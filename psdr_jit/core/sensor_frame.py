"""Where does a sensor see a point? Projection, viewing ray and film Jacobian of Mitsuba's planar sensors.

The geometry is read off the sensor's own rays at three film corners, so crops, principal points and field of view
follow Mitsuba's conventions without naming its parameters. Orthographic and thin-lens sensors have no usable
`sample_direction` for this purpose (the first throws, the second picks its own lens point), hence this file.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError
from .film import sampled_window
from .varying import varying

KINDS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic",
}


@dataclass(frozen=True)
class SensorFrame:
    """Detached geometry of one sensor. Local space: the camera looks along +z from the origin.

    Numbers that change with the pose, if only by rounding, are `varying`.
    """

    kind: str
    to_world: mi.Transform4f
    to_local: mi.Transform4f
    corner: mi.Point2f  # film (0, 0) on the plane z = 1 (orthographic: any z)
    extent: mi.Point2f  # film width and height there, signed
    near: mi.Float
    far: mi.Float
    focus: mi.Float  # distance of the plane in focus (thin lens)
    aperture: mi.Float  # lens radius, 0 for a pinhole
    crop_offset: tuple[int, int]
    crop_size: tuple[int, int]
    stretch: tuple[mi.Float, mi.Float]  # of the pose, across and along the view (a perspective pose has none)
    window: tuple[tuple[float, float], tuple[float, float]]  # film region with camera samples [px]

    @property
    def px_area(self) -> mi.Float:
        """Area of one pixel on the plane z = 1 (orthographic: on every plane)."""
        return dr.abs(self.extent.x * self.extent.y) / (self.crop_size[0] * self.crop_size[1])


@dataclass
class View:
    """How the sensor sees a point x (detached)."""

    p: mi.Point2f  # film position [px], including the crop offset
    film: mi.Point2f  # the same in [0, 1]² of the crop window: `position_sample` of `sample_ray`
    o: mi.Point3f  # start of the viewing ray, on the near plane
    ω: mi.Vector3f  # unit direction from sensor to x
    r: mi.Float  # distance from o to x
    J_px: mi.Float  # area perpendicular to ω at x that one pixel sees [m²/px²]
    valid: mi.Bool  # between the clipping planes


def sensor_kind(sensor: mi.Sensor) -> str:
    name = sensor.class_name()
    if name not in KINDS:
        raise UnsupportedError(
            f"sensor '{name}' has no primary boundary term; use a perspective, thinlens or orthographic sensor, "
            "or set sppp=0 to accept the bias"
        )
    return KINDS[name]


def sensor_frame(sensor: mi.Sensor) -> SensorFrame:
    """Read the frame of a perspective, thin-lens or orthographic sensor. Raises `UnsupportedError` for others."""
    kind = sensor_kind(sensor)
    film = sensor.film()
    with dr.suspend_grad():
        to_world = mi.Transform4f(dr.detach(sensor.world_transform().matrix))
        to_local = to_world.inverse()
        corners = mi.Point2f([0, 1, 0], [0, 0, 1])
        ray, _ = sensor.sample_ray(0, 0.5, corners, mi.Point2f(0.5))  # the lens centre, for a thin lens
        o, d = to_local @ ray.o, to_local @ ray.d
        q = mi.Point2f(o.x, o.y) if kind == "orthographic" else mi.Point2f(d.x / d.z, d.y / d.z)
        x, y, near, far = (_on_host(axis) for axis in (q.x, q.y, o.z, o.z + ray.maxt * d.z))
        focus, aperture = 1.0, 0.0
        if kind == "thinlens":
            params = mi.traverse(sensor)
            focus, aperture = (
                float(dr.detach(mi.Float(params[k]))[0]) for k in ("focus_distance", "aperture_radius")
            )
    return SensorFrame(
        kind=kind,
        to_world=to_world,
        to_local=to_local,
        corner=varying(mi.Point2f, (x[0], y[0])),
        extent=varying(mi.Point2f, (x[1] - x[0], y[2] - y[0])),
        near=varying(mi.Float, near[0]),
        far=varying(mi.Float, far[0]),
        focus=varying(mi.Float, focus),
        aperture=varying(mi.Float, aperture),
        crop_offset=tuple(film.crop_offset()),
        crop_size=tuple(film.crop_size()),
        stretch=_stretch(to_world),
        window=tuple(tuple(map(float, corner)) for corner in sampled_window(film)),
    )


def _on_host(values) -> list[float]:
    """All entries, read at once."""
    return np.array(values, np.float64).ravel().tolist()


def film_area(sensor: mi.Sensor, kind: str) -> mi.Float:
    """Area that the film sees at distance 1 (orthographic: anywhere), up to a constant; attached to the sensor.

    Of rays through three corners: no turn of the sensor changes the volume that their directions span, nor what they
    have along its axis.
    """
    corners = mi.Point2f([0, 1, 0], [0, 0, 1])
    ray, _ = sensor.sample_ray(0, 0.5, corners, mi.Point2f(0.5))
    axis = dr.normalize(sensor.world_transform() @ mi.Vector3f(0, 0, 1))
    o, d = ([dr.gather(mi.Vector3f, mi.Vector3f(v), i) for i in range(3)] for v in (ray.o, ray.d))
    if kind == "orthographic":
        return dr.abs(dr.dot(dr.cross(o[1] - o[0], o[2] - o[0]), axis))
    x = [v / dr.dot(v, axis) for v in d]
    return dr.abs(dr.dot(x[0], dr.cross(x[1], x[2])))


def _stretch(to_world: mi.Transform4f) -> tuple[mi.Float, mi.Float]:
    """Area factor across and length factor along the view: an orthographic pose carries the sensor's width."""
    x, y, z = (to_world @ axis for axis in (mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)))
    length = dr.norm(z)
    across = dr.abs(dr.dot(dr.cross(x, y), z)) / length
    dr.make_opaque(across, length)
    return across, length


def lens_point(frame: SensorFrame, aperture_sample: mi.Point2f) -> mi.Point3f:
    """Local position on the lens, by the same warp as Mitsuba's `thinlens`; the origin for a pinhole."""
    if frame.kind != "thinlens":
        return mi.Point3f(0)
    disk = mi.warp.square_to_uniform_disk_concentric(aperture_sample)
    return mi.Point3f(frame.aperture * disk.x, frame.aperture * disk.y, 0)


def origin_box(frame: SensorFrame) -> tuple[list[float], list[float]]:
    """Bounding box `(lower, upper)` of lens and near plane, between which camera rays start, world space."""
    (x0, y0), (w, h) = _on_host(frame.corner), _on_host(frame.extent)
    (near,), (r,) = _on_host(frame.near), _on_host(frame.aperture)
    if frame.kind == "orthographic":
        local = [(x, y, near) for x in (x0, x0 + w) for y in (y0, y0 + h)]
    else:
        local = [(x, y, 0.0) for x in (-r, r) for y in (-r, r)]
        local += [(near * x + a, near * y + b, near) for x in (x0, x0 + w) for y in (y0, y0 + h)
                  for a in (-r, r) for b in (-r, r)]  # fmt: skip
    matrix = np.array(frame.to_world.matrix, np.float64).reshape(4, 4)
    points = np.array(local) @ matrix[:3, :3].T + matrix[:3, 3]
    return points.min(0).tolist(), points.max(0).tolist()


def viewpoint(frame: SensorFrame, aperture_sample: mi.Point2f) -> mi.Vector4f:
    """Homogeneous world position that sees: (x, y, z, 1), or (−direction, 0) for an orthographic sensor."""
    if frame.kind == "orthographic":
        axis = frame.to_world @ mi.Vector3f(0, 0, -1)
        return mi.Vector4f(axis.x, axis.y, axis.z, 0)
    a = frame.to_world @ lens_point(frame, aperture_sample)
    return mi.Vector4f(a.x, a.y, a.z, 1)


def towards_viewer(view: mi.Vector4f, x: mi.Point3f) -> mi.Vector3f:
    """Unnormalised direction from x to the viewpoint."""
    return mi.Vector3f(view.x, view.y, view.z) - view.w * mi.Vector3f(x)


def view_width(frame: SensorFrame, x: mi.Point3f) -> mi.Float:
    """Width of what the film shows at the distance of x [m], of a square film of the same area."""
    width = dr.sqrt(dr.abs(frame.extent.x * frame.extent.y))
    if frame.kind == "orthographic":
        return width * dr.sqrt(frame.stretch[0])
    return width * dr.norm(towards_viewer(viewpoint(frame, mi.Point2f(0.5)), x))


def pixel_footprint(frame: SensorFrame, x: mi.Point3f, ω: mi.Vector3f) -> mi.Float:
    """`View.J_px` of a point x (world) that is met by a viewing ray of direction ω, whichever lens point it is from."""
    if frame.kind == "orthographic":
        return mi.Float(frame.px_area * frame.stretch[0])
    along = dr.normalize(frame.to_local @ ω)
    return dr.square((frame.to_local @ x).z) * frame.px_area * along.z


def look_at(frame: SensorFrame, x: mi.Point3f, aperture_sample: mi.Point2f) -> View:
    """Project x (world) as seen through one lens point.

    Thin lens: x is seen where the line from the lens point A through x meets the plane in focus,
    q' = A + (q − A)·focus/q_z. A pixel's footprint perpendicular to the ray is z² · px_area · cosθ (central
    projection, for every lens point alike), or px_area for parallel projection.
    """
    q = frame.to_local @ x
    valid = (q.z > frame.near) & (q.z < frame.far)
    if frame.kind == "orthographic":
        plane = mi.Point2f(q.x, q.y)
        origin, direction = mi.Point3f(q.x, q.y, frame.near), mi.Vector3f(0, 0, 1 / frame.stretch[1])
        J_px = mi.Float(frame.px_area * frame.stretch[0])
        r = (q.z - frame.near) * frame.stretch[1]
    else:
        a = lens_point(frame, aperture_sample)
        slope = (q - a) / q.z
        seen = a + slope * frame.focus
        plane = mi.Point2f(seen.x, seen.y) / frame.focus
        length = dr.norm(slope)
        direction = mi.Vector3f(slope / length)
        cos_θ = dr.rcp(length)  # slope has unit z
        origin = a + slope * frame.near
        J_px = dr.square(q.z) * frame.px_area * cos_θ
        r = (q.z - frame.near) * length
    film = (plane - mi.Point2f(frame.corner)) / mi.Point2f(frame.extent)
    p = film * mi.Point2f(frame.crop_size) + mi.Point2f(frame.crop_offset)
    return View(p, film, frame.to_world @ origin, frame.to_world @ direction, r, J_px, valid)
