"""What the analysis sees in a scene, and what the checks make of it."""

from __future__ import annotations

import time
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from variants import activate, needs_meshes_without_faces

from psdr_jit.core import compat
from psdr_jit.edges.segments import warn_about_mesh
from psdr_jit.edges.topology import build_edge_topology
from psdr_jit.errors import ParameterError, SceneError, UnsupportedError, UnsupportedWarning, ZeroDerivativeWarning
from psdr_jit.scene.capabilities import PLUGIN_NAMES, SUPPORT, UNSUPPORTED_SHAPES, support_table
from psdr_jit.scene.checks import findings, require_supported
from psdr_jit.scene.facts import analyse
from psdr_jit.scene.params import find_param


@pytest.fixture(autouse=True)
def variant():
    activate("llvm_ad_rgb")


def load(sensor=None, **objects):
    scene = {
        "type": "scene",
        "sensor": sensor or {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "id": "floor_bsdf"}},
        "lamp": {"type": "point", "position": [0, 0, 3]},
    }
    return mi.load_dict({**scene, **objects}, optimize=False)


def enable(scene, *names):
    """Attach parameters to a variable, as an optimisation does."""
    params = mi.traverse(scene)
    for name in names:
        value = params[name]
        theta = mi.Float(0)
        dr.enable_grad(theta)
        if "Transform" in type(value).__name__:
            params[name] = mi.Transform4f().translate([theta, 0, 0]) @ value
        else:
            params[name] = value + theta
    params.update()


def facts_of(scene, *names):
    enable(scene, *names)
    return analyse(scene, 0)


def named(facts, name):
    return next(entry for entry in facts.shapes + facts.emitters if entry.name == name)


def complaints(facts):
    return [(finding.category, finding.subject) for finding in findings(facts)]


def bitmap(filter_type, channels=3, raw=False):
    data = np.random.default_rng(0).random((4, 8, channels)).astype(np.float32)
    return {"type": "bitmap", "filter_type": filter_type, "raw": raw, "bitmap": mi.Bitmap(data)}


BALL = {"type": "sphere", "center": [0, 0, 1], "radius": 0.3}
NOTHING_MOVES = "floor.bsdf.reflectance.value"
CAMERA = "sensor.to_world"


# What is enabled


