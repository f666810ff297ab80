"""Which lights are traced: those that camera paths do not find well by way of glass and mirrors."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit import make_plan
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver.prepare import prepare
from psdr_jit.interior import light_traced
from psdr_jit.options import FOLLOWING, Options
from psdr_jit.paths.light_technique import ASLANT
from psdr_jit.plan.form_choice import forms_to_try
from psdr_jit.plan.job import Job
from psdr_jit.plan.light_plan import LARGE, plan_light
from psdr_jit.plan.plan import Geometry
from psdr_jit.scene.facts import analyse

BODIES = {
    "smooth": {"type": "dielectric"},
    "mirror": {"type": "conductor"},
    "rough": {"type": "roughdielectric", "alpha": 0.3, "distribution": "ggx"},
}
HEIGHT = 2.5  # of the lamp above the ball [m]
SMALL, WIDE = 0.9 * np.sqrt(LARGE) * HEIGHT, 2 * np.sqrt(LARGE) * HEIGHT  # sides of the lamp [m]


def scene_of(body: str, side: float, lamp: str = "rectangle", rfilter: str = "gaussian") -> mi.Scene:
    """A ball on a floor, below a lamp."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": rfilter}}
    view = T().look_at(origin=[0.3, -3.5, 2.2], target=[0, 0, 0.3], up=[0, 0, 1])
    flat = [side / 2, side / 2, 1 if lamp == "rectangle" else 1e-3]
    return mi.load_dict({
        "type": "scene", "camera": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": T().scale(3)},
        "body": {"type": "sphere", "center": [0.1, 0, 0.7], "radius": 0.5, "bsdf": BODIES[body]},
        "lamp": {"type": lamp, "to_world": T().translate([0.1, 0, 0.7 + HEIGHT]).rotate([1, 0, 0], 180).scale(flat),
                 "emitter": {"type": "area", "radiance": 20.0}},
    }, optimize=False)  # fmt: skip


def plan_of(scene: mi.Scene, **options):
    spec = {"type": "psdr_bdpt", "max_depth": 4, "form": "spatial", "sppc": 1, "sppp": 0, "sppi": 0, **options}
    return make_plan(scene, "body.to_world", integrator=spec)


@pytest.mark.parametrize("body", ["smooth", "mirror"])
def test_wide_lamps_over_mirrors_are_left_to_camera_paths(llvm, body):
    assert plan_of(scene_of(body, SMALL)).light.runs
    left = plan_of(scene_of(body, WIDE)).light
    assert not left.runs and "as large as these" in left.reason
    assert plan_of(scene_of(body, WIDE), light_paths="only").light.runs


def test_rough_glass_gathers_light_of_any_lamp(llvm):
    assert plan_of(scene_of("rough", WIDE)).light.runs


def test_vertex_normals_of_flat_faces_do_not_keep_a_lamp_from_being_traced(llvm):
    """A `cube` has some, as has what is exported; they are those of its faces."""
    assert plan_of(scene_of("rough", SMALL, "cube")).light.runs


def test_places_on_the_film_follow_but_under_a_box_filter_if_light_is_traced(llvm):
    form = {"form": "film", "sppp": 1, "sppi": 1}
    assert plan_of(scene_of("smooth", WIDE), **form).form == "film"
    assert plan_of(scene_of("smooth", SMALL), **form).form == "film"
    for lamp, kept in ((WIDE, "film"), (SMALL, "spatial")):
        found = plan_of(scene_of("smooth", lamp, rfilter="box"), **form)
        assert found.form == kept and ("light subpaths" in found.form_reason) == (kept == "spatial")


def test_what_is_flat_is_followed_over_the_film_if_light_is_traced(llvm):
    """Which is uneven on it."""
    motion = perturb(scene_of("rough", SMALL), "floor.to_world", direction=[1, 0, 0])
    motion.attach()
    facts, options = analyse(motion.scene), Options(max_depth=4)
    traced = plan_light(motion.scene, facts, replace(options, light_paths="auto"), None)
    assert traced.runs
    for light, followed in ((traced, True), (None, False)):
        forms, _ = forms_to_try(motion.scene, facts, options, Geometry(), light, "")
        assert any(form in FOLLOWING for form in forms) == followed


def job_of(scene: mi.Scene) -> Job:
    """Of the interior term, the ball moved."""
    motion = perturb(scene, "body.to_world", direction=[1, 0, 0])
    motion.attach()
    alone = {"sppc": 256, "sppp": 0, "sppd": 0, "sppi": 0, "spps": 0}
    integrator = integrator_specs.build({"type": "psdr_bdpt", "max_depth": 4, "form": "spatial", **alone})
    (_, job), *_ = prepare(integrator.call(motion.scene, motion.scene.sensors()[0], 1, 1)).jobs
    return job


def test_directions_turn_with_spheres_beside_traced_lights(llvm):
    assert job_of(scene_of("smooth", SMALL)).orbits is not None


def test_light_is_not_connected_to_a_sensor_that_sees_the_surface_aslant(llvm):
    """Where what is seen slides by 1/cos, light subpaths would come as often as anywhere else."""
    job = job_of(scene_of("rough", WIDE))
    with dr.suspend_grad():
        limits = replace(job.limits, light=job.light)
        records = light_traced.find_paths(job, mi.UInt32(1), 256, limits).turned.records
        first = records.vertex(mi.UInt32(0), records.count > 0).hit
        ray = mi.Ray3f(first.o, first.d)
        cos = np.abs(np.array(dr.dot(first.intersection().compute_surface_interaction(ray).n, first.d)))
    cos = cos[np.array(records.count) > 0]
    assert len(cos) > 1000 and cos.min() > 0.99 * ASLANT
    assert np.mean(cos < 2 * ASLANT) > 3e-4, "the limit is not felt here"
