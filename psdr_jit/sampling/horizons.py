"""Which horizon, and towards what: in proportion to what it may part."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..core.joining import pointers
from ..core.memory import Slot
from ..core.sensor_frame import towards_viewer, viewpoint
from ..edges.coarse import bent_meshes
from ..edges.film_cover import LENS_CENTRE
from ..edges.horizons import Horizons, Targets
from ..edges.kind_mirror_horizon import lets_through, reflects
from ..edges.kind_shading import ShadingOutlines
from ..edges.scene_table import scene_edges
from ..edges.shading_curve import Face
from ..edges.smooth_faces import SmoothFaces
from ..plan.job import Job
from .rows import ROW_SAMPLER, SampledRows, row_state

#: Lights that are looked at one by one; if there are more, directions are drawn all around.
MOST_LIGHTS = 16

#: A face that the middle of the sensor sees from behind, or edge-on, counts as much as one seen at this cosine; so does
#: one whose normals seem to turn away from a light.
LEAST = 0.1

#: Of one render call: the horizons by term or kind, in a list so that none can be told from not asked for.
TABLES: Slot[dict[str, list[Horizons | None]]] = Slot(dict)


class SampledHorizons(SampledRows):
    """The horizons of a scene, and how their rows are drawn."""

    table: Horizons


def sampled_horizons(job: Job, term: str, direct: bool) -> SampledHorizons | None:
    """Horizons before lights (`direct`), or before whatever reflects light; None without any that moves."""
    table = horizons(job, term, direct)
    return sampled(job, f"{term}/horizons", table, lambda: horizon_weights(job, term, direct))


def sampled(
    job: Job, what: str, table: Horizons | None, weights: Callable[[], list[mi.Float]]
) -> SampledHorizons | None:
    """`table` and how its rows are drawn; None where there is none, or nothing in it counts."""
    state = None if table is None else row_state(job, what, weights)
    return None if state is None else SampledHorizons(table, job.call.memory[ROW_SAMPLER], state)


def horizons(job: Job, term: str, direct: bool) -> Horizons | None:
    """The horizons before lights, or before whatever reflects light."""

    def make() -> Horizons | None:
        faces = _faces(job)
        targets = None if faces is None else (_lights(job) if direct else all_around())
        return None if targets is None else Horizons(faces, targets)

    return built_once(job, term, make)


def built_once(job: Job, which: str, make: Callable[[], Horizons | None]) -> Horizons | None:
    """What `make()` returned when this render call first asked for it."""
    known = job.shared[TABLES].setdefault(which, [])
    if not known:
        known.append(make())
    return known[0]


def horizon_weights(job: Job, term: str, direct: bool) -> list[mi.Float]:
    """The relative weight of each row, in a list of one; of none without any."""
    table = horizons(job, term, direct)
    if table is None:
        return []
    row = dr.arange(mi.UInt32, table.count)
    rows, face = table.face(row)
    n = dr.normalize(face.n_g)
    n_s = dr.normalize(face.n[0] + face.n[1] + face.n[2])
    middle, slant = face.at(mi.Point2f(1 / 3)), spread(face)
    weight = face.area * slant * _seen(job, rows.shell, n, middle)
    to = table.target(row)
    d = to.centre - middle
    far = dr.norm(d)
    lit = dr.minimum(dr.maximum(dr.dot(n_s, d) / far, 0) + LEAST * slant, slant)
    straddled = dr.abs(dr.dot(n, d)) < to.radius + dr.maximum(far, face.size) * 1e-6
    angle = dr.pi * dr.minimum(to.radius / far, 1)
    near = dr.maximum(far, to.radius)
    at_ball = dr.select(straddled, lit / dr.maximum(slant, 1e-6) * angle / near, 0)
    weight *= dr.select(to.radius > 0, at_ball, 1)
    relevant = mi.Bool(True) if _sources_move(job, direct) else rows.moves
    chosen = dr.gather(mi.UInt32, flags(_parted(job, table.faces)), rows.shape) != 0
    return [dr.select(relevant & chosen & dr.isfinite(weight), weight, 0)]


def smooth_faces(job: Job) -> SmoothFaces | None:
    """The faces of smooth-shaded meshes, if there are any."""
    return next((kind.faces for kind in scene_edges(job).kinds if isinstance(kind, ShadingOutlines)), None)


def _faces(job: Job) -> SmoothFaces | None:
    """The faces of smooth-shaded meshes, if one of these is coarse."""
    faces = smooth_faces(job)
    return None if faces is None or not any(_parted(job, faces)) else faces


def _parted(job: Job, faces: SmoothFaces) -> list[bool]:
    """By mesh: is it coarse, and more than a mirror? What mirrors show steps at edges (`edges.kind_mirror_horizon`)."""
    others = [
        lets_through(mesh) or not reflects(mesh) or mi.has_flag(mesh.bsdf().flags(), mi.BSDFFlags.Smooth)
        for mesh in faces.meshes
    ]
    return [bent and other for bent, other in zip(bent_meshes(faces.meshes, job.call.memory), others, strict=True)]


def flags(values: list[bool]) -> mi.UInt32:
    """1 where true."""
    found = mi.UInt32([int(value) for value in values])
    dr.make_opaque(found)
    return found


def _lights(job: Job) -> Targets | None:
    """Balls around lights with a surface, and the whole circle under a sky; None if all are points or directions."""
    chosen = [(e, f) for e, f in zip(job.scene.emitters(), job.facts.emitters, strict=True) if not f.delta]
    if len(chosen) > MOST_LIGHTS:
        return all_around()
    spheres = []
    for emitter, facts in chosen:
        if facts.shape >= 0:
            shape = job.scene.shapes()[job.facts.shapes[facts.shape].index]
            ball = shape.bbox().bounding_sphere()
            spheres.append([*ball.center, float(ball.radius)])
        else:
            spheres.append([0.0, 0.0, 0.0, 0.0])
    if not spheres:
        return None
    x, y, z, r = (mi.Float([s[k] for s in spheres]) for k in range(4))
    emitters = pointers(mi.EmitterPtr, [e for e, _ in chosen])
    targets = Targets(mi.Point3f(x, y, z), r, dr.reinterpret_array(mi.UInt32, emitters))
    dr.make_opaque(targets)
    return targets


def all_around() -> Targets:
    """Directions all around."""
    targets = Targets(mi.Point3f(0), mi.Float(0), mi.UInt32(0))
    dr.make_opaque(targets)
    return targets


def _sources_move(job: Job, direct: bool) -> bool:
    """Can anything but the faces themselves move against their horizons?"""
    facts = job.facts
    return facts.shapes_move and (direct or job.form != "spatial")


def spread(face: Face) -> mi.Float:
    """Mean sine of the angle between the corners' normals and the face."""
    n = dr.normalize(face.n_g)
    return sum(dr.norm(dr.cross(n, dr.normalize(n_s))) for n_s in face.n) / 3


def _seen(job: Job, shell: mi.Float, n: mi.Vector3f, x: mi.Point3f) -> mi.Float:
    """Cosine at which the middle of the sensor sees the faces; not 0 for those that others may see."""
    eye = viewpoint(job.frame, mi.Point2f(LENS_CENTRE))
    cos = dr.dot(n, dr.normalize(towards_viewer(eye, x)))
    return dr.maximum(dr.select(shell != 0, cos * shell, dr.abs(cos)), 0) + LEAST
