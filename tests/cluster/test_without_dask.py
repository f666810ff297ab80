"""What a worker needs travels whole; and without Dask nothing of it is loaded, or missed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from clusters import BOX, FILE, RES

import psdr_jit
from psdr_jit.cluster import engine, worker
from psdr_jit.cluster.source import SceneFile, parcel_of
from psdr_jit.cluster.values import changed, digests
from psdr_jit.cluster.worker import Place
from psdr_jit.errors import ClusterError, OptionError, SceneError, SetupError
from psdr_jit.scene import io as scene_io


def test_dask_is_loaded_only_when_it_is_asked_for():
    code = "import sys, psdr_jit.cluster.engine; assert not {'dask', 'distributed'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_its_absence_is_named_with_the_way_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SetupError, match=r"pip install 'distributed"), engine.local(2):
        pass


def place_of(scene, **values) -> Place:
    return Place("llvm_ad_rgb", parcel_of(SceneFile(FILE, RES)), values, worker.versions())


def as_by_network(numbers: np.ndarray) -> np.ndarray:
    """The same in a part of a message, which begins anywhere."""
    return np.frombuffer(b"x" + numbers.tobytes(), numbers.dtype, offset=1).reshape(numbers.shape)


def corner(scene) -> float:
    return float(np.array(psdr_jit.traverse(scene)[BOX])[0])


def test_parameters_follow_the_caller_and_come_back(llvm):
    scene = scene_io.load_scene(FILE, **RES)
    params = psdr_jit.traverse(scene)
    before, base = digests(params), corner(scene)
    assert changed(params, before) == {}
    params[BOX] = params[BOX] + 0.25
    pose = params["floor.to_world"]
    params["floor.to_world"] = type(pose)().translate([0, 0.5, 0]) @ pose
    params.update()
    values = changed(params, before)
    assert {BOX, "floor.to_world"} <= values.keys()
    held = worker.hold(place_of(scene, **{name: as_by_network(v) for name, v in values.items()}))
    assert held.scene is not scene and corner(held.scene) == pytest.approx(base + 0.25)
    there = psdr_jit.traverse(held.scene)
    assert np.allclose(np.array(there["floor.to_world"].matrix), np.array(params["floor.to_world"].matrix))
    assert not dr.grad_enabled(there[BOX])
    assert np.array(there[BOX], copy=False).ctypes.data % 4 == 0, "Embree would go on with what was there before"
    again = worker.hold(place_of(scene))
    assert again is held, "the same file is loaded once"
    assert corner(again.scene) == pytest.approx(base), "what is not asked for any more is as in the file"
    assert digests(psdr_jit.traverse(again.scene)) == before
    worker._HELD.clear()


@pytest.mark.parametrize("at_once", [1, 2])
def test_as_many_scenes_are_kept_as_the_caller_works_with(llvm, at_once):
    """Loading again for every unit would be slow, keeping more than that would fill the memory."""
    files = [SceneFile(FILE, {"res": res, "max_depth": 2}) for res in (4, 5, 6)]
    places = [Place("llvm_ad_rgb", parcel_of(file), {}, worker.versions(), at_once) for file in files]
    try:
        first, second = worker.hold(places[0]), worker.hold(places[1])
        assert second is not first
        assert (worker.hold(places[0]) is first) == (at_once == 2)
        worker.hold(places[2])
        assert worker.hold(places[1]) is not second, "the one that was not used for longest is forgotten"
    finally:
        worker._HELD.clear()


def test_another_version_is_refused():
    own = worker.versions()
    with pytest.raises(ClusterError, match="mitsuba .* instead of 9.9.9: install the same"):
        worker.require_versions({**own, "mitsuba": "9.9.9"})
    worker.require_versions(own)


def test_errors_name_the_machine(tmp_path: Path, llvm):
    scene = tmp_path / "a.xml"
    scene.write_text('<scene version="3.0.0"><sensor type="perspective"/></scene>')
    parcel = parcel_of(SceneFile(str(scene)))
    scene.write_text('<scene version="3.0.0"><sensor type="orthographic"/></scene>')
    place = Place("llvm_ad_rgb", parcel, {}, worker.versions())
    for words in ("other contents there", "does not exist there"):
        with pytest.raises(SceneError, match=f"on machine '.+': scene file '.*a.xml'.*{words}.*send=True"):
            worker.work(len, place)
        scene.unlink(missing_ok=True)


def test_what_travels_is_whole(tmp_path: Path, llvm):
    """Files beside the scene, also those that an include names, arrive where there is nothing of them."""
    folder = tmp_path / "here"
    (folder / "parts").mkdir(parents=True)
    mesh = scene_io.shipped_scene("meshes/box.obj").read_bytes()
    (folder / "parts" / "box.obj").write_bytes(mesh)
    shape = '<shape type="obj" id="b"><string name="filename" value="$mesh"/></shape>'
    (folder / "box.xml").write_text(f'<scene version="3.0.0">{shape}</scene>')
    main = folder / "main.xml"
    main.write_text('<scene version="3.0.0"><default name="mesh" value="none.obj"/><include filename="box.xml"/>'
                    '<sensor type="perspective"/></scene>')  # fmt: skip
    given = {"mesh": "parts/box.obj"}
    parcel = parcel_of(SceneFile(str(main), given, send=True))
    assert set(parcel.files) == {"main.xml", "box.xml", "parts/box.obj"}
    before = parcel.digest
    folder.rename(tmp_path / "gone")
    assert "b.vertex_positions" in psdr_jit.traverse(parcel.load())
    (tmp_path / "gone").rename(folder)
    (folder / "parts" / "box.obj").write_bytes(mesh + b"\n")
    assert parcel_of(SceneFile(str(main), given)).digest != before, "a mesh that differs is another scene"


def test_what_lies_elsewhere_does_not_travel(tmp_path: Path, llvm):
    (tmp_path / "a").mkdir()
    (tmp_path / "box.obj").write_text("v 0 0 0\n")
    scene = tmp_path / "a" / "s.xml"
    shape = '<shape type="obj"><string name="filename" value="../box.obj"/></shape>'
    scene.write_text(f'<scene version="3.0.0">{shape}</scene>')
    with pytest.raises(OptionError, match="not below its folder"):
        parcel_of(SceneFile(str(scene), send=True))
