"""Several scenes in one loss: gradients add up, latents are shared, workers step alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from inverse_problems import BOX, target_of

import psdr_jit
from psdr_jit import Parameter, Pose, SceneFile, Stage, scene_io, traverse
from psdr_jit.cluster.values import to_numpy
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.inverse import config, loop
from psdr_jit.inverse.problem import GRADIENT, make_problem
from psdr_jit.inverse.settings import Settings

FILES = {name: SceneFile(str(scene_io.shipped_scene(f"inverse/lamp_{name}.xml")), {"res": 16})
         for name in ("left", "right")}  # fmt: skip
WEIGHTS = {"left": 1.0, "right": 0.25}
BUDGETS = {"type": "psdr_path", "max_depth": 2, "sppc": 4, "sppp": 4, "sppi": 4, "form": "spatial"}
ROUNDING = 1e-5
PLAIN = 2.0, 100.0, 1e4  # learning rates of plain descent by which all variables move


def stages(spp: int = 32) -> list[Stage]:
    found = []
    for name, file in FILES.items():
        scene = scene_io.load_scene(file.path, **file.defaults)
        found.append(Stage(scene, target_of(scene, spp=spp), WEIGHTS[name], name, file))
    return found


def variables(rates: tuple[float, float, float] = (0.02, 1.0, 0.1)) -> list[Any]:
    pose = {"turn_axes": "y", "start_shift": (0.2, -0.1, 0.1), "start_turn": (0, 8, 0)}
    return [
        Pose(BOX, rates[0], turn_rate=rates[1], **pose),
        Parameter("right:lamp.intensity.value", rates[2], start_at=12.0),
    ]


def gradients(problem: Any) -> tuple[float, dict[str, np.ndarray]]:
    """Loss and gradient at the start, by variable and latent."""
    latents = problem.start()
    for name in latents:
        dr.enable_grad(latents[name])
    problem.apply(latents)
    loss, _ = problem.evaluate(0)
    found = {f"{name} {key}": np.array(dr.grad(value)).ravel().astype(np.float64)
             for name, own in latents.items() for key, value in own.items()}  # fmt: skip
    problem.apply(problem.start())
    return loss, found


class Alone:
    """One scene of a problem, rendered by the one integrator, with the seeds that it has among the others."""

    def __init__(self, whole: Any, k: int) -> None:
        self.whole, self.k = whole, k

    def gradient(self) -> tuple[float, dict[str, np.ndarray]]:
        """By a backward pass of a scene that is loaded anew, and no other one's graph."""
        own = self.whole.parts[self.k]
        scene = scene_io.load_scene(own.source.path, **own.source.defaults)
        params, found = traverse(scene), {}
        latents = {name: self.whole.start()[name] for name in own.variables}
        for name, variable in own.variables.items():
            dr.enable_grad(latents[name])
            params[variable.parameter] = variable.value(latents[name])
            params.set_dirty(variable.parameter)
        params.update()
        view, integrator = self.whole.views[self.k], mi.load_dict(BUDGETS)
        with dr.suspend_grad():
            seed = self.whole.seed(0, self.k, 0)
            image = integrator.render(scene, scene.sensors()[0], seed=seed, spp=self.whole.settings.spp)
        difference = mi.TensorXf(dr.detach(image)) - view.target
        image = mi.render(scene, params, integrator=integrator, seed=seed,
                          seed_grad=self.whole.seed(0, self.k, GRADIENT), spp=self.whole.settings.spp)  # fmt: skip
        dr.backward(dr.sum(image * (2 / float(np.prod(difference.shape))) * difference, axis=None))
        for name, kinds in latents.items():
            found |= {f"{name} {key}": np.array(dr.grad(v)).ravel().astype(np.float64) for key, v in kinds.items()}
        return float(dr.mean(dr.square(difference), axis=None).array[0]), found


def joint(**settings: Any) -> Any:
    return make_problem(stages(), variables(), None, "l2", BUDGETS, Settings(**{"spp": 4, **settings}))


