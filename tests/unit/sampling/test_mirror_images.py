"""A ball and its images in plane mirrors: the cones hold every direction in which it is seen, and have a density."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver.prepare import prepare
from psdr_jit.plan.job import Job
from psdr_jit.scene import io as scene_io

COUNT = 1 << 19
FOUR_PI = 4 * np.pi
REFLECTIONS = 4  # between two mirrors images of so many are made, and paths of length 6 have room for them


@pytest.fixture
def job(llvm) -> Job:
    """Of a box between two mirrors that face each other."""
    scene = scene_io.load_scene(scene_io.shipped_scene("mirrors.xml"), res=8)
    perturb(scene, "blocker.vertex_positions", (1, 0, 0)).attach()
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 6, "sppi": 1})
    return prepare(integrator.call(scene, scene.sensors()[0], 0, 1)).jobs[0][1]


def everywhere() -> tuple[mi.Point3f, mi.Vector3f]:
    """Points between the mirrors, and directions of all kinds."""
    u = np.random.default_rng(5).random((5, COUNT)).astype(np.float32)
    x = mi.Point3f(2 * u[0] - 1, 0.4 * u[1] - 0.5, 1.2 * u[2] + 0.6)
    return x, mi.warp.square_to_uniform_sphere(mi.Point2f(u[3], u[4]))


def reflections(job: Job, x: mi.Point3f, d: mi.Vector3f, centre: mi.Point3f, radius: float) -> np.ndarray:
    """After how many reflections the line meets the ball; −1: not at all."""
    found = np.full(COUNT, -1)
    ray = mi.Ray3f(x, d)
    mirror = dr.full(mi.Bool, True, COUNT)
    for k in range(REFLECTIONS + 1):
        si = job.scene.ray_intersect(ray, mirror)
        to = centre - ray.o
        along = dr.dot(to, ray.d)
        meets = mirror & (along > 0) & (along < si.t) & (dr.squared_norm(to) - along * along < radius**2)
        found = np.where((found < 0) & np.array(meets), k, found)
        mirror &= si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.DeltaReflection)
        ray = si.spawn_ray(ray.d - 2 * dr.dot(ray.d, si.n) * mi.Vector3f(si.n))
    return found


def test_whatever_mirrors_show_is_in_a_cone(job):
    from psdr_jit.edges.kind import Use
    from psdr_jit.sampling.relevance import movers_of

    movers = movers_of(job, Use.STEP)
    ball = movers.seen.balls[0]
    assert len(movers.seen.balls) == 1 + 2 * REFLECTIONS
    x, d = everywhere()
    pdf = np.array(movers.seen_from(x).pdf(d))
    seen = reflections(job, x, d, ball.centre, float(ball.radius[0]))
    for k in range(REFLECTIONS + 1):
        assert (seen == k).sum() > 10, f"no line meets the ball after {k} reflections: the test has no power"
        assert (pdf[seen == k] > 0).mean() > 0.97
    direct = np.array(ball.seen_from(x).pdf(d))
    assert (direct[seen > 0] > 0).mean() < 0.5  # without images most would be missed


def test_the_density_of_the_cones(job):
    """It integrates to one, also where each of two groups has half, and is what is sampled."""
    from psdr_jit.boundary.chain_aims import ChainAims
    from psdr_jit.edges.kind import Use
    from psdr_jit.sampling.relevance import movers_of

    x, d = everywhere()
    for aims in (movers_of(job, Use.STEP), ChainAims.of(job)):
        one = dr.gather(mi.Point3f, x, mi.UInt32(7))
        cones = aims.seen_from(one)
        mass = np.array(cones.pdf(d)) * FOUR_PI
        assert abs(mass.mean() - 1) < 5 * mass.std() / np.sqrt(COUNT)
        u = mi.Point2f(*np.random.default_rng(6).random((2, COUNT)).astype(np.float32))
        sampled = cones.sample(u)
        pdf = np.array(cones.pdf(sampled))
        assert (pdf > 0).mean() > 0.999
        height = np.array(sampled.y)[pdf > 0]
        direct = np.array(d.y) * mass
        assert abs(height.mean() - direct.mean()) < 6 * (direct.std() + height.std()) / np.sqrt(COUNT)


def test_mirrors_that_move_or_bend_have_no_images(llvm):
    from psdr_jit.sampling.mirror_images import plane_mirrors

    for scene_name, param, mirrors in (("mirrors", "mirror.to_world", 1), ("glass", "body.to_world", 0)):
        scene = scene_io.load_scene(scene_io.shipped_scene(f"{scene_name}.xml"), res=4)
        perturb(scene, param, (1, 0, 0)).attach()
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3, "sppi": 1})
        job = prepare(integrator.call(scene, scene.sensors()[0], 0, 1)).jobs[0][1]
        assert len(plane_mirrors(job)) == mirrors


@pytest.mark.slow
def test_aims_leave_the_mean_as_it_is(llvm, monkeypatch):
    """Of the view in a mirror, light by way of which other surfaces reflect: the same mean."""
    from psdr_jit.boundary import chain
    from psdr_jit.boundary.chain_aims import ChainAims

    scene = scene_io.load_scene(scene_io.shipped_scene("shiny_floor.xml"), res=16, floor="conductor")
    motion = perturb(scene, "blocker.vertex_positions", (1, 0, 0))
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4, "spps": 32})

    def images() -> np.ndarray:
        found = []
        for seed in range(24):
            motion.attach()
            prepared = prepare(integrator.call(scene, scene.sensors()[0], seed, 32))
            (job,) = [job for term, job in prepared.jobs if term is chain.TERM]
            found.append(np.array(chain.forward(job)).mean(-1))
        return np.array(found)

    aimed = images()
    monkeypatch.setattr(ChainAims, "of", staticmethod(lambda job: None))
    blind = images()
    motion.restore()
    z = (aimed.mean(0) - blind.mean(0)) / np.sqrt((aimed.var(0, ddof=1) + blind.var(0, ddof=1)) / len(aimed) + 1e-12)
    assert np.sqrt((z**2).mean()) < 1.3
    total = [v.sum((1, 2)) for v in (aimed, blind)]
    assert abs(total[0].mean() - total[1].mean()) < 4 * np.sqrt(sum(t.var() for t in total) / len(aimed))
