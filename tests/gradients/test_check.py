"""The check has to be able to fail: synthetic images with a known answer, then one scene end to end."""

from __future__ import annotations

import time

import mitsuba as mi
import numpy as np
import pytest
from variants import activate

from psdr_jit.derivative.check import check_gradient
from psdr_jit.derivative.finite_differences import CentralDifference
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import GroupedImages, Unseen, block_means, block_test, gain
from psdr_jit.derivative.verdict import FAIL, INCONCLUSIVE, PASS, judge
from psdr_jit.errors import UnsupportedError
from psdr_jit.scene import io as scene_io

SHAPE = (32, 32, 3)
SEEDS = 96  # enough for the scatter of block means to be believed
BLOCK = 2
COARSE = {"reference_spp": 64, "max_seconds": 20}  # enough where the answer is clear


@pytest.fixture(scope="module")
def truth():
    """A derivative as an edge makes it: zero but for two stripes of opposite sign."""
    image = np.zeros(SHAPE)
    image[4:28, 8] = 3.0
    image[4:28, 20] = -2.0
    return image


def collect(mean, noise, seed, seeds=SEEDS):
    """Images of independent seeds with uniform Gaussian noise of standard deviation `noise`."""
    rng = np.random.default_rng(seed)
    images = GroupedImages()
    for _ in range(seeds):
        images.add(mean + noise * rng.normal(size=SHAPE))
    return images


def verdict(d, truth, reference_noise=1.0, **options):
    return judge(d, collect(truth, reference_noise, 1), collect(truth, reference_noise, 2), BLOCK, **options)


def test_the_truth_passes(truth):
    v = verdict(collect(truth, 1.0, 3), truth)
    assert v.verdict == PASS, v
    assert abs(v.gain - 1) < 4 * v.gain_stderr < 0.03


@pytest.mark.parametrize("factor, noise", [(0, 0), (0, 1), (-1, 1), (0.5, 1), (0.95, 1), (1.05, 1), (2, 1)])
def test_wrong_scale_fails(truth, factor, noise):
    v = verdict(collect(factor * truth, noise, 3), truth)
    assert v.verdict == FAIL, v
    assert abs(v.gain - factor) < 0.02


def test_right_gain_at_the_wrong_place_fails(truth):
    """A missing term orthogonal to the reference leaves the gain at 1; the blocks give it away."""
    wrong = truth.copy()
    wrong[28:, 12:18] = 1.0
    v = verdict(collect(wrong, 1.0, 3), truth)
    assert abs(v.gain - 1) < 0.02 and v.verdict == FAIL, v


def test_understated_errors_fail(truth):
    """Every seed shares one error that its scatter does not show."""
    hidden = 0.25 * np.random.default_rng(5).normal(size=SHAPE)
    v = verdict(collect(truth + hidden, 1.0, 3), truth)
    assert v.verdict == FAIL and "RMS z" in v.reason or "standard errors" in v.reason, v


def test_too_noisy_is_inconclusive(truth):
    v = verdict(collect(truth, 20.0, 3), truth)
    assert v.verdict == INCONCLUSIVE and "standard error of the gain" in v.reason, v


def test_too_few_seeds_are_inconclusive(truth):
    v = verdict(collect(truth, 1.0, 3, seeds=16), truth)
    assert v.verdict == INCONCLUSIVE and "seeds" in v.reason


def test_gain_is_not_biased_by_a_noisy_reference(truth):
    """d.f / f.f with one reference of this noise would give about 0.5; two halves give 1 within the error."""
    d, noise = collect(truth, 0.0, 3).group_means(), 10.0
    slopes = [gain(d, collect(truth, noise, 10 + k, 32).group_means(),
                   collect(truth, noise, 90 + k, 32).group_means()) for k in range(24)]
    values = np.array([s.value for s in slopes])
    f = collect(truth, noise, 1, 32).mean()
    assert np.sum(truth * f) / np.sum(f * f) < 0.6
    assert abs(values.mean() - 1) < 4 * values.std() / np.sqrt(24)
    # and the jackknife error is that of repeated experiments
    assert 0.7 < np.mean([s.stderr for s in slopes]) / values.std(ddof=1) < 1.4


def test_zero_gradient_needs_an_absolute_bound():
    zero = np.zeros(SHAPE)
    d, f1, f2 = (collect(zero, 1.0, k) for k in (3, 1, 2))
    assert judge(d, f1, f2, BLOCK).verdict == INCONCLUSIVE
    assert judge(d, f1, f2, BLOCK, zero_bound=1.0).verdict == PASS
    assert judge(d, f1, f2, BLOCK, zero_bound=0.1).verdict == INCONCLUSIVE
    assert judge(collect(zero + 3, 1.0, 3), f1, f2, BLOCK, zero_bound=1.0).verdict == FAIL
    assert judge(collect(zero + 3, 1.0, 3), f1, f2, BLOCK).verdict == FAIL
    exact = [collect(zero, 0.0, k) for k in range(3)]
    assert judge(*exact, BLOCK).verdict == PASS


def test_block_means_of_odd_sizes():
    image = np.arange(5 * 7 * 1.0).reshape(5, 7, 1)
    blocks = block_means(image, 4)
    assert blocks.shape == (2, 2, 1)
    assert blocks[0, 0, 0] == image[:4, :4].mean() and blocks[1, 1, 0] == image[4:, 4:].mean()


