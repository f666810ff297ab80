"""Scene files of scenes as they are now: read again, they are the same scene."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit import SceneFile, scene_io, traverse, write_scene
from psdr_jit.cluster.values import from_numpy, to_numpy
from psdr_jit.errors import OptionError, SceneError, UnsupportedError
from psdr_jit.scene.params import is_transform


def moved(scene, *names):
    """Change these parameters; their numbers by name."""
    params = traverse(scene)
    for name in names:
        numbers = to_numpy(params[name]).astype(np.float32)
        if is_transform(params[name]):
            numbers[:3, 3] += 0.1
        else:
            numbers = numbers * np.float32(0.97) + np.float32(1e-3)
        params[name] = from_numpy(params[name], numbers)
        params.set_dirty(name)
    params.update()
    return {name: to_numpy(params[name]) for name in names}


def written(scene, path, source):
    return scene_io.load_scene(write_scene(scene, path, source))


FAST = {
    "inverse/glass.xml": ["camera.to_world", "camera.x_fov", "ball.bsdf.eta", "ball.to_world",
                          "picture.emitter.radiance.color1.value"],
    "point_shadow.xml": ["blocker.vertex_positions", "lamp.position", "lamp.intensity.value"],
}  # fmt: skip
SLOW = {
    "environment_shadow.xml": ["sky.data", "sky.to_world"],
    "rough_conductor.xml": ["ball.bsdf.eta.value", "ball.to_world"],
    "inverse/mirror.xml": ["mirror.bsdf.k.value", "mirror.to_world"],
    "textured_emitter.xml": ["card.emitter.radiance.data"],
    "curve_shadow.xml": ["blocker.control_points"],
    "rod_shadow.xml": ["blocker.control_points"],
    "grid_shadow.xml": ["blocker.grid", "blocker.to_world"],
    "spot_light.xml": ["lamp.cutoff_angle", "lamp.to_world"],
    "camera_thinlens.xml": ["camera.aperture_radius", "camera.to_world"],
}  # fmt: skip


@pytest.mark.parametrize("name", [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_what_was_changed_comes_back(llvm, tmp_path, name):
    source = SceneFile(str(scene_io.shipped_scene(name)), {"res": 8})
    scene = scene_io.load_scene(source.path, **source.defaults)
    names = {**FAST, **SLOW}[name]
    before = {key: to_numpy(traverse(scene)[key]) for key in names}
    changed = moved(scene, *names)
    again = traverse(written(scene, tmp_path / "now.xml", source))
    for key, value in changed.items():
        assert not np.array_equal(value, before[key]), "nothing was changed: the test has no power"
        assert np.array_equal(to_numpy(again[key]), value), key


ROOM = """<scene version="3.0.0">
    <default name="radius" value="0.25"/>
    <include filename="parts.xml"/>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/>
        </film></sensor>
    <shape type="sphere"><float name="radius" value="$radius"/><ref id="red"/></shape>
    <shape type="sphere"><point name="center" x="0.1" y="1" z="1e-7"/><ref id="red"/></shape>
    <shape type="disk"><bsdf type="twosided"><bsdf type="roughconductor"><string name="material" value="Au"/>
        <float name="alpha" value="0.2"/></bsdf></bsdf>
        <emitter type="area"><spectrum name="radiance" value="0.5"/></emitter></shape>
</scene>"""
PARTS = """<scene version="3.0.0">
    <bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.6, 0.1, 0.1"/></bsdf>
