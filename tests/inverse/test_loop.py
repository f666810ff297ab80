"""The loop: what it finds, how views add up, and that it costs the same in every iteration."""

from __future__ import annotations

import gc
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from batch_views import batch_of
from inverse_problems import BOX, LAMP, box_and_lamp, problem_of, scene_of, target_of
from variants import also

import psdr_jit
from psdr_jit import Parameter, Pose
from psdr_jit.derivative import images, integrator_specs
from psdr_jit.errors import OptionError, ParameterError, StalledWarning
from psdr_jit.inverse import loop
from psdr_jit.inverse.problem import make_problem
from psdr_jit.inverse.settings import Settings
from psdr_jit.inverse.targets import rendered
from psdr_jit.scene import io as scene_io


def gradient_of(problem, iteration=0):
    """Loss and gradient by latent, without a step."""
    latents = problem.start()
    for found in latents.values():
        for value in found.values():
            dr.enable_grad(value)
    problem.apply(latents)
    loss, _ = problem.evaluate(iteration)
    return loss, {n: {k: np.array(dr.grad(v)).ravel() for k, v in found.items()} for n, found in latents.items()}


@pytest.mark.slow
def test_box_and_lamp_are_found(llvm):
    scene = scene_of()
    target = target_of(scene)
    result = psdr_jit.optimize(scene, box_and_lamp(), target, integrator={"type": "psdr_path", "max_depth": 2},
                               iterations=60, spp=16, decay=0.1)  # fmt: skip
    assert result.status == "finished" and result.iterations == 60 and len(result.losses) == 60
    assert result.start_offsets[BOX]["distance"] == pytest.approx(0.2236, abs=1e-3)
    assert result.offsets[BOX]["distance"] < 0.03 and result.offsets["lamp.intensity.value"]["rms"] < 0.2
    assert np.mean(result.losses[-5:]) < 0.05 * result.losses[0]
    left = np.array(mi.traverse(scene)[BOX]).reshape(-1, 3).mean(0)  # the scene is left there
    assert np.linalg.norm(left - [0, -0.2, 0]) < 0.03


@pytest.mark.parametrize("name", [also("l1"), also("relative_l2"), "dual_l2"])
def test_every_loss_goes_down(llvm, name):
    scene = scene_of()
    box = Pose(BOX, 0.02, start_shift=(0.2, 0, 0), shift_axes="x")
    result = psdr_jit.optimize(scene, box, target_of(scene), loss=name,
                               integrator={"type": "psdr_path", "max_depth": 2}, iterations=20, spp=8)  # fmt: skip
    assert result.offsets[BOX]["distance"] < 0.06


@pytest.mark.slow
def test_a_box_is_found_by_its_depth(llvm, tmp_path):
    """A loss of AOVs, whose channels are named in the files."""
    scene, integrator = scene_of(), {"type": "psdr_path", "max_depth": 2, "aovs": "dd:depth"}
    target = rendered(scene, 0, integrator_specs.build(integrator), 256)
    box = Pose(BOX, 0.02, start_shift=(0.2, 0, 0), shift_axes="x")
    result = psdr_jit.optimize(scene, box, target, integrator=integrator, iterations=40, spp=8, snapshot_every=39,
                               loss=lambda image, wanted: dr.mean(dr.square((image - wanted)[:, :, 3:4]), axis=None),
                               out=tmp_path, decay=0.1)  # fmt: skip
    assert result.offsets[BOX]["distance"] < 0.03
    for file in (next((tmp_path / "views").iterdir()), tmp_path / "snapshots" / "000039.exr"):
        names = {name.partition(".")[2] for name in images.read_exr(file) if name.partition(".")[2] != "T"}
        assert names == {"", "R", "G", "B", "dd.T"}, (file, names)


def test_own_losses_integrators_and_variables(llvm):
    class Brightness:
        """A variable of one's own: the logarithm of the intensity."""

        parameter, uniform = "lamp.intensity.value", False
        learning_rates = {"log": 0.05}

        def begin(self, scene, params):
            self.own = float(np.log(np.array(params[self.parameter]).ravel()[0]))
            return {"log": mi.Float(self.own)}

        def start(self, latents, rng):
            return {"log": mi.Float(self.own + 0.5)}

        def value(self, latents):
            return mi.Color3f(dr.exp(latents["log"]))

        def constrained(self, latents):
            return latents

        def offset(self, latents):
            return {"log": abs(float(latents["log"][0]) - self.own)}

    def darkness(image, target):
        return dr.abs(dr.mean(image, axis=None) - dr.mean(target, axis=None))

    scene = scene_of()
    target = np.array(target_of(scene))
    result = psdr_jit.optimize(scene, Brightness(), target, loss=darkness, integrator="prb", iterations=25, spp=4)
    assert result.offsets["lamp.intensity.value"]["log"] < 0.1