def test_the_gradient_of_the_sum_is_the_sum_of_gradients(llvm):
    whole = joint()
    loss, found = gradients(whole)
    wanted, total = {name: 0.0 for name in found}, 0.0
    for k, name in enumerate(FILES):
        own_loss, own = Alone(whole, k).gradient()
        total += WEIGHTS[name] * own_loss
        for key, value in own.items():
            assert np.abs(value).max() > 0
            wanted[key] = wanted[key] + WEIGHTS[name] * value
    assert loss == pytest.approx(total, rel=ROUNDING)
    for key, value in found.items():
        assert np.abs(value - wanted[key]).max() <= ROUNDING * np.abs(wanted[key]).max(), key
    box = f"{BOX} shift"
    one = Alone(whole, 0).gradient()[1][box]
    assert np.abs(one - found[box]).max() > 0.01 * np.abs(found[box]).max(), "one scene alone would pass"


def test_few_views_per_step_are_right_on_average(llvm):
    whole = joint(views_per_step=1)
    assert whole.period == 2 and {whole.chosen(k)[0] for k in range(2)} == {0, 1}
    assert [view.name for view in whole.views] == ["left_camera", "right_camera"]
    mean = np.mean([whole.factor(k, whole.chosen(0)) for k in (0, 1)])
    assert mean == pytest.approx(sum(WEIGHTS.values()))  # of losses that are alike
    assert sum(whole.factor(k, [0, 1]) for k in (0, 1)) == pytest.approx(sum(WEIGHTS.values()))


def test_poses_are_shared_where_each_scene_has_the_body(llvm):
    """A pose shifts a body from wherever a scene has it; the lamp of one scene is that one's alone."""
    given = stages(spp=1)
    params = traverse(given[1].scene)
    params[BOX] = params[BOX] + 0.25
    params.update()
    before = [to_numpy(traverse(stage.scene)[BOX]) for stage in given]
    lamp = to_numpy(traverse(given[0].scene)["lamp.intensity.value"])
    problem = make_problem(given, variables(), None, "l2", BUDGETS, Settings(spp=1))
    problem.apply(problem.start())
    moves = [to_numpy(traverse(s.scene)[BOX]) - own for s, own in zip(given, before, strict=True)]
    assert np.allclose(moves[0], moves[1], atol=1e-5) and np.abs(moves[0]).max() > 0.1
    assert np.array_equal(to_numpy(traverse(given[0].scene)["lamp.intensity.value"]), lamp)
    assert np.all(to_numpy(traverse(given[1].scene)["lamp.intensity.value"]) == 12)
    assert set(problem.offsets(problem.start())) == {BOX, "right:lamp.intensity.value"}


def test_what_is_wrong_is_said_before_it_runs(llvm):
    one, other = stages(spp=1)
    box = Pose(BOX, 0.02)

    def problem(given: Any, found: Any = box, integrator: Any = None, targets: Any = None) -> Any:
        return make_problem(given, found, targets, "l2", integrator, Settings(spp=1))

    for wrong, words in (
        (lambda: problem([one, Stage(other.scene, other.targets, name="left")]), "'left': give each another name"),
        (lambda: problem([one, Stage(other.scene, other.targets, weight=0)]), "weight = 0 of a scene"),
        (lambda: problem([one, other.scene]), "a list of psdr_jit.Stage"),
        (lambda: problem([one, other], targets=one.targets), "have targets each"),
        (lambda: problem([one, other], integrator=mi.load_dict({"type": "psdr_path"})), "an integrator of its own"),
        (lambda: problem([one, other], [box, Pose(f"left:{BOX}", 0.02)]), "belongs to several variables"),
    ):
        with pytest.raises(OptionError, match=words):
            wrong()
    with pytest.raises(OptionError, match="give each psdr_jit.Stage its source"):
        psdr_jit.optimize([one, other], box, source=FILES["left"], iterations=1, spp=1)
    with pytest.raises(ParameterError, match="no parameter 'boxx.vertex_positions'"):
        problem([one, other], Pose("boxx.vertex_positions", 0.02))
    with pytest.raises(ParameterError, match=r"not the same in all scenes.*'SCENE:floor"):
        params = traverse(other.scene)
        params["floor.bsdf.reflectance.value"] = mi.Color3f([0.1, 0.2], 0.1, 0.1)
        params.update()
        problem([one, other], Parameter("floor.bsdf.reflectance.value", 0.1))