</scene>"""


def test_objects_without_ids_includes_and_shared_ones(llvm, tmp_path):
    (tmp_path / "room.xml").write_text(ROOM)
    (tmp_path / "parts.xml").write_text(PARTS)
    source = SceneFile(str(tmp_path / "room.xml"), {"radius": 0.75})
    scene = scene_io.load_scene(source.path, **source.defaults)
    names = ["shape[1].to_world", "red.reflectance.value", "shape[2].bsdf.brdf_0.k.value",
             "shape[2].emitter.radiance.value"]  # fmt: skip
    names = [name for name in names if name in traverse(scene)]
    assert len(names) == 4, sorted(traverse(scene).keys())
    changed = moved(scene, *names)
    path = write_scene(scene, tmp_path / "out" / "now.xml", source)
    again = traverse(mi.load_file(str(path), optimize=False))
    whole = traverse(scene)
    assert [*again.keys()] == [*whole.keys()]
    for key, value in changed.items():
        assert np.array_equal(to_numpy(again[key]), value), key
    assert np.array_equal(to_numpy(again["shape[0].to_world"]), to_numpy(whole["shape[0].to_world"]))
    assert mi.load_file(str(path)).shapes(), "Mitsuba loads it by itself"


def test_the_comment_names_plugins_of_ours(llvm, tmp_path):
    source = SceneFile(str(scene_io.shipped_scene("inverse/glass.xml")), {"res": 8})
    path = write_scene(scene_io.load_scene(source.path, res=8), tmp_path / "now.xml", source)
    assert "import psdr_jit before it is loaded: it brings psdr_dielectric" in path.read_text()


def test_what_no_file_can_say_is_an_error_and_leaves_none(llvm, tmp_path):
    source = SceneFile(str(scene_io.shipped_scene("inverse/glass.xml")), {"res": 8})
    scene = scene_io.load_scene(source.path, **source.defaults)
    moved(scene, "picture.bsdf.reflectance.value")  # of the material that Mitsuba gives to shapes without one
    with pytest.raises(UnsupportedError, match=r"picture\.bsdf\.reflectance\.value.*such as a <bsdf>"):
        write_scene(scene, tmp_path / "now.xml", source)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["point_shadow.xml", "camera_crop.xml"])
def test_a_film_of_another_size_than_the_file_says(llvm, tmp_path, name):
    """As when a scene is loaded with a `res` that `source` does not name."""
    path = str(scene_io.shipped_scene(name))
    scene = scene_io.load_scene(path, res=52)  # with room for the crop
    film, own = (s.sensors()[0].film() for s in (written(scene, tmp_path / "now.xml", path), scene))
    assert film.size()[0] == 52 != scene_io.load_scene(path).sensors()[0].film().size()[0]
    for size in ("size", "crop_size", "crop_offset"):
        assert [*getattr(film, size)()] == [*getattr(own, size)()], size


def test_a_crop_that_the_file_does_not_have(llvm, tmp_path):
    path = str(scene_io.shipped_scene("point_shadow.xml"))
    scene = scene_io.load_scene(path)
    params = traverse(scene)
    params["camera.film.crop_size"], params["camera.film.crop_offset"] = [7, 5], [2, 3]
    params.update()
    film = written(scene, tmp_path / "now.xml", path).sensors()[0].film()
    assert ([*film.crop_size()], [*film.crop_offset()]) == ([7, 5], [2, 3])


def test_a_value_that_reading_changes_is_an_error(llvm, tmp_path):
    source = SceneFile(str(scene_io.shipped_scene("point_shadow.xml")), {"res": 8})
    scene = scene_io.load_scene(source.path, **source.defaults)
    params = traverse(scene)
    params["blocker.vertex_normals"] = 2 * dr.detach(params["blocker.vertex_normals"])
    params.update()
    with pytest.raises(UnsupportedError, match=r"blocker\.vertex_normals.*another value"):
        write_scene(scene, tmp_path / "now.xml", source)
    assert not list(tmp_path.iterdir())


def test_another_source_and_the_source_itself(llvm, tmp_path):
    shadow = str(scene_io.shipped_scene("point_shadow.xml"))
    scene = scene_io.load_scene(scene_io.shipped_scene("inverse/glass.xml"), res=8)
    with pytest.raises(SceneError, match="not the one in the file"):
        write_scene(scene, tmp_path / "now.xml", shadow)
    with pytest.raises(OptionError, match="choose another name"):
        write_scene(scene, shadow, shadow)
    with pytest.raises(OptionError, match=r"ends in \.xml"):
        write_scene(scene, tmp_path / "now", shadow)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["floor.bsdf.reflectance.data", "sky.data", "paint.reflectance.value"])
def test_spectral_variants_are_refused_with_the_way_out(llvm, tmp_path, name):
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/></texture>'
    mi.util.write_bitmap(str(tmp_path / "a.png"), np.full((4, 4, 3), 0.5, np.float32))
    source = tmp_path / "s.xml"
    source.write_text(
        f'<scene version="3.0.0"><sensor type="perspective"/><bsdf type="diffuse" id="paint"/>'
        f'<emitter type="envmap" id="sky"><string name="filename" value="a.png"/></emitter>'
        f'<shape type="rectangle" id="floor"><bsdf type="diffuse">{texture}</bsdf></shape>'
        f'<shape type="rectangle" id="wall"><ref id="paint"/></shape></scene>'
    )
    mi.set_variant("llvm_ad_spectral")
    try:
        scene = scene_io.load_scene(source)
        moved(scene, name)
        with pytest.raises(UnsupportedError, match="keep coefficients of colours; write it under an rgb variant"):
            write_scene(scene, tmp_path / "out.xml", source)
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_meshes_without_an_id_have_files_of_their_own():
    from psdr_jit.export.assets import add_file

    contents: dict = {}
    names = [add_file(contents, name, content) for name, content in (
        ("shape[1].ply", b"a"), ("shape[1].ply", b"b"), ("a b/c.ply", b"c"), (".ply", b"d"))]  # fmt: skip
    assert names == ["shape_1.ply", "shape_1_1.ply", "a_b_c.ply", "file.ply"] and len(contents) == 4