@pytest.mark.parametrize(
    ("parameter", "where"),
    [
        ("floor.to_world", ("shape", "floor", "geometry")),
        ("box.vertex_positions", ("shape", "box", "geometry")),
        ("box.vertex_texcoords", ("shape", "box", "shading")),
        ("box.vertex_color", ("shape", "box", "shading")),
        ("box.bsdf.reflectance.data", ("shape", "box", "material")),
        (NOTHING_MOVES, ("shape", "floor", "material")),
        ("lamp.position", ("emitter", "lamp", "pose")),
        ("lamp.intensity.value", ("emitter", "lamp", "radiance")),
        ("spot.to_world", ("emitter", "spot", "pose")),
        ("spot.cutoff_angle", ("emitter", "spot", "radiance")),
        ("panel.to_world", ("shape", "panel", "geometry")),
        ("panel.emitter.radiance.value", ("emitter", "panel", "radiance")),
        ("sky.to_world", ("emitter", "sky", "pose")),
        ("sky.data", ("emitter", "sky", "radiance")),
        (CAMERA, ("sensor",)),
        ("sensor.x_fov", ("sensor",)),
        ("sensor.principal_point_offset_x", ("sensor",)),
    ],
)
def test_enabled_parameters_are_found_once_and_in_their_place(parameter, where):
    box = mi.load_dict({"type": "cube", "bsdf": {"type": "twosided", "b": {
        "type": "diffuse", "reflectance": bitmap("bilinear")}}})  # fmt: skip
    box.add_attribute("vertex_color", 3, [0.5] * 72)
    box.set_id("box")
    scene = load(
        box=box,
        spot={"type": "spot"},
        panel={"type": "rectangle", "emitter": {"type": "area"}},
        sky={"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))},
    )
    parameter = parameter.replace("box.bsdf.", "box.bsdf.brdf_0.")
    facts = facts_of(scene, parameter)
    assert facts.anything_enabled and parameter in facts.enabled

    hits = {("shape", s.name, group) for s in facts.shapes for group in ("geometry", "shading", "material")
            if getattr(s, group)}  # fmt: skip
    hits |= {("emitter", e.name, group) for e in facts.emitters for group in ("pose", "radiance")
             if getattr(e, group)}  # fmt: skip
    hits |= {("sensor",)} if facts.sensor.pose else set()
    if parameter == "box.vertex_positions":
        hits.discard(("shape", "box", "shading"))  # Mitsuba recomputes attached normals
    assert hits == {where}
    assert facts.geometry_moves == (where[-1] in ("geometry", "pose", "sensor"))
    assert facts.camera_moves == (where == ("sensor",))


def test_nothing_enabled():
    facts = analyse(load())
    assert not facts.anything_enabled and not facts.geometry_moves
    with pytest.warns(ZeroDerivativeWarning, match=r"dr\.enable_grad"):
        require_supported(facts)


def test_shared_material_belongs_to_every_owner():
    scene = load(
        paint={"type": "diffuse"},
        a={"type": "cube", "bsdf": {"type": "ref", "id": "paint"}},
        b={"type": "cube", "bsdf": {"type": "ref", "id": "paint"}},
    )
    facts = facts_of(scene, "paint.reflectance.value")
    assert named(facts, "a").material == named(facts, "b").material == ("paint.reflectance.value",)
    assert not named(facts, "floor").material


def test_suspended_gradients_count_as_enabled():
    scene = load()
    enable(scene, "floor.to_world")
    with dr.suspend_grad():
        assert analyse(scene).geometry_moves


def test_a_sensor_from_outside_the_scene():
    scene = load()
    sensor = mi.load_dict({"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0})
    enable(sensor, "aperture_radius")
    facts = analyse(scene, sensor)
    assert facts.sensor.plugin == "thinlens" and facts.sensor.pose == ("aperture_radius",)
    assert facts.enabled == ("sensor.aperture_radius",)
    assert not analyse(scene, 0).anything_enabled


def test_another_sensor_moves_nothing_here():
    scene = load(second={"type": "perspective"})
    enable(scene, "second.to_world")
    moves = [analyse(scene, i).geometry_moves for i in range(2)]
    assert sorted(moves) == [False, True]
    assert all(analyse(scene, i).anything_enabled for i in range(2))


# What the scene is made of


def test_facts_about_shapes_and_emitters():
    scene = load(
        ball={**BALL, "emitter": {"type": "area"}},
        box={"type": "cube", "face_normals": True},
        crate={"type": "cube"},
        sun={"type": "directional"},
        sky={"type": "constant"},
    )
    facts = analyse(scene)
    kinds = {s.name: (s.plugin, s.kind, s.is_mesh, s.faces, s.smooth) for s in facts.shapes}
    assert kinds == {
        "floor": ("rectangle", "analytic", True, 2, False),
        "ball": ("sphere", "analytic", False, 0, False),
        "box": ("cube", "mesh", True, 12, False),
        "crate": ("cube", "mesh", True, 12, False),  # its vertex normals are those of its faces
    }
    assert {e.name: (e.plugin, e.delta, e.infinite, e.shape >= 0) for e in facts.emitters} == {
        "lamp": ("point", True, False, False),
        "ball": ("area", False, False, True),
        "sun": ("directional", True, True, False),
        "sky": ("constant", False, True, False),
    }
    assert [facts.shapes[e.shape].name for e in facts.emitters if e.shape >= 0] == ["ball"]
    assert facts.has_delta_emitters and facts.has_infinite_emitters and facts.has_area_emitters
    assert "shape box (cube, mesh, 12 faces, diffuse)" in str(facts)


def test_class_names_are_translated_to_plugin_names():
    for plugin in ("cube", "rectangle", "disk", "sphere", "cylinder"):
        assert PLUGIN_NAMES[mi.load_dict({"type": plugin}).class_name()] == plugin
    bsdfs = ("diffuse", "dielectric", "thindielectric", "conductor", "plastic", "null", "roughconductor",
             "roughdielectric", "roughplastic", "principled", "principledthin", "hair", "psdr_dielectric",
             "psdr_plastic")  # fmt: skip
    for plugin in bsdfs + ("point", "spot", "directional", "constant", "area", "sunsky"):
        assert PLUGIN_NAMES[mi.load_dict({"type": plugin}).class_name()] == plugin


@pytest.mark.parametrize("texture, steps", [
    (bitmap, {"nearest": True, "bilinear": False}),
    (lambda f: bitmap(f, channels=1, raw=True), {"nearest": True, "bilinear": False}),
    (lambda f: {"type": f}, {"checkerboard": True}),
    (lambda f: {"type": "checkerboard", "color0": bitmap(f)}, {"bilinear": True}),
    (lambda f: {"type": "mesh_attribute", "name": f}, {"face_color": True, "vertex_color": False}),
])  # fmt: skip
@pytest.mark.parametrize("name", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_textures_with_steps(texture, steps, name):
    mi.set_variant(name)
    for argument, expected in steps.items():
        ball = {**BALL, "bsdf": {"type": "diffuse", "reflectance": texture(argument)}}
        facts = facts_of(load(ball=ball), "ball.to_world")
        assert bool(named(facts, "ball").patterns) == expected, argument
        assert not named(facts, "ball").jumps and not complaints(facts)


def grid(filter_type: str) -> dict:
    """A texture in space."""
    cells = mi.VolumeGrid(np.random.default_rng(0).random((2, 3, 4, 3)).astype(np.float32))
    return {"type": "volume", "volume": {"type": "gridvolume", "grid": cells, "filter_type": filter_type, "raw": True}}


def test_only_steps_that_are_no_edges_are_warned_about():
    ball = {**BALL, "bsdf": {"type": "diffuse", "reflectance": grid("nearest")}}
    scene = load(ball=ball)
    assert complaints(facts_of(scene, "ball.to_world")) == [(UnsupportedWarning, "ball")]
    assert not complaints(facts_of(load(ball=ball), NOTHING_MOVES))
    for bsdf in ({"type": "diffuse", "reflectance": grid("trilinear")},
                 {"type": "bumpmap", "arbitrary": bitmap("bilinear"), "bsdf": {"type": "diffuse"}}):  # fmt: skip
        assert not complaints(facts_of(load(ball={**BALL, "bsdf": bsdf}), "ball.to_world"))


def test_patterns_of_what_glows():
    """On the shape, where they are seen; a light that carries one elsewhere is warned about."""
    ball = {**BALL, "emitter": {"type": "area", "radiance": bitmap("nearest", raw=True)}}
    facts = facts_of(load(ball=ball), "ball.to_world")
    assert named(facts, "ball").patterns and not complaints(facts)


# What is refused and what is let through


def test_a_plain_scene_passes_without_a_word():
    scene = load(
        ball={**BALL, "emitter": {"type": "area"}},
        box={"type": "cube", "bsdf": {"type": "roughconductor"}},
        sky={"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))},
        spot={"type": "spot"},
    )
    facts = facts_of(scene, "floor.to_world", CAMERA, "sky.to_world", "spot.to_world", "ball.to_world")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        require_supported(facts)


@pytest.mark.parametrize(
    ("bsdf", "lobes"),
    [
        ({"type": "dielectric"}, {"dielectric: DeltaReflection", "dielectric: DeltaTransmission"}),
        ({"type": "psdr_dielectric"}, {"psdr_dielectric: DeltaReflection", "psdr_dielectric: DeltaTransmission"}),
        ({"type": "thindielectric"}, {"thindielectric: DeltaReflection", "thindielectric: Null"}),
        ({"type": "conductor"}, {"conductor: DeltaReflection"}),
        ({"type": "twosided", "b": {"type": "plastic"}}, {"plastic: DeltaReflection"}),
        ({"type": "mask", "b": {"type": "diffuse"}}, {"mask: Null"}),
        ({"type": "null"}, {"null: Null"}),
        ({"type": "roughplastic"}, set()),
        ({"type": "roughdielectric"}, set()),
        ({"type": "principled", "spec_trans": 0.5}, set()),
    ],
)  # fmt: skip
def test_specular_lobes(bsdf, lobes):
    scene = {"ball": {**BALL, "bsdf": bsdf}}
    for moving in ("floor.to_world", "lamp.position", CAMERA):
        facts = facts_of(load(**scene), moving)
        assert set(named(facts, "ball").delta_lobes) == lobes
        assert complaints(facts) == []
    require_supported(facts_of(load(**scene), NOTHING_MOVES))
    steps = {"type": "spot", "cutoff_angle": 20, "beam_width": 20}
    assert complaints(facts_of(load(**scene, spot=steps), CAMERA)) == ([(UnsupportedWarning, "ball")] if lobes else [])


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "mask", "b": {"type": "conductor"}},
        {"type": "normalmap", "normalmap": {"type": "rgb", "value": 0.5}, "b": {"type": "dielectric"}},
        {"type": "hair"},
    ],
    ids=["mask", "normalmap", "hair"],
)
def test_specular_lobes_that_are_not_followed(bsdf):
    facts = facts_of(load(ball={**BALL, "bsdf": bsdf}), "floor.to_world")
    assert complaints(facts) == [(UnsupportedError, "ball")]
    with pytest.raises(UnsupportedError, match=f"through which motion is not followed, because '{bsdf['type']}'"):
        require_supported(facts)


def test_specular_lobes_beside_an_instance():
    """All but grids: of these there are no copies."""
    grid = {"type": "sdfgrid", "grid": mi.TensorXf([-1.0, 1] * 4, (2, 2, 2, 1))}
    for inner, refused in (({"type": "cube"}, False), (grid, True)):
        group = {"type": "shapegroup", "id": "group", "inner": {**inner, "id": "inner"}}
        objects = {"group": group, "copy": {"type": "instance", "g": {"type": "ref", "id": "group"}}}
        facts = facts_of(load(ball={**BALL, "bsdf": {"type": "dielectric"}}, **objects), "floor.to_world")
        if refused:
            with pytest.raises(UnsupportedError, match="an instance shows the grid"):
                require_supported(facts)
        else:
            require_supported(facts)


def exotic_shapes(folder):
    curve = folder / "curve.txt"
    curve.write_text("0 0 0 0.1\n0 0 1 0.1\n0 1 1 0.1\n1 1 1 0.1\n")  # x y z radius
    one = {"centers": mi.TensorXf([[0, 0, 0]]), "scales": mi.TensorXf([[1, 1, 1]]),
           "quaternions": mi.TensorXf([[0, 0, 0, 1]])}  # fmt: skip
    return {
        "sdfgrid": {"x": {"type": "sdfgrid", "grid": mi.TensorXf([-1.0, 1] * 6, (3, 2, 2, 1))}},  # uneven
        "ellipsoids": {"x": {"type": "ellipsoids", "extent_adaptive_clamping": True, **one,
                             "opacities": mi.TensorXf([[0.5]])}},
        "ellipsoidsmesh": {"x": {"type": "ellipsoidsmesh", **one}},
        "bsplinecurve": {"x": {"type": "bsplinecurve", "filename": str(curve)}},
        "linearcurve": {"x": {"type": "linearcurve", "filename": str(curve)}},
    }


@pytest.mark.parametrize("plugin", ["sdfgrid", "ellipsoids", "ellipsoidsmesh"])
def test_shapes_without_edges(plugin, tmp_path):
    objects = exotic_shapes(tmp_path)[plugin]
    for moving in ("floor.to_world", "lamp.position", CAMERA):
        facts = facts_of(load(**objects), moving)
        assert (named(facts, "x").plugin, named(facts, "x").kind) == (plugin, "unsupported")
        assert (UnsupportedError, "x") in complaints(facts)
        with pytest.raises(UnsupportedError, match=UNSUPPORTED_SHAPES[plugin]):
            require_supported(facts)
    assert not complaints(facts_of(load(**objects), NOTHING_MOVES))


GROUP = {"type": "shapegroup", "inner": BALL}
INSTANCE = {"group": GROUP, "x": {"type": "instance", "g": {"type": "ref", "id": "group"}}}


def test_instances_may_rest_while_something_moves():
    for moving in ("floor.to_world", "lamp.position", CAMERA, NOTHING_MOVES):
        facts = facts_of(load(**INSTANCE), moving)
        assert (named(facts, "x").kind, named(facts, "x").group) == ("instance", "")
        assert (named(facts, "inner").index, named(facts, "inner").group) == (-1, "group")
        assert not complaints(facts)


@pytest.mark.parametrize(("moving", "name"), [("group.inner.to_world", "inner"), ("x.to_world", "x")])
def test_what_is_instanced_must_not_move(moving, name):
    scene = load(**INSTANCE)
    facts = facts_of(scene, moving)
    assert complaints(facts) == [(UnsupportedError, name)]
    with pytest.raises(UnsupportedError, match="load the mesh once per copy"):
        require_supported(facts)
    with pytest.raises(ParameterError, match="load the mesh once per copy"):
        find_param(scene, moving)


def test_groups_must_be_told_apart():
    scene = load(a=GROUP, b=GROUP)
    for node in mi.traverse(scene).hierarchy:
        if node.id() in ("a", "b"):
            node.set_id("twice")
    with pytest.raises(UnsupportedError, match="give each an id"):
        facts_of(scene, NOTHING_MOVES)


def test_media_are_refused_always():
    fog = {**BALL, "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "albedo": 0.5}}
    facts = facts_of(load(fog=fog), NOTHING_MOVES)
    assert complaints(facts) == [(UnsupportedError, "fog")]


def test_polarised_variants_are_refused():
    if "llvm_ad_spectral_polarized" not in mi.variants():
        pytest.skip("this Mitsuba has no polarised variant")
    mi.set_variant("llvm_ad_spectral_polarized")
    facts = facts_of(load(), NOTHING_MOVES)
    with pytest.raises(UnsupportedError, match="'llvm_ad_spectral'"):
        require_supported(facts)


def test_variants_without_derivatives_are_refused():
    mi.set_variant("scalar_rgb")
    with pytest.raises(UnsupportedError, match="llvm_ad_rgb"):
        analyse(load())


def test_sensors():
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    batch = {"type": "batch", "a": {"type": "perspective", "film": film}, "b": {"type": "perspective"},
             "film": film}  # fmt: skip
    good = [{"type": "orthographic"}, {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 1.0}]
    for sensor in good:
        assert not complaints(facts_of(load(sensor=sensor), "floor.to_world"))
    facts = facts_of(load(sensor=batch), "floor.to_world")
    with pytest.raises(UnsupportedError, match="rfilter of the batch"):
        require_supported(facts)
    assert not complaints(facts_of(load(sensor=batch), NOTHING_MOVES))


@pytest.mark.parametrize(
    ("plugin", "matrix", "uneven"),
    [
        ("sphere", np.diag([2, 2, 2, 1]), False),
        ("sphere", np.diag([1, 2, 1, 1]), True),
        ("sphere", np.array([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), True),
        ("cylinder", np.diag([2, 2, 5, 1]), False),
        ("cylinder", np.diag([1, 2, 1, 1]), True),
        ("disk", np.diag([1, 2, 1, 1]), False),
        ("rectangle", np.diag([1, 2, 1, 1]), False),
    ],
)
def test_stretched_shapes(plugin, matrix, uneven):
    turn = mi.ScalarTransform4f().translate([3, 1, 2]).rotate([0.6, 0, 0.8], 40)
    scene = {"x": {"type": plugin, "to_world": turn @ mi.ScalarTransform4f(matrix)}}
    assert complaints(facts_of(load(**scene), "x.to_world")) == ([(SceneError, "x")] if uneven else [])
    assert not complaints(facts_of(load(**scene), NOTHING_MOVES))


@needs_meshes_without_faces
def test_empty_meshes():
    facts = facts_of(load(void=mi.Mesh("void", 0, 0)), NOTHING_MOVES)
    with pytest.raises(SceneError, match="'void' .* no faces"):
        require_supported(facts)


def test_non_finite_vertices():
    box = mi.load_dict({"type": "cube", "id": "box"})
    scene = load(box=box)
    params = mi.traverse(scene)
    positions = np.array(params["box." + compat.VERTEX_POSITIONS])
    positions[[4, 5, 30]] = np.nan, np.inf, -np.inf
    params["box." + compat.VERTEX_POSITIONS] = mi.Float(positions)
    params.update()
    facts = facts_of(scene, NOTHING_MOVES)
    assert named(facts, "box").bad_vertices == 2 and named(facts, "floor").bad_vertices == 0
    with pytest.raises(SceneError, match="'box' .* 2 vertices"):
        require_supported(facts)


@pytest.mark.parametrize(
    ("emitter", "moving", "warned"),
    [
        ({"type": "spot", "cutoff_angle": 20, "beam_width": 20}, "floor.to_world", False),
        ({"type": "spot", "cutoff_angle": 20, "beam_width": 19.99}, "floor.to_world", True),
        ({"type": "spot", "cutoff_angle": 20, "beam_width": 19.99}, "light.cutoff_angle", True),
        ({"type": "spot", "cutoff_angle": 20, "beam_width": 19.99}, "light.intensity.value", False),
        ({"type": "spot", "cutoff_angle": 20, "beam_width": 15}, "light.to_world", False),
        ({"type": "spot", "texture": {"type": "checkerboard"}}, "light.to_world", False),
        ({"type": "projector", "irradiance": 1.0}, "light.to_world", False),
        ({"type": "projector", "irradiance": 1.0}, "light.scale", False),
        ({"type": "sunsky"}, CAMERA, True),
        ({"type": "sunsky"}, "floor.to_world", False),
    ],
)
def test_emitters_with_steps(emitter, moving, warned):
    facts = facts_of(load(light=emitter), moving)
    assert complaints(facts) == ([(UnsupportedWarning, "light")] if warned else [])
    if warned:
        with pytest.warns(UnsupportedWarning, match="'light'"):
            require_supported(facts)


@pytest.mark.parametrize("light, steps, pose", [
    ({"type": "spot", "cutoff_angle": 20, "beam_width": 20}, ("the rim of its cone",), True),
    ({"type": "spot", "cutoff_angle": 20, "beam_width": 15}, (), False),
    ({"type": "spot", "cutoff_angle": 20, "beam_width": 20, "sampling_weight": 0.0}, (), False),  # lights nothing
    ({"type": "spot", "texture": {"type": "checkerboard"}}, ("checkerboard",), True),
    ({"type": "projector", "irradiance": 1.0}, ("its frame",), True),
    ({"type": "projector", "irradiance": {"type": "checkerboard"}}, ("its frame", "checkerboard"), True),
])  # fmt: skip
def test_steps_that_a_light_brings_along(light, steps, pose):
    """Where it has any, what opens its cone counts as a pose: it moves them."""
    moving = "light.to_world" if light["type"] == "projector" else "light.cutoff_angle"
    emitter = named(facts_of(load(light=light), moving), "light")
    assert tuple(step.split(" '")[0] for step in emitter.steps) == steps and bool(emitter.pose) == pose


def test_moving_texture_coordinates_slide_steps():
    box = {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}}
    facts = facts_of(load(box=box), "box." + compat.VERTEX_TEXCOORDS)
    assert not facts.geometry_moves and complaints(facts) == [(UnsupportedWarning, "box")]


def test_several_obstacles_come_in_one_message():
    fur, mask = {**BALL, "bsdf": {"type": "hair"}}, {**BALL, "bsdf": {"type": "mask", "b": {"type": "conductor"}}}
    facts = facts_of(load(fur=fur, mask=mask), "floor.to_world")
    with pytest.raises(UnsupportedError, match=r"(?s)2 obstacles.*'fur'.*'mask'"):
        require_supported(facts)


def test_a_warning_is_shown_once():
    cells = {"type": "diffuse", "reflectance": grid("nearest")}
    facts = facts_of(load(tiles={"type": "rectangle", "bsdf": cells}), "tiles.to_world")
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("default")
        for _ in range(3):
            require_supported(facts)
    assert len(shown) == 1 and "volume" in str(shown[0].message)


def test_slivers_are_named_with_their_number():
    p = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 1, 0], [-1, -1, 0], [0, 0, 2]], float)
    f = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4], [0, 1, 5], [1, 2, 0]])
    with pytest.warns(UnsupportedWarning) as shown:
        warn_about_mesh("fan", build_edge_topology(p, f))
    texts = [str(w.message) for w in shown]
    assert len(texts) == 1 and "'fan' has 1 faces without area" in texts[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_about_mesh("triangle", build_edge_topology(p, f[:1]))


# Costs, and the table


def test_analysis_is_cheap():
    objects = {f"box{i}": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": bitmap("nearest")}}
               for i in range(10)}  # fmt: skip
    scene = load(**objects)
    enable(scene, "box3.vertex_positions")
    analyse(scene)
    samples = []
    for _ in range(10):
        began = time.perf_counter()
        facts = analyse(scene)
        samples.append(time.perf_counter() - began)
    assert facts.geometry_moves
    assert np.median(samples) < 0.05  # about 4 ms on two quiet cores


def test_analysis_works_while_a_function_is_being_frozen(nothing_collected):
    scene = load(ball=BALL)
    enable(scene, "ball.to_world")

    @dr.freeze
    def frozen(x):
        assert analyse(scene).geometry_moves
        return x + 1

    assert dr.allclose(frozen(mi.Float(1, 2)), [2, 3])


def test_support_table_names_every_status():
    assert {row.status for row in SUPPORT} == {"yes", "warning", "error"}
    assert support_table().count("\n") == len(SUPPORT) + 1


def test_mesh_buffers():
    box = mi.load_dict({"type": "cube"})
    p, f = compat.mesh_positions(box), compat.mesh_faces(box)
    assert (dr.width(p), dr.width(f)) == (24, 12)
    assert dr.allclose(compat.pack_positions(p), mi.traverse(box)[compat.VERTEX_POSITIONS])


@pytest.mark.parametrize("degrees", [0, 20])
def test_turned_grids(degrees):
    """Mitsuba shades them as if they were not turned; instances of them it does turn."""
    grid = np.linalg.norm(np.mgrid[-1:1:4j, -1:1:4j, -1:1:4j], axis=0)[..., None].astype(np.float32) - 0.8
    pose = mi.ScalarTransform4f().rotate([0, 0.6, 0.8], degrees).scale([1, 2, 1])
    sdf = {"type": "sdfgrid", "grid": mi.TensorXf(grid), "bsdf": {"type": "diffuse"}}
    scene = {"x": {**sdf, "to_world": pose}}
    assert complaints(facts_of(load(**scene), "floor.to_world")) == ([(SceneError, "x")] if degrees else [])
    assert not complaints(facts_of(load(**scene), NOTHING_MOVES))
