"""Bad input ends in a typed error or a warning that names the cause and the way out; never in a wrong image."""

from __future__ import annotations

import gc
import os
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from variants import activate

import psdr_jit
from psdr_jit.cli.main import main
from psdr_jit.errors import (
    OptionError,
    ParameterError,
    PsdrError,
    SceneError,
    UnsupportedError,
    UnsupportedWarning,
    ZeroDerivativeWarning,
)
from psdr_jit.options import Options
from psdr_jit.scene import checks
from psdr_jit.scene.facts import analyse

BOX = "box.vertex_positions"
FLOOR = "floor.bsdf.reflectance.value"
TETRAHEDRON = ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])

pytestmark = pytest.mark.filterwarnings("ignore::psdr_jit.errors.UnsupportedWarning")


@pytest.fixture(autouse=True)
def variant(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    activate("llvm_ad_rgb")


def look_at(distance: float = 4.0):
    return mi.ScalarTransform4f().look_at([0, 0, distance], [0, 0, 0], [0, 1, 0])


def camera(**changes):
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    sampler = {"type": "independent", "sample_count": 4}
    return {"type": "perspective", "to_world": look_at(), "film": film, "sampler": sampler, **changes}


def load(**objects):
    """A box before a wall; `name=None` leaves an object out."""
    scene = {
        "type": "scene",
        "sensor": camera(),
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
        "lamp": {"type": "constant"},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.3), "bsdf": {"type": "diffuse"}},
        **objects,
    }
    return mi.load_dict({name: value for name, value in scene.items() if value is not None}, optimize=False)


def triangles(points, faces):
    mesh = mi.Mesh("m", len(points), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.array(points, dtype=np.float32).ravel()
    params["faces"] = np.array(faces, dtype=np.uint32).ravel()
    params.update()
    return mesh


def integrator(**options):
    return mi.load_dict({"type": "psdr_path", "max_depth": 2, **options})


def enabled(scene, name):
    params = mi.traverse(scene)
    theta = mi.Float(0)
    dr.enable_grad(theta)
    value = params[name]
    moved = mi.Transform4f().translate([theta, 0, 0]) @ value if "Transform" in type(value).__name__ else value + theta
    params[name] = moved
    params.update()
    dr.forward(theta, dr.ADFlag.ClearEdges)
    return params


def forward(scene, name=BOX, options=None, **call):
    params = enabled(scene, name)
    return np.array(integrator(**(options or {})).render_forward(scene, params, **call))


def backward(scene, name=BOX, grad_in=None, **options):
    params = mi.traverse(scene)
    dr.enable_grad(params[name])
    params.update()
    grad_in = dr.ones(mi.TensorXf, (8, 8, 3)) if grad_in is None else grad_in
    integrator(**options).render_backward(scene, params, grad_in)
    return np.array(dr.grad(params[name]))


# Options


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sppc": "4"}, "type str: use a whole number"),
        ({"sppc": 4.5}, "type float: use a whole number"),
        ({"sppp": True}, "type bool: use a whole number"),
        ({"sppd": -1}, "use a count >= 0"),
        ({"sppi": 2**40}, "below 2\\^31"),
        ({"hide_emitters": "yes"}, "use true or false"),
        ({"hide_emitters": 1}, "use true or false"),
        ({"max_depth": 3.5}, "whole number"),
        ({"max_depth": -2}, "or -1 for unlimited"),
        ({"max_depth": None}, "whole number"),
        ({"rr_depth": 0}, "use a depth >= 1"),
        ({"record_mib": 1}, "at least 16"),
    ],
)
def test_options_of_the_wrong_type_or_range(options, words):
    with pytest.raises(OptionError, match=words):
        Options(**options)
    if None not in options.values():
        with pytest.raises(RuntimeError, match="OptionError: .*" + words):  # Mitsuba's loader wraps what we raise
            integrator(**options)


def test_unknown_property():
    with pytest.raises(RuntimeError, match="guiding"):
        integrator(guiding="octree")


OFF = {"sppc": 0, "sppp": 0, "sppi": 0}


def test_all_budgets_zero():
    with pytest.raises(OptionError, match="every term is switched off .sppc, sppp"):
        forward(load(), options=OFF)
    with pytest.raises(OptionError, match="every term is switched off"):
        backward(load(), **OFF)
    scene = load()
    params = mi.traverse(scene)
    dr.enable_grad(params[BOX])
    params.update()
    image = mi.render(scene, params, integrator=integrator(**OFF), spp=2)
    with pytest.raises(OptionError, match="every term is switched off"):
        dr.backward(dr.sum(image, axis=None))