def test_z_scores_of_honest_errors_are_standard_normal(truth):
    d = collect(truth, 1.0, 3).group_means()
    f = collect(truth, 2.0, 4).group_means()
    test = block_test(d, f, BLOCK)
    assert 0.9 < test.rms_z < 1.15 and test.max_z < 5 and test.blocks == 16 * 16 * 3


@pytest.mark.parametrize("events", [3, 300])
def test_what_few_events_show_is_uncertain(events):
    """Per block: their scatter says 0 where none has occurred but small changes. What is wrong stays wrong."""
    rng, groups = np.random.default_rng(1), 64
    small = 0.01 * rng.standard_normal((2, groups, 16, 16, 3))
    f = rng.poisson(events / groups, small[0].shape) * groups / events + small[0]
    for truth, right in ((1, True), (0, events < 10)):
        d, one = truth + small[1], 1 / events
        assert (block_test(d, f, 1, Unseen(rare=one)).max_z < 6) == right
    assert events > 10 or block_test(1 + small[1], f, 1).max_z > 30


@pytest.fixture(scope="module")
def card():
    activate("llvm_ad_rgb")
    return scene_io.load_scene(scene_io.shipped_scene("emissive_card.xml"))


@pytest.mark.parametrize(
    "how", [pytest.param(dict(direction=(1, 0, 0)), marks=pytest.mark.slow), dict(rotate=(0, 0, 1))]
)
def test_moving_card_passes(card, how):
    """Primary boundary alone; oracle: finite differences of `path`."""
    result = check_gradient(card, "card.vertex_positions", integrator="psdr_path", max_seconds=60, **how)
    assert result.passed, str(result)


def test_mitsuba_prb_fails_on_the_moving_card(card):
    """prb has no boundary term: its derivative is 0 and the check says so."""
    mi.set_log_level(mi.LogLevel.Error)
    result = check_gradient(card, "card.vertex_positions", (1, 0, 0), integrator="prb", **COARSE)
    assert result.verdict.verdict == FAIL and abs(result.verdict.gain) < 0.01, str(result)


def test_radiance_passes_and_is_restored(card):
    """Linear in the parameter: no boundary term, and almost no noise, so rounding must not count as error."""
    before = np.array(mi.traverse(card)["card.emitter.radiance.value"])
    result = check_gradient(card, "card.emitter.radiance.value", integrator="prb", **COARSE)
    assert result.passed, str(result)
    assert np.array_equal(np.array(mi.traverse(card)["card.emitter.radiance.value"]), before)


def test_a_change_that_no_sample_met_has_an_error(card):
    """Few samples, a tiny step: blocks at the outline show no scatter, which is not certainty."""
    spec = {"type": "path", "max_depth": 2}
    difference = CentralDifference(perturb(card, "card.vertex_positions", index=0), spec, spp=4, eps=1e-4)
    difference.add(2)
    still = block_means(difference.primal.mean(), BLOCK) > 0
    floor = difference.floor(BLOCK)
    one_sample = 0.6 / (2 * 1e-4 * 4 * BLOCK**2 * 4)     # the darkest channel, brightest neighbour
    unseen = still & (block_means(difference.result(BLOCK).mean, BLOCK) == 0)
    assert unseen.sum() > 100 and np.all(floor[unseen] > 0.5 * one_sample)
    assert np.all(floor[0] == 0), "black far from the card: anything there would be an error"


def beside_a_border_of_pixels() -> mi.Scene:
    """A card whose outline a step of finite differences takes across the border of a pixel, a quarter of it not."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    place = mi.ScalarTransform4f().translate([0.024 * 2 / 8, 0, 0]).scale(0.5)
    return mi.load_dict({
        "type": "scene",
        "camera": {"type": "orthographic", "film": film, "to_world": pose},
        "card": {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}},
    })  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("hurry", [False, True])
def test_a_failure_is_not_believed_before_a_smaller_step_was_tried(hurry):
    """Where there is time for it, it passes; where there is none, nobody knows."""
    activate("llvm_ad_rgb")
    said = []

    def linger(seconds, v):
        said.append(v.verdict)
        if hurry and v.verdict == FAIL:
            time.sleep(max(limit - seconds, 0))

    limit = 90.0
    result = check_gradient(beside_a_border_of_pixels(), "card.to_world", (1, 0, 0), integrator="psdr_path",
                            spp=16, reference_spp=2048, max_seconds=limit, progress=linger)  # fmt: skip
    assert FAIL in said
    assert result.verdict.verdict == (INCONCLUSIVE if hurry else PASS), str(result)


def test_a_check_through_an_irradiance_meter_is_refused_by_name(llvm):
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    scene = mi.load_dict({
        "type": "scene", "cube": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 3])},
        "floor": {"type": "rectangle", "sensor": {"type": "irradiancemeter", "film": film}},
        "sky": {"type": "constant"},
    }, optimize=False)  # fmt: skip
    with pytest.raises(UnsupportedError, match="irradiancemeter"):
        check_gradient(scene, "cube.vertex_positions", (1, 0, 0), max_seconds=1)
