"""A sensor with another sampler: the same image with less noise, and the same sensor in all else."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.derivative.finite_differences import OWN, CentralDifference
from psdr_jit.derivative.perturbation import Perturbation, perturb
from psdr_jit.derivative.stratified_sensor import SAMPLER, stratified, stratified_count
from psdr_jit.scene import io as scene_io

SPP, SEEDS, SIDE = 64, 12, 8


def scene(name: str = "area_shadow") -> mi.Scene:
    side = {} if "crop" in name else {"res": SIDE}
    return scene_io.load_scene(scene_io.shipped_scene(f"{name}.xml"), **side)


def images(scene: mi.Scene, sensor: mi.Sensor, first: int = 0) -> np.ndarray:
    path = mi.load_dict({"type": "path", "max_depth": 2})
    return np.array([path.render(scene, sensor, seed=first + k, spp=SPP).numpy() for k in range(SEEDS)])


@pytest.mark.parametrize("spp", (1, 2, 7, 16, 141, 1000))
def test_count_is_what_mitsuba_rounds_to(llvm, spp):
    count = stratified_count(spp)
    assert spp <= count <= spp + np.sqrt(spp) and stratified_count(count) == count
    assert mi.load_dict({"type": SAMPLER, "sample_count": count}).sample_count() == count


@pytest.mark.parametrize("name", ("area_shadow", "thinlens_shadow", "camera_crop", "camera_orthographic"))
def test_the_same_image_with_less_noise(variant, name):
    found = scene(name)
    own = found.sensors()[0]
    a, b = images(found, own), images(found, stratified(own, SPP), first=100)
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)).mean((0, 1)) / SEEDS / np.prod(a.shape[1:3]))
    assert np.all(np.abs(a.mean((0, 1, 2)) - b.mean((0, 1, 2))) <= 5 * error + 1e-6)
    assert a.std() > 0 and b.var(0).mean() < 0.7 * a.var(0).mean()


def test_it_follows_the_sensor_and_leaves_it_alone(variant):
    found = scene()
    own = found.sensors()[0]
    before, view = own.sampler().sample_count(), stratified(own, SPP)
    still = images(found, view)
    params = mi.traverse(found)
    pose = next(key for key in params.keys() if key.endswith("to_world") and "amera" in key)
    params[pose] = mi.Transform4f().translate([0.5, 0, 0]) @ params[pose]
    params.update()
    moved = images(found, view)
    assert not np.allclose(still.mean(0), moved.mean(0), atol=0.05 * still.mean())
    assert own.sampler().sample_count() == before


def test_differences_have_less_noise(variant):
    """Of what an outline uncovers: less than half."""
    noise = {}
    for sampler in (OWN, SAMPLER):
        motion = perturb(scene("emissive_card"), "card.vertex_positions", (1, 0.3, 0))
        difference = CentralDifference(motion, {"max_depth": 2}, 0, 256, sampler=sampler)
        noise[sampler] = np.array(difference.differences(range(SEEDS))).var(0).mean()
    assert 0 < noise[SAMPLER] < 0.5 * noise[OWN]


def below_a_point(bsdf: str) -> Perturbation:
    mirror = {"type": "rectangle", "bsdf": {"type": bsdf}}
    found = mi.load_dict({"type": "scene", "mirror": mirror, "lamp": {"type": "point", "position": [0, 0, 1]},
                          "camera": {"type": "perspective"}}, optimize=False)  # fmt: skip
    return perturb(found, "mirror.to_world", (1, 0, 0))


@pytest.mark.parametrize(("bsdf", "own"), [("plastic", True), ("null", False), ("diffuse", False)])
def test_what_sends_the_light_of_points_on_is_in_one_image_alone(llvm, bsdf, own):
    """What plastic mirrors of it is found from the light, and is not in the image of `path`."""
    assert (samples_of(below_a_point(bsdf), "psdr_bdpt", 7) == 7) == own


def test_light_subpaths_keep_their_sensor(variant):
    """Where `psdr_bdpt` is its own reference, it draws its random numbers itself."""
    motion = below_a_point("conductor")
    assert samples_of(motion, "psdr_bdpt", 7) == 7
    assert samples_of(motion, "psdr_path", 7) == stratified_count(7) != 7


def samples_of(motion: Perturbation, plugin: str, spp: int) -> int:
    return CentralDifference(motion, {"type": plugin, "max_depth": 3}, spp=spp).spp