def test_sppi_is_the_default_of_sppd():
    assert Options(sppi=0).budget("sppd") == 0 and Options(sppi=0, sppd=2).budget("sppd") == 2
    assert Options().budget("sppd") is None


@pytest.mark.parametrize("call", [{"spp": -3}, {"spp": "4"}, {"spp": 4.5}, {"seed": -1}, {"spp": 2**30}, {"sensor": 3},
                                  {"sensor": -1}, {"sensor": "sensor"}, {"sensor": None}])  # fmt: skip
def test_arguments_of_a_render_call(call):
    with pytest.raises(OptionError):
        forward(load(), **call)


def test_runtime_spp_zero_means_the_sampler():
    assert forward(load(), spp=0).any()


@pytest.mark.parametrize("shape", [(4, 4, 3), (8, 8, 1), (8, 8)])
def test_gradient_image_of_another_shape(shape):
    with pytest.raises(ParameterError, match=r"the image has \(8, 8, 3\)"):
        backward(load(), grad_in=dr.ones(mi.TensorXf, shape))


def test_gradient_image_missing_or_not_finite():
    with pytest.raises(ParameterError, match="grad_in has the shape"):
        integrator().render_backward(prepared := load(), enabled(prepared, BOX), None)
    with pytest.raises(ParameterError, match="not finite"):
        backward(load(), grad_in=dr.full(mi.TensorXf, float("nan"), (8, 8, 3)))


@pytest.mark.parametrize("parameter", [BOX, "sensor.to_world", "lamp.radiance.value", FLOOR])
def test_depth_zero_is_black(parameter):
    assert not forward(load(), parameter, options={"max_depth": 0}).any()


def test_hidden_emitters():
    assert np.isfinite(forward(load(), options={"hide_emitters": True})).all()
    assert backward(load(), hide_emitters=True).any()


# Scenes


@pytest.mark.parametrize(("scene", "error", "words"), [
    ({"sensor": None}, SceneError, "has no sensor"),
    ({"floor": None, "box": None}, UnsupportedError, "no shapes"),
    ({"c": {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}},
     UnsupportedError, "medium"),
    ({"sensor": {"type": "batch", "film": {"type": "hdrfilm", "width": 8, "height": 4}, "a": {"type": "perspective"},
                 "b": {"type": "perspective",
                       "film": {"type": "hdrfilm", "rfilter": {"type": "mitchell"}, "sample_border": True}}}},
     UnsupportedError, "the rfilter of the batch"),
    ({"box": {"type": "cube", "bsdf": {"type": "hair"}}}, UnsupportedError, "use a rough BSDF"),
])  # fmt: skip
def test_scenes_that_are_refused_while_something_moves(scene, error, words):
    parameter = "lamp.radiance.value" if "floor" in scene else BOX
    for render in (forward, backward):
        with pytest.raises(error, match=words):
            render(load(**scene), parameter)


def test_instances_are_refused_if_they_move():
    group = {"g": {"type": "shapegroup", "m": {"type": "cube", "bsdf": {"type": "diffuse"}}},
             "i": {"type": "instance", "r": {"type": "ref", "id": "g"}}}  # fmt: skip
    for parameter in ("g.m.vertex_positions", "i.to_world"):
        with pytest.raises(UnsupportedError, match="load the mesh once per copy"):
            forward(load(**group), parameter)


def test_boundary_terms_do_not_block_materials_seen_by_a_batch_sensor():
    views = {name: {"type": "perspective", "to_world": look_at(z)} for name, z in (("a", 4.0), ("b", 3.0))}
    film = {"type": "hdrfilm", "width": 8, "height": 4, "rfilter": {"type": "box"}}
    assert forward(load(sensor={"type": "batch", "film": film, **views}), FLOOR).any()


def test_nothing_enabled():
    scene = load()
    with pytest.warns(ZeroDerivativeWarning, match=r"dr\.enable_grad"):
        assert not np.array(integrator().render_forward(scene, mi.traverse(scene))).any()


def test_a_scene_without_lights_is_black():
    for derivative in (forward, backward):
        with pytest.warns(ZeroDerivativeWarning, match="no light source"):
            assert not derivative(load(lamp=None)).any()


