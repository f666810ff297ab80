"""A ball and its images in plane mirrors: in which directions it is seen from somewhere, directly or in a mirror.

A plane mirror through p with the unit normal n shows a ball about c as one of equal size about c − 2 n n·(c − p), to
who is on the ball's side of it, where the mirror is in the way. What a mirror shows of an image in another one is an
image again. Nothing is asked about what hides what: these are directions in which looking may be worth while.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import mesh_buffers, mesh_positions
from ..core.cones import Cone, Cones, towards_sphere
from ..core.memory import Slot, while_unchanged
from ..core.varying import varying
from ..plan.job import Job
from ..scene.facts import ShapeFacts

#: Balls and images that are looked at one by one, at most: each is a cone for every direction that is drawn.
MOST_SEEN = 10

#: Largest distance of a mirror's vertices from a plane, relative to its size; and most vertices that are looked at.
FLAT, MOST_VERTICES = 1e-4, 4096

#: Of an integrator: the planes of meshes by their number, while they stay as they are.
PLANES: Slot[dict[int, tuple[list, PlaneMirror | None]]] = Slot(dict)


@dataclass(frozen=True)
class PlaneMirror:
    """A mirror that is flat, in a ball around it. Host object."""

    n: np.ndarray  # unit normal
    centre: np.ndarray  # of the ball, in the plane
    radius: float

    def height(self, x: np.ndarray) -> float:
        """Signed distance of x from the plane."""
        return float(self.n @ (x - self.centre))

    def image(self, x: np.ndarray) -> np.ndarray:
        return x - 2 * self.height(x) * self.n


@dataclass(frozen=True)
class SeenBall:
    """A ball, or an image of one in the mirror that shows it. Host object."""

    centre: np.ndarray
    radius: float
    mirror: PlaneMirror | None = None

    @staticmethod
    def around(shapes: Iterable[mi.Shape]) -> SeenBall:
        """The ball around the box of all of them."""
        box = mi.ScalarBoundingBox3f()
        for shape in shapes:
            box.expand(shape.bbox())
        sphere = box.bounding_sphere()
        return SeenBall(np.array(sphere.center, np.float64), float(sphere.radius))

    def stored(self) -> StoredBall:
        m = self.mirror
        frame = None if m is None else tuple(_point(v) for v in (m.n, m.centre)) + (varying(mi.Float, m.radius),)
        return StoredBall(_point(self.centre), varying(mi.Float, self.radius), frame)


@dataclass(frozen=True)
class StoredBall:
    """The same for kernels."""

    centre: mi.Point3f
    radius: mi.Float
    frame: tuple[mi.Point3f, mi.Point3f, mi.Float] | None  # of a mirror: normal, centre, radius

    def seen_from(self, x: mi.Point3f) -> Cone:
        """The ball's cone or the mirror's, whichever is narrower; none where the mirror does not show the ball."""
        ball = towards_sphere(x, self.centre, self.radius)
        if self.frame is None:
            return ball
        n, centre, radius = self.frame
        mirror = towards_sphere(x, centre, radius)
        here, there = (dr.dot(n, p - centre) for p in (x, self.centre))
        shown = here * there < dr.abs(here) * self.radius  # some of the image is on the other side
        return dr.select(shown & ball.meets(mirror), dr.select(ball.open < mirror.open, ball, mirror), Cone.none())


@dataclass(frozen=True)
class SeenBalls:
    """Balls and what mirrors show of them. Host object."""

    balls: tuple[StoredBall, ...]

    @staticmethod
    def of(balls: Sequence[SeenBall]) -> SeenBalls:
        return SeenBalls(tuple(ball.stored() for ball in balls))

    def seen_from(self, x: mi.Point3f) -> Cones:
        """The directions from x in which any of them is."""
        return Cones.by_angle([ball.seen_from(x) for ball in self.balls])


def lamp_balls(job: Job) -> list[SeenBall]:
    """Around every shape that emits light."""
    shapes = job.scene.shapes()
    return [SeenBall.around([shapes[s.index]]) for s in job.facts.shapes if s.index >= 0 and s.is_emitter]


def with_images(job: Job, balls: Sequence[SeenBall]) -> list[SeenBall]:
    """`balls`, and their images in the mirrors that rest: in one, then in two, and on, as many as are looked at."""
    mirrors, seen, latest = plane_mirrors(job), list(balls), list(balls)
    for _ in range(min(job.limits.max_depth - 2, MOST_SEEN)):  # a segment before them, and one behind
        latest = list(images_of(latest, mirrors))
        seen += latest
        if not latest or len(seen) >= MOST_SEEN:
            break
    return seen[: max(len(balls), MOST_SEEN)]


def images_of(balls: Sequence[SeenBall], mirrors: Sequence[PlaneMirror]) -> Iterator[SeenBall]:
    """What each mirror shows of `balls`, or of the images of others."""
    for ball in balls:
        for mirror in mirrors:
            if mirror is not ball.mirror and _sees(mirror, ball):
                yield SeenBall(mirror.image(ball.centre), ball.radius, mirror)


def _sees(mirror: PlaneMirror, ball: SeenBall) -> bool:
    """Of the image of a ball: does some of `mirror` lie where it is shown?"""
    shows = ball.mirror
    if shows is None:
        return True
    there = shows.height(ball.centre)
    return np.sign(there) * shows.height(mirror.centre) < mirror.radius


def plane_mirrors(job: Job) -> list[PlaneMirror]:
    """The mirrors that are flat and rest, the largest first."""
    if not job.facts.has_delta_lobes:
        return []
    reflecting = [s for s in job.facts.shapes if _may_be_plane(s)]
    known, shapes = job.call.memory[PLANES], job.scene.shapes()
    planes = [while_unchanged(known, s.index, list(mesh_buffers(shapes[s.index])), lambda s=s: _plane(shapes[s.index]))
              for s in reflecting]  # fmt: skip
    return sorted((plane for plane in planes if plane is not None), key=lambda plane: -plane.radius)


def _may_be_plane(s: ShapeFacts) -> bool:
    reflects = s.bsdf_flags & int(mi.BSDFFlags.DeltaReflection)
    coated = s.bsdf_flags & int(mi.BSDFFlags.Smooth)  # a few percent of what it sends are a mirror's
    return bool(reflects) and not coated and s.index >= 0 and s.is_mesh and not s.smooth and not s.moves


def _plane(mesh: mi.Mesh) -> PlaneMirror | None:
    """None for a mesh that is not flat."""
    if not 3 <= mesh.vertex_count() <= MOST_VERTICES:
        return None
    x = np.array(dr.detach(mesh_positions(mesh)), np.float64).T
    centre = (x.min(0) + x.max(0)) / 2
    offsets = x - x.mean(0)
    size, n = np.linalg.norm(offsets, axis=1).max(), np.linalg.svd(offsets, full_matrices=False)[2][-1]
    heights = offsets @ n
    if not size > 0 or np.abs(heights).max() > FLAT * size:
        return None
    return PlaneMirror(n, centre, float(np.linalg.norm(x - centre, axis=1).max()))


def _point(v: np.ndarray) -> mi.Point3f:
    return varying(mi.Point3f, [float(c) for c in v])
