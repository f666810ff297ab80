"""The scene file that an optimisation leaves: it holds what was found, and shows the final image."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from inverse_problems import scene_of, target_of

from psdr_jit import Parameter, SceneFile, optimize, scene_io, traverse
from psdr_jit.cluster.values import to_numpy
from psdr_jit.errors import UnsupportedWarning
from psdr_jit.inverse import config as configs
from psdr_jit.inverse import loop

EXAMPLES = sorted(scene_io.shipped_scene("inverse/shadow.xml").parent.glob("*.toml"))
SPP, SEEDS = 16, range(2)
SAME = 1e-3  # difference of two images that counts as rounding, relative to the noise between seeds


def seen(scene, seed):
    """What the first and the last sensor see by Mitsuba's own `path`."""
    return np.stack([np.array(mi.render(scene, sensor=k, spp=SPP, seed=seed)) for k in {0, len(scene.sensors()) - 1}])


def require_same(problem, folder):
    """The files hold the problem's scenes as they stand: their values to the last digit, their images to rounding."""
    read = [mi.load_file(str(path), optimize=False) for path in sorted(folder.glob("final*.xml"))]
    for part, again in zip(problem.parts, read, strict=True):
        names = [variable.parameter for variable in part.variables.values()]
        own, other = traverse(part.scene, names), traverse(again, names)
        for name in names:
            assert np.array_equal(to_numpy(own[name]), to_numpy(other[name])), name
    final = [[seen(part.scene, seed) for seed in SEEDS] for part in problem.parts]
    written = [[seen(again, seed) for seed in SEEDS] for again in read]
    problem.apply(problem.start())
    for part, own, other in zip(problem.parts, final, written, strict=True):
        noise = np.abs(own[0] - own[1]).mean()
        assert np.abs(seen(part.scene, 0) - own[0]).mean() > 10 * SAME * noise, "a file that says nothing would pass"
        for k in SEEDS:
            assert np.abs(other[k] - own[k]).mean() < SAME * noise


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_leaves_its_scene(llvm, tmp_path, path):
    config = configs.read(path, iterations=2, spp=2, snapshot_every=0)
    small = {**config.defaults, "res": 16}
    targets = tuple({**target, "render": 4} for target in config.targets)
    problem = configs.problem_of(configs.replace(config, defaults=small, targets=targets))
    result = loop.run(problem, tmp_path)
    assert not result.not_written
    require_same(problem, tmp_path)


@pytest.mark.slow
def test_a_scene_that_no_file_can_hold_is_a_warning(llvm, tmp_path):
    source = SceneFile(str(scene_io.shipped_scene("inverse/glass.xml")), {"res": 16})
    scene = scene_io.load_scene(source.path, **source.defaults)
    grey = Parameter("picture.bsdf.reflectance.value", 0.01, start_at=0.3)  # of the material of a shape without one
    with pytest.warns(UnsupportedWarning, match=r"final\.xml.*was not written.*picture\.bsdf"):
        optimize(scene, grey, 2 * target_of(scene, spp=1), iterations=1, spp=1, out=tmp_path, source=source,
                 integrator={"type": "psdr_path", "max_depth": 3})  # fmt: skip
    assert (tmp_path / "final.npz").is_file() and not (tmp_path / "final.xml").exists()


def test_without_a_source_there_is_none(llvm, tmp_path):
    scene = scene_of()
    lamp = Parameter("lamp.intensity.value", 0.1, start_at=8.0)
    optimize(scene, lamp, target_of(scene, spp=1), iterations=1, spp=1, out=tmp_path)
    assert (tmp_path / "final.npz").is_file() and not (tmp_path / "final.xml").exists()
