"""Without optional packages everything else is there, and they are not loaded unasked."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from test_architecture import modules

import psdr_jit

OPTIONAL = ("dask", "distributed", "rerun", "tensorboardX", "IPython", "ipykernel", "jupyter_client", "nbclient",
            "nbformat", "cholespy", "torch")  # fmt: skip

WITHOUT = """
import importlib, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {optional}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
import psdr_jit
for name in {modules}:
    importlib.import_module("psdr_jit." + name)
assert not {optional} & set(sys.modules)
"""

RUN = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = psdr_jit.scene_io.load_scene(psdr_jit.scene_io.shipped_scene("point_shadow.xml"), res=8)
found = psdr_jit.gradient(scene, "blocker.vertex_positions", (1, 0, 0), spp=2, seeds=2)
found._repr_html_()
target = mi.render(scene, spp=4)
box = psdr_jit.Pose("blocker.vertex_positions", 0.01)
assert psdr_jit.optimize(scene, box, target, iterations=1, spp=2)._repr_html_()
for make in (psdr_jit.LiveView, psdr_jit.EventFiles):
    try:
        make("a.rrd")
    except psdr_jit.errors.SetupError as error:
        assert "pip install " in str(error)
    else:
        raise AssertionError(make)
"""


def without(code: str, folder: Path) -> subprocess.CompletedProcess:
    """Run `code` where no optional package can be found."""
    names = [name for name in modules() if name != "setup.llvm_probe" and not name.endswith("__main__")]
    names = [name for name in names if not name.startswith("plugins.")]  # those need a variant
    start = WITHOUT.format(optional=set(OPTIONAL), modules=names)
    return subprocess.run([sys.executable, "-c", start + code], cwd=folder, capture_output=True, text=True, timeout=300)


def test_everything_imports_without_optional_packages(tmp_path):
    done = without("", tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_gradients_and_optimisations_run_without_them(llvm, tmp_path):
    done = without(RUN, tmp_path)
    assert done.returncode == 0, done.stderr


def test_they_are_no_dependencies():
    tomllib = pytest.importorskip("tomllib", reason="needs Python 3.11")
    project = tomllib.loads((Path(psdr_jit.__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    core = " ".join(project["project"]["dependencies"]).lower()
    assert not [name for name in (*OPTIONAL, "jupyter") if name.lower() in core]
    assert {"cluster", "rerun", "tensorboard"} <= project["project"]["optional-dependencies"].keys()