def two_views(**settings):
    text = scene_io.shipped_scene("point_shadow.xml").read_text()
    start, end = text.index("<sensor"), text.index("</sensor>") + len("</sensor>")
    second = text[start:end].replace('id="camera"', 'id="other"').replace("0.7, 2.2, 4", "-2.5, 2.2, 2")
    scene = mi.load_string(text[:end] + second + text[end:], res=16, max_depth=2, optimize=False)
    targets = [target_of(scene, sensor) for sensor in (0, 1)]
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "sppc": 4, "sppp": 4, "sppi": 4})
    variables = [Pose(BOX, 0.02, start_shift=(0.2, 0, -0.1)), Pose(LAMP, 0.02)]
    return make_problem(scene, variables, targets, "l2", integrator, Settings(spp=4, **settings))


@pytest.mark.parametrize("plugin", ["psdr_path", "prb_projective"])
def test_gradients_of_views_add_up(llvm, plugin):
    """One backward pass per view, one update: Mitsuba issues 1587 and 1877 are about losing all but one of them."""
    both = two_views()
    if plugin != "psdr_path":
        other = integrator_specs.build({"type": plugin, "max_depth": 2, "guiding": "none"})
        both = replace(both, parts=(replace(both.parts[0], integrator=other),))
    alone = [gradient_of(OnlyView(both, k)) for k in (0, 1)]
    loss, together = gradient_of(both)
    assert loss == pytest.approx(np.mean([a[0] for a in alone]), rel=1e-4)
    for name in together:
        for latent, value in together[name].items():
            parts = [a[1][name][latent] for a in alone]
            assert np.allclose(value, np.mean(parts, axis=0), rtol=2e-3, atol=1e-4 * np.abs(parts).max())
            if plugin == "psdr_path":
                assert all(np.abs(part).max() > 0 for part in parts)


class OnlyView:
    """A problem that sees one of its views."""

    def __init__(self, problem, k):
        self._problem, self._k = problem, k

    def __getattr__(self, name):
        return getattr(self._problem, name)

    def evaluate(self, iteration):
        return type(self._problem).evaluate(self, iteration)

    def _view(self, *which):
        return type(self._problem)._view(self._problem, *which)

    def chosen(self, iteration):
        return [self._k]


def test_minibatches_visit_every_view_alike(llvm):
    problem = two_views(views_per_step=1)
    seen = [problem.chosen(i)[0] for i in range(40)]
    assert sorted(seen) == [0] * 20 + [1] * 20 and seen != [0, 1] * 20
    assert all(set(seen[k : k + 2]) == {0, 1} for k in range(0, 40, 2))  # each once per round
    assert len({problem.seed(i, v, p) for i in range(50) for v in (0, 1) for p in range(3)}) == 300


@pytest.mark.slow
def test_batch_sensor_is_optimised(llvm):
    scene = batch_of()
    variable = Pose(BOX, 0.02, shift_axes="xz", start_shift=(0.2, 0, -0.1))
    result = psdr_jit.optimize(scene, variable, target_of(scene, spp=64), iterations=30, spp=8, decay=0.1,
                               integrator={"type": "psdr_path", "max_depth": 2})  # fmt: skip
    assert result.offsets[BOX]["distance"] < 0.05


@pytest.mark.parametrize("name", ["box and lamp", "camera", "several views"])
def test_no_kernel_is_compiled_after_the_first_iteration(llvm, name):
    if name == "several views":
        problem = two_views(iterations=8)
    else:
        variables = [Pose("camera.to_world", 0.01, turn_rate=0.2, turn_axes="xyz")] if name == "camera" else None
        problem = problem_of(variables, iterations=8)
    stepper = loop.Stepper(problem)
    known, new = set(), []
    for _ in range(8):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            stepper.step()
            found = {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}
        new.append(len(found - known))
        known |= found
    assert new[0] > 0 and not any(new[1:]), new