def test_camera_inside_an_object():
    inside = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(6), "bsdf": {"type": "diffuse"}}
    assert np.isfinite(forward(load(box=inside))).all() and np.isfinite(backward(load(box=inside))).all()


def test_wrong_things_instead_of_a_scene():
    for wrong in (None, "scene.xml"):
        for call in (lambda w=wrong: integrator().render_forward(w, None),
                     lambda w=wrong: psdr_jit.gradient(w, BOX, (1, 0, 0)),
                     lambda w=wrong: psdr_jit.differentiable_params(w)):  # fmt: skip
            with pytest.raises(SceneError, match="expected a Mitsuba scene"):
                call()


# Meshes


def test_mesh_without_faces():
    scene = load(m=triangles(TETRAHEDRON[0], []))
    with pytest.raises(SceneError, match="no faces"):
        forward(scene)
    with pytest.raises(SceneError, match="no faces"):
        psdr_jit.gradient(scene, "m.vertex_positions", (1, 0, 0))


def test_mesh_without_area():
    line = triangles([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]])
    for render in (forward, backward):
        with pytest.raises(SceneError, match="'m' has no face with an area"):
            render(load(m=line), "m.vertex_positions")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_vertices_that_are_not_finite(bad):
    points = [[bad, 0, 0], *TETRAHEDRON[0][1:]]
    for parameter in ("m.vertex_positions", FLOOR):
        with pytest.raises(SceneError, match="1 vertices with NaN or infinite"):
            forward(load(m=triangles(points, TETRAHEDRON[1])), parameter)


def test_faces_with_their_corners_in_a_row():
    mesh = triangles([*TETRAHEDRON[0], [0.5, 0, 0]], [*TETRAHEDRON[1], [0, 4, 1]])
    with pytest.warns(UnsupportedWarning, match="1 faces without area"):
        assert np.isfinite(forward(load(m=mesh), "m.vertex_positions")).all()


# Lobes whose weight is taken for a constant

