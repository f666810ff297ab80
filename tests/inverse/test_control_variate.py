"""Recursive control variates: the recursion on random numbers of which everything is known, and in optimisations."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from inverse_problems import BOX, box_and_lamp, problem_of, scene_of, target_of

import psdr_jit
from psdr_jit import Parameter, Pose, Stage
from psdr_jit.derivative import integrator_specs
from psdr_jit.errors import OptionError
from psdr_jit.inverse import control_variate, loop
from psdr_jit.inverse.control_variate import LARGEST, Recursive, Single, begun, followed
from psdr_jit.inverse.problem import TARGET_IMAGE, make_problem
from psdr_jit.inverse.settings import Settings

SHAPE = (16, 16, 2)
NOISE = 0.5  # standard deviation of a render
SURE = 5.0  # standard errors
FIXED = {"type": "psdr_path", "max_depth": 2, "sppc": 4, "sppp": 4, "sppi": 4}


def render(θ, seed, kept=1.0):
    """An image whose mean is θ. `kept`: correlation of its noise with that of other θ and the same seed."""
    common = np.random.default_rng(seed).normal(size=SHAPE)
    own = np.random.default_rng((*np.atleast_1d(seed), int(1e6 * θ))).normal(size=SHAPE)
    return (θ + NOISE * (kept * common + np.sqrt(1 - kept**2) * own)).astype(np.float32)


def chain_errors(first_seed, iterations=40, kept=0.98, step=followed):
    """Of the image after so many iterations, while θ grows."""
    chain = None
    for n in range(iterations):
        θ = 1 + 0.02 * n
        own, control = render(θ, (first_seed, n), kept), render(θ, (first_seed, n + 1), kept)
        chain = begun(own, control) if chain is None else step(chain, own, control)
    return chain.image - θ, chain


def forgetful(chain, own, control):
    """A mean over iterations instead, without the renders at the parameters before the step: it lags behind."""
    return replace(chain, image=0.8 * chain.image + 0.2 * own)


def means(step):
    found = np.array([chain_errors(k, step=step)[0].mean() for k in range(30)])
    return found.mean(), found.std(ddof=1) / np.sqrt(len(found))


def test_images_are_right_on_average():
    off, stderr = means(followed)
    assert abs(off) < SURE * stderr
    lag, _ = means(forgetful)
    assert abs(lag) > 2 * SURE * stderr, "the test has no power: let θ grow faster"


def test_variance_falls_to_what_the_best_coefficient_leaves():
    """Least over constant α of what v = 1 − 2 α ρ + α² + α² v leads to, with the variance of a render as unit."""
    kept = 0.98
    found = np.mean([np.square(chain_errors(k, kept=kept)[0]).mean() for k in range(10)]) / NOISE**2
    α = np.linspace(0, 0.999, 1000)
    ρ = kept**2  # correlation of two images with one seed
    least = np.min((1 - 2 * α * ρ + α**2) / (1 - α**2))
    assert 0.2 < least < 0.4 and least * 0.9 < found < least * 1.2
    assert found < 0.5 < 1, "plain images have 1"


def test_the_coefficient_follows_the_correlation():
    mixed = {kept: np.mean([chain_errors(k, 60, kept)[1].alpha.mean() for k in range(10)]) for kept in (0, 0.9, 1)}
    assert mixed[0] < 0.05 and 0.2 < mixed[0.9] < 0.8 and mixed[1] == pytest.approx(LARGEST, abs=0.01)
    worse = np.mean([np.square(chain_errors(k, kept=0.0)[0]).mean() for k in range(10)]) / NOISE**2
    assert worse < 1.1  # steps that leave no pixel as it was cost nothing but the second image


def test_channels_have_coefficients_of_their_own():
    """Depth in metres beside radiance: the large numbers do not decide for the small ones."""
    chain = None
    for n in range(40):
        own, control = (np.dstack([render(1, (k,)), 1e3 * render(1 + 0.01 * n, (k,), 0.0)]) for k in (n, n + 1))
        chain = begun(own, control) if chain is None else followed(chain, own, control)
    assert chain.alpha[:2].min() > 0.8 and chain.alpha[2:].max() < 0.2


def test_images_without_noise_stay():
    black = np.zeros(SHAPE, np.float32)
    chain = followed(followed(begun(black, black), black, black), black, black)
    assert np.all(chain.image == 0) and np.all(chain.alpha == 0)


def test_seeds_come_again_once(llvm):
    """The second seed of a view is its first one when it is seen again, whatever was seen between."""
    problem, estimates, before, used = problem_of(), Recursive(), {}, set()
    for n, key in enumerate([(0, 0), (1, 0), (0, 1), (1, 0), (0, 0), (0, 0), (1, 0)]):
        own, control = estimates.seeds(problem.seed, n, key)
        assert own == before.get(key, own) and own != control and control not in used
        used |= {own, control}
        before[key] = control
        estimates.estimate(key, [render(1, own), render(1, control)])
        estimates.settle()
    assert problem.seed(3, 0, TARGET_IMAGE) == Single().seeds(problem.seed, 3, (0, TARGET_IMAGE))[0]


def test_an_iteration_that_failed_can_be_repeated(llvm):
    estimates, problem = Recursive(), problem_of()
    for n in range(3):
        own, control = estimates.seeds(problem.seed, n, (0, 0))
        for _ in range(2):  # the first time, a worker or the machine fails after the images
            found = estimates.estimate((0, 0), [render(1 + n, own), render(1 + n, control)])
            assert estimates.seeds(problem.seed, n, (0, 0)) == (own, control)
        estimates.settle()
    again = Recursive()
    again.restore(estimates.arrays())
    assert np.all(again.arrays()["0/0/image"] == np.array(found)) and again.arrays().keys() == estimates.arrays().keys()


@pytest.mark.filterwarnings("ignore::psdr_jit.errors.ZeroDerivativeWarning")  # only images are looked at
def test_images_of_a_run_have_less_noise(llvm):
    """A box creeps along: what the loss sees then, beside single images."""
    problem = problem_of(Pose(BOX, 0.02, start_shift=(0.2, 0, -0.1)), spp=4)
    truth, errors = None, {Single: [], Recursive: []}
    for kind, found in errors.items():
        estimates = kind()
        for n in range(24):
            latents = problem.start()
            latents[BOX]["shift"].x -= 2e-4 * n
            problem.apply(latents)
            _, images = problem.evaluate(n, estimates)
            estimates.settle()
            if n >= 16:
                truth = target_of(problem.scene, spp=2048) if truth is None else truth  # it hardly moves from here on
                found.append(np.square(images[0] - truth).mean())
    assert np.mean(errors[Recursive]) < 0.4 * np.mean(errors[Single])


def fixed_problem(**settings):
    scene = scene_of()
    given = {"spp": 4, "control_variate": True, **settings}
    return make_problem(scene, box_and_lamp(), target_of(scene), "l2", integrator_specs.build(FIXED), Settings(**given))


def test_a_resumed_run_carries_on(llvm, tmp_path, monkeypatch):
    whole = loop.run(fixed_problem(iterations=6))
    loop.run(fixed_problem(iterations=3), tmp_path / "parts")
    shutil.copytree(tmp_path / "parts", tmp_path / "forgotten")
    rest = loop.run(fixed_problem(iterations=6), tmp_path / "parts", resume=True)
    assert np.allclose(rest.losses, whole.losses[3:], rtol=1e-3)
    monkeypatch.setattr(control_variate.Recursive, "restore", lambda self, arrays: None)
    lost = loop.run(fixed_problem(iterations=6), tmp_path / "forgotten", resume=True)
    assert not np.allclose(lost.losses, whole.losses[3:], rtol=1e-2), "the test has no power"


@pytest.mark.parametrize("loss", ["relative_l2", "dual_l2"])
def test_several_scenes_and_few_views_per_step(llvm, loss):
    scenes = [scene_of(), scene_of()]
    stages = [Stage(scene, target_of(scene), name=name) for scene, name in zip(scenes, "ab", strict=True)]
    lamp = Parameter("lamp.intensity.value", 0.3, lower=0.5, start_at=8.0)
    result = psdr_jit.optimize(stages, lamp, loss=loss, integrator=FIXED, iterations=12, spp=4, views_per_step=1,
                               control_variate=True)  # fmt: skip
    assert result.status == "finished"
    assert result.offsets["lamp.intensity.value"]["rms"] < 0.5 * result.start_offsets["lamp.intensity.value"]["rms"]


def test_what_is_no_truth_value_is_refused():
    with pytest.raises(OptionError, match="control_variate = 2: expected true or false"):
        Settings(control_variate=2)
