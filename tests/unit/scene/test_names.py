"""Names of parameters of objects without an id: the same in every process, and accepted wherever a name is."""

from __future__ import annotations

import re
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from variants import activate

import psdr_jit
from psdr_jit.cli.main import main
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.errors import OptionError, ParameterError
from psdr_jit.scene.names import stable_name, traverse
from psdr_jit.scene.params import differentiable_params, find_param

XML = """<scene version="3.0.0">
<integrator type="psdr_path"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film></sensor>
<bsdf type="diffuse" id="paint"/>
<shape type="rectangle"><ref id="paint"/></shape>
<shape type="cube"><transform name="to_world"><scale value="0.3"/></transform></shape>
<shape type="cube" id="box"><transform name="to_world"><translate x="0.6"/><scale value="0.1"/></transform></shape>
<emitter type="point"><point name="position" value="0.2, 0.3, 3"/></emitter>
<emitter type="constant"/>
</scene>"""

CONFIG = """scene = "s.xml"
iterations = 1
spp = 2
[[target]]
render = 2
[[variable]]
kind = "vertices"
parameter = "{}"
learning_rate = 0.01
smoothness = 0
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    activate("llvm_ad_rgb")
    (tmp_path / "s.xml").write_text(XML)


def load(text: str = XML) -> mi.Scene:
    return mi.load_string(text, optimize=False)


def test_no_name_holds_an_address():
    scene = load()
    names = [info.name for info in differentiable_params(scene)]
    assert not re.search(r"\d{5}", " ".join(names))
    assert {"sensor.to_world", "shape[0].to_world", "shape[1].vertex_positions", "box.vertex_positions",
            "emitter[0].position", "emitter[1].radiance.value", "paint.reflectance.value"} <= set(names)  # fmt: skip
    assert len(names) == len(mi.traverse(scene)) == len(set(names))


def test_places_are_those_of_mitsuba_s_lists():
    params = traverse(load(XML.replace("<bsdf", '<sensor type="perspective"/><bsdf')))
    scene = next(iter(params.hierarchy))
    assert params.properties["sensor[1].to_world"][2] is scene.sensors()[1]
    assert params.properties["shape[1].vertex_positions"][2] is scene.shapes()[1]


def test_every_spelling_is_the_same_parameter():
    scene = load()
    own = next(key for key in mi.traverse(scene).keys() if key.endswith("x_fov"))
    for name, expected in ((own, "sensor.x_fov"), ("sensor[0].x_fov", "sensor.x_fov"),
                           ("shape.to_world", "shape[0].to_world"),
                           ("shape[2].vertex_positions", "box.vertex_positions")):  # fmt: skip
        assert stable_name(scene, name) == expected == find_param(scene, name).name
    assert perturb(scene, own).name == "sensor.x_fov"
    with pytest.raises(ParameterError, match=r"did you mean .*shape\[1\]\.vertex_positions"):
        find_param(scene, "shape[7].vertex_positions")


def test_an_id_wins_over_a_type():
    scene = load(XML.replace('id="box"', 'id="sensor"'))
    assert find_param(scene, "sensor.vertex_positions").kind == "geometry"
    assert find_param(scene, "sensor[0].to_world").kind == "camera"


def test_parameters_are_written_under_their_stable_names():
    scene = load()
    params = psdr_jit.traverse(scene)
    params["shape[1].vertex_positions"] = params["shape[1].vertex_positions"] + 1
    params.update()
    assert np.isclose(float(scene.shapes()[1].bbox().max.x), 1.3)


def test_python_functions_accept_them():
    scene = load()
    how = dict(direction=(1, 0, 0), spp=2)
    result = psdr_jit.gradient(scene, "shape[1].vertex_positions", seeds=1, **how)
    assert result.param == "shape[1].vertex_positions" and result.total.any()
    check = psdr_jit.check_gradient(scene, "shape[2].vertex_positions", max_seconds=0.1, reference_spp=4, **how)
    assert check.param == "box.vertex_positions"
    plan = psdr_jit.make_plan(scene, "shape[2].vertex_positions", spp=1)
    assert plan.running and not dr.grad_enabled(mi.traverse(scene)["box.vertex_positions"])
    variable = psdr_jit.Pose("shape[2].vertex_positions", learning_rate=0.01)
    result = psdr_jit.optimize(scene, variable, np.zeros((4, 4, 3)), iterations=1, spp=2)
    assert "shape[2].vertex_positions" in result.offsets
    with pytest.raises(OptionError, match="several variables"):
        twice = [variable, psdr_jit.Pose("box.vertex_positions", learning_rate=0.01)]
        psdr_jit.optimize(scene, twice, np.zeros((4, 4, 3)), iterations=1)


def test_commands_take_what_another_process_lists(capsys):
    listed = subprocess.run([sys.executable, "-m", "psdr_jit.cli.main", "params", "s.xml"], capture_output=True,
                            text=True, check=True).stdout  # fmt: skip
    (name,) = re.findall(r"^(shape\S*1\S*\.vertex_positions)", listed, re.MULTILINE)
    assert main(["gradient", "s.xml", "--wrt", name, "--direction", "1,0,0", "--spp", "1", "--seeds", "1"]) == 0
    assert main(["plan", "s.xml", "--wrt", name]) == 0
    with open("c.toml", "w", encoding="utf-8") as file:
        file.write(CONFIG.format("shape[2].vertex_positions"))
    assert main(["optimize", "c.toml", "--out", "out"]) == 0
    assert "shape[2].vertex_positions" in capsys.readouterr().out