@pytest.mark.slow
@pytest.mark.parametrize("iterations", [50, pytest.param(1000, marks=pytest.mark.slow)])
def test_memory_is_flat(llvm, iterations):
    """Resident memory, looked at ten times; what the first tenth leaves behind does not count."""
    target = np.zeros((16, 16, 3))
    problem = problem_of([Pose(BOX, 1e-4, shift_axes="x")], targets=target, spp=1, iterations=iterations)
    stepper = loop.Stepper(problem)
    held = []
    for k in range(iterations):
        stepper.step()
        if (k + 1) % (iterations // 10) == 0:
            gc.collect()
            held.append(resident_mib())
    assert abs(held[-1] / held[1] - 1) < 0.02, held


def resident_mib() -> float:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * 4096 / 2**20


def test_a_variable_that_nothing_depends_on_is_named(llvm):
    """The box itself is out of view, and light is scattered once."""
    scene = scene_of("inverse/shadow")
    variable = Parameter("blocker.bsdf.reflectance.value", 0.01)
    words = r"blocker.bsdf.reflectance.value \(value\) for 5 iterations.*the latest plan: interior runs"
    with pytest.warns(StalledWarning, match=words):
        psdr_jit.optimize(scene, variable, np.zeros((16, 16, 3)), iterations=7, spp=4)


def test_a_loss_that_does_not_depend_on_the_image(llvm):
    with pytest.raises(ParameterError, match="does not depend on the image"):
        loop.run(problem_of(loss=lambda image, target: dr.mean(target, axis=None), iterations=2))


def test_a_diverging_run_stops_and_keeps_the_best(llvm):
    start = Pose(BOX, 2.0, start_shift=(0.02, 0, 0), shift_axes="x")
    problem = problem_of([start], iterations=60, diverged_factor=1.5)
    with pytest.warns(RuntimeWarning, match="diverged"):
        result = loop.run(problem)
    assert result.status == "diverged" and result.iterations < 60
    assert result.offsets[BOX]["distance"] < 2.5  # not where it ended


def test_a_loss_that_is_not_finite_stops_and_keeps_the_best(llvm, tmp_path):
    calls = []

    def breaks(image, target):
        calls.append(1)
        scale = float("nan") if len(calls) == 8 else 1.0
        return scale * dr.mean(dr.square(image - target), axis=None)

    problem = problem_of(loss=breaks, iterations=20)
    with pytest.warns(RuntimeWarning, match="diverged.*at iteration 7"):
        result = loop.run(problem, tmp_path)
    assert result.status == "diverged" and len(result.losses) == 8
    assert 0 < result.offsets[BOX]["distance"] < result.start_offsets[BOX]["distance"]
    assert "NaN" not in (tmp_path / "log.jsonl").read_text()


class Broken(Parameter):
    """Its adjoint is not finite."""

    def value(self, latents):
        x = latents["value"]
        return x + dr.sqrt(dr.detach(x) - x)


def test_gradients_that_are_not_finite_stop_the_run(llvm):
    with pytest.warns(RuntimeWarning, match="lamp.intensity.value .value. has not been finite for 5 iterations"):
        result = loop.run(problem_of([Broken("lamp.intensity.value", 0.1)], iterations=20))
    assert result.status == "diverged" and len(result.losses) <= 6


def test_views_that_differ_do_not_look_like_divergence(llvm):
    """One of two views is black and has no loss: minibatches of one see 0 and something by turns."""
    problem = two_views(views_per_step=1, iterations=24)
    dark = replace(problem.views[0], target=problem.views[0].target * 0)
    other = replace(problem, views=(replace(dark, sensor=problem.views[1].sensor), problem.views[1]))
    result = loop.run(other)
    assert result.status == "finished"


def test_history_compares_whole_rounds():
    from psdr_jit.inverse.history import History

    history = History(period=2, signed=False, start="start")
    assert history.window == 6
    for k in range(40):
        history.add(1.0 if k % 2 else 1e-6, k)
        assert not history.diverges(10)
    for k in range(6):
        history.add(20.0, "worse")
    assert history.diverges(10) and history.best == 0
    noisy = History(period=1, signed=True, start="start")
    for k in range(60):
        noisy.add(1e-3 * (-1) ** k * (1 + k % 3), k)
        assert not noisy.diverges(10)


def test_optimisers_by_name(llvm):
    for kind in ("adam", "adamw", "sgd", "rmsprop"):
        result = loop.run(problem_of(iterations=2, optimizer={"type": kind}))
        assert result.iterations == 2
    with pytest.raises(OptionError, match="momentum"):
        loop.run(problem_of(optimizer={"type": "adam", "momentum": 0.5}))