GREY = {"type": "rgb", "value": 0.8}
MIRROR = {"type": "conductor", "specular_reflectance": GREY}
DELTA = [
    ({"type": "mask", "opacity": 0.5, "b": MIRROR}, "nested_bsdf.specular_reflectance.value"),
    ({"type": "bumpmap", "t": {"type": "checkerboard"}, "b": MIRROR}, "nested_bsdf.specular_reflectance.value"),
    ({"type": "mask", "opacity": 0.5, "b": {"type": "diffuse"}}, "opacity.value"),
    ({"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "conductor"}},
     "bsdf_0.reflectance.value"),
]  # fmt: skip


@pytest.mark.parametrize(("bsdf", "parameter"), DELTA)
def test_parameters_of_delta_lobes_are_not_silently_zero(bsdf, parameter):
    scene = load(box={"type": "cube", "bsdf": bsdf})
    enabled(scene, f"box.bsdf.{parameter}")
    with pytest.raises(UnsupportedError, match="use a rough BSDF") as caught:
        checks.require_supported(analyse(scene))
    assert "blend" in bsdf["type"] or parameter in str(caught.value)


@pytest.mark.parametrize(("bsdf", "parameter"), [
    ({"type": "plastic", "specular_reflectance": GREY}, "diffuse_reflectance.value"),
    ({"type": "mask", "opacity": 0.5, "b": {"type": "diffuse"}}, "nested_bsdf.reflectance.value"),
    ({"type": "roughplastic", "specular_reflectance": GREY}, "specular_reflectance.value"),
    ({"type": "roughdielectric"}, "eta"),
    ({"type": "dielectric", "specular_reflectance": GREY}, "specular_reflectance.value"),
    ({"type": "thindielectric", "specular_transmittance": GREY}, "specular_transmittance.value"),
    ({"type": "conductor", "material": "Cu"}, "eta.value"),
    ({"type": "psdr_plastic", "specular_reflectance": GREY}, "specular_reflectance.value"),
    ({"type": "psdr_plastic"}, "eta"),
    ({"type": "twosided", "b": MIRROR}, "brdf_0.specular_reflectance.value"),
    ({"type": "hair"}, "eumelanin"),
])  # fmt: skip
def test_parameters_of_and_beside_delta_lobes_that_are_fine(bsdf, parameter):
    scene = load(box={"type": "cube", "bsdf": bsdf})
    enabled(scene, f"box.bsdf.{parameter}")
    checks.require_supported(analyse(scene))


# Warnings


def test_tiny_scenes_lack_low_shadows():
    gc.collect()  # virtual calls reach every scene that is alive, also what earlier tests have left
    small = mi.ScalarTransform4f().scale(1e-3)
    objects = {"floor": {"type": "rectangle", "to_world": small}, "box": {"type": "cube", "to_world": small}}
    sensor = camera(to_world=look_at(4e-3), near_clip=1e-5)
    with pytest.warns(UnsupportedWarning, match=r"2\.6% of that: images lack shadows .*; scale the scene up"):
        forward(load(sensor=sensor, **objects))
    far = mi.ScalarTransform4f().translate([1e4, 0, 0])
    with pytest.warns(UnsupportedWarning, match=r"1e\+04 units from the origin.*; move it to the origin"):
        forward(load(floor={"type": "rectangle", "to_world": far}, box={"type": "cube", "to_world": far}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forward(load())


# Variants


def test_variants():
    mi.set_variant("llvm_ad_spectral_polarized")
    with pytest.raises(UnsupportedError, match="use 'llvm_ad_spectral'"):
        forward(load())
    mi.set_variant("llvm_ad_spectral")
    film = {"type": "specfilm", "width": 8, "height": 8, "b": {"type": "spectrum", "value": [(500, 1.0), (700, 0.2)]}}
    with pytest.raises(UnsupportedError, match="hdrfilm"):
        forward(load(sensor=camera(film=film)))
    mi.set_variant("scalar_rgb")
    with pytest.raises(ParameterError, match="does not track derivatives"):
        psdr_jit.gradient(load(), BOX, (1, 0, 0))


# psdr_jit.gradient and psdr_jit.check_gradient


@pytest.mark.parametrize(("arguments", "error"), [
    ({"param": "bix.vertex_positions"}, ParameterError), ({"param": 3}, ParameterError),
    ({"param": "box.faces"}, ParameterError), ({"param": "sensor.film.size"}, ParameterError),
    ({"param": "sensor.near_clip"}, ParameterError), ({"direction": "1,0,0"}, ParameterError),
    ({"direction": (0, 0, 0)}, ParameterError), ({"direction": (np.nan, 0, 0)}, ParameterError),
    ({"direction": None}, ParameterError), ({"direction": None, "index": 1.5}, ParameterError),
    ({"spp": 0}, OptionError), ({"spp": -1}, OptionError), ({"spp": "4"}, OptionError), ({"spp": 1.5}, OptionError),
    ({"sensor": 2}, OptionError), ({"integrator": "nope"}, OptionError), ({"integrator": 3}, OptionError),
    ({"integrator": "diffuse"}, OptionError), ({"integrator": {"max_depth": 3}}, OptionError),
    ({"integrator": {"type": "psdr_path", "spam": 1}}, OptionError),
])  # fmt: skip
def test_arguments_of_gradient_and_check(arguments, error):
    arguments = {"param": BOX, "direction": (1, 0, 0), **arguments}
    for call in (psdr_jit.gradient, psdr_jit.check_gradient):
        with pytest.raises(error):
            call(load(), **arguments)


@pytest.mark.parametrize("arguments", [{"max_seconds": -1}, {"eps": 0}, {"block": -1}, {"block": 99},
                                       {"reference_spp": 0}, {"tolerance": "x"}])  # fmt: skip
def test_arguments_of_check_alone(arguments):
    with pytest.raises(OptionError):
        psdr_jit.check_gradient(load(), BOX, (1, 0, 0), **{"max_seconds": 1, "spp": 2, "reference_spp": 4, **arguments})


def test_scene_without_integrator_uses_ours():
    scene = load()
    assert scene.integrator() is None
    assert psdr_jit.gradient(scene, BOX, (1, 0, 0), spp=2, seeds=2).integrator["type"] == "psdr_path"


# The command line

PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 {}
"""


def write_scene(integrator_text="", shape='<shape type="cube" id="m"/>'):
    film = '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>'
    with open("s.xml", "w", encoding="utf-8") as file:
        file.write(f'<scene version="3.0.0">{integrator_text}<sensor type="perspective">{film}</sensor>'
                   f'<emitter type="constant"/>{shape}</scene>')  # fmt: skip


def command(capsys, *argv):
    """Status and standard error; nothing of ours may be a traceback, and a refusal leaves no file behind."""
    before = sorted(os.listdir())
    status = main(list(argv))
    err = capsys.readouterr().err
    assert "Traceback" not in err
    assert status == 0 or sorted(os.listdir()) == before
    return status, err


GRADIENT = ("gradient", "s.xml", "--wrt", "m.vertex_positions", "--direction", "1,0,0", "--spp", "2", "--seeds", "2",
            "--quiet", "-o")  # fmt: skip


@pytest.mark.parametrize(("options", "words"), [
    ('<string name="sppc" value="4"/>', "sppc = '4' is of type str"),
    ('<integer name="sppc" value="-4"/>', "sppc = -4: use a count"),
    ('<boolean name="max_depth" value="true"/>', "use a whole number"),
    ('<integer name="spam" value="4"/>', "spam"),
])  # fmt: skip
def test_scene_file_with_bad_options(capsys, options, words):
    write_scene(f'<integrator type="psdr_path">{options}</integrator>')
    status, err = command(capsys, *GRADIENT, "o.exr")
    assert status == 2 and words in err and len(err.splitlines()) <= 2


def test_scene_file_for_another_variant(capsys):
    write_scene('<integrator type="psdr_path"/>')
    status, err = command(capsys, "render", "s.xml", "--variant", "scalar_rgb")
    assert status == 2 and "use llvm_ad_rgb" in err


@pytest.mark.parametrize("content", [PLY.format(99999), PLY.format(-1), "ply", "no ply at all", "\x9c\xff", ""])
def test_corrupt_ply(capsys, content):
    with open("m.ply", "w", encoding="latin-1") as file:
        file.write(content)
    write_scene(shape='<shape type="ply" id="m"><string name="filename" value="m.ply"/></shape>')
    status, err = command(capsys, *GRADIENT, "o.exr")
    assert status == 2 and "m.ply" in err


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_sound_ply(capsys, encoding):
    mesh = triangles(*TETRAHEDRON)
    if encoding == "ascii":
        with open("m.ply", "w", encoding="ascii") as file:
            file.write(PLY.format(2))
    else:
        mesh.write_ply("m.ply")
    write_scene(shape='<shape type="ply" id="m"><string name="filename" value="m.ply"/></shape>')
    assert command(capsys, "params", "s.xml")[0] == 0


@pytest.mark.parametrize("argv", [
    [*GRADIENT, "."], [*GRADIENT, "missing/o.exr"], [*GRADIENT, "o.txt"], [*GRADIENT, "/proc/o.exr"],
    ["render", "s.xml", "-o", "."], ["render", "s.xml", "-o", "o.tiff"], ["render", "s.xml", "--seed", "-1"],
    ["render", "s.xml", "--spp", "0"], ["render", "s.xml", "--sensor", "7"], ["render", "missing.xml"],
    ["params", "."], ["demo", "--res", "33"], ["demo", "--out", "s.xml"],
])  # fmt: skip
def test_commands_refuse_before_they_render(capsys, monkeypatch, argv):
    write_scene()
    monkeypatch.setattr(mi, "render", lambda *args, **kwargs: pytest.fail("rendered"))
    status, err = command(capsys, *argv)
    assert status == 2 and err.startswith("psdr: error: ")


def test_warnings_of_a_command_are_one_line_each(capsys):
    write_scene('<integrator type="path"><integer name="max_depth" value="4"/></integrator>',
                '<shape type="cube" id="m"/><emitter type="spot" id="hard"><float name="cutoff_angle" value="20"/>'
                '<float name="beam_width" value="19.99"/></emitter>')  # fmt: skip
    warnings.simplefilter("always")  # pytest restores the filters
    status, err = command(capsys, *GRADIENT, "o.exr")
    lines = [line for line in err.splitlines() if "warning" in line]
    assert status == 0 and len(lines) == len(set(lines)) and any("hard" in line for line in lines)
    assert all(line.startswith("psdr: warning: ") for line in lines)


def test_errors_are_errors_of_python_too():
    assert issubclass(OptionError, ValueError) and issubclass(UnsupportedError, NotImplementedError)
    assert all(issubclass(e, PsdrError) for e in (OptionError, ParameterError, SceneError, UnsupportedError))