MISTAKES = """
iterations = 1
[[scene]]
file = "nowhere.xml"
weight = -1
[[scene]]
nam = "b"
file = "{file}"
[[target]]
render = 4
[[variable]]
kind = "pose"
parameter = "blocker.vertex_positions"
learning_rate = 0.1
"""


def test_every_mistake_of_a_file(tmp_path):
    path = tmp_path / "several.toml"
    path.write_text(MISTAKES.format(file=FILES["left"].path))
    with pytest.raises(OptionError) as caught:
        config.read(path)
    for words in ("[[scene]] 1: there is no file", "[[scene]] 1: weight = -1", "no key 'nam'; did you mean 'name'?",
                  "[[scene]] 2: there must be at least one [[scene.target]]", "[[target]] does not say of which"):
        assert words in str(caught.value), words


def whole_run(*rates: Any, **who: Any) -> Any:
    given = {"iterations": 4, "spp": 4, "integrator": BUDGETS, **who}
    return psdr_jit.optimize(stages(), variables(*rates), **given)


@pytest.mark.slow
def test_two_workers_step_as_this_process_does(llvm, tmp_path):
    pytest.importorskip("distributed")
    from psdr_jit.cluster import engine

    one = {"iterations": 1, "optimizer": {"type": "sgd"}}  # Adam would hide a factor
    own, longer = whole_run(PLAIN, **one), whole_run()
    with engine.local(2) as two:
        assert_same(own, whole_run(PLAIN, **one, client=two), ROUNDING)
        assert_same(longer, whole_run(client=two), 5e-3)  # after some steps a last bit may flip a sample
    for name, kinds in own.start_offsets.items():
        assert any(abs(own.offsets[name][kind] / start - 1) > 0.01 for kind, start in kinds.items()), name


def assert_same(a: Any, b: Any, tolerance: float) -> None:
    assert np.allclose(a.losses, b.losses, rtol=tolerance)
    for name, kinds in a.offsets.items():
        for kind, value in kinds.items():
            assert b.offsets[name][kind] == pytest.approx(value, rel=tolerance)


@pytest.mark.slow
def test_it_leaves_a_file_of_each_scene_and_resumes(llvm, tmp_path):
    result = whole_run(iterations=2, out=tmp_path, snapshot_every=1)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"final_left.xml", "final_right.xml", "left_blocker.ply", "right_blocker.ply", "final.npz"} <= names
    assert not result.not_written
    values = np.load(tmp_path / "final.npz")
    assert set(values) == {f"left:{BOX}", f"right:{BOX}", "right:lamp.intensity.value"}
    for name in FILES:
        again = traverse(scene_io.load_scene(tmp_path / f"final_{name}.xml"))
        assert np.array_equal(to_numpy(again[BOX]).reshape(-1, 3), values[f"{name}:{BOX}"])
    rest = whole_run(iterations=4, out=tmp_path, resume=True)
    undisturbed = whole_run(iterations=4)
    assert len(rest.losses) == 2 and np.allclose(rest.losses, undisturbed.losses[2:], rtol=5e-3)


@pytest.mark.slow
def test_the_example_finds_box_and_lamps(llvm, tmp_path):
    """`lamps.toml` with fewer samples and pixels."""
    file = Path(scene_io.shipped_scene("inverse/lamp_left.xml")).with_name("lamps.toml")
    found = config.read(file, iterations=100, spp=8, defaults={"res": 32})
    problem = config.problem_of(found)
    result = loop.run(problem)
    start, now = result.start_offsets, result.offsets
    assert now[BOX]["distance"] < 0.1 * start[BOX]["distance"], (start, now)
    assert now[BOX]["angle_degrees"] < 0.2 * start[BOX]["angle_degrees"], (start, now)
    for name in ("left", "right"):
        lamp = f"{name}:lamp.intensity.value"
        assert now[lamp]["rms"] < 0.1 * start[lamp]["rms"], (start, now)
