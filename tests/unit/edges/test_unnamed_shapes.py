"""Files leave many shapes without an id: what is remembered of one must not be taken for, or replaced by, another's."""

from __future__ import annotations

import mitsuba as mi

from psdr_jit.core.memory import Memory, key_of
from psdr_jit.edges import intersections
from psdr_jit.edges.segments import edge_set
from psdr_jit.scene.names import shown_name

CUBES = """<scene version="3.0.0">
    <shape type="cube"/>
    <shape type="cube"><transform name="to_world"><scale value="0.5"/><translate x="0.9" y="0.1"/></transform></shape>
    <shape type="cube"><transform name="to_world"><scale value="0.4"/><translate x="-0.9" z="0.2"/></transform></shape>
</scene>"""


def test_pairs_of_unnamed_shapes_are_remembered(llvm, monkeypatch):
    scene, looked_at, memory = mi.load_string(CUBES, optimize=False), [], Memory()
    meshes, search = list(scene.shapes()), intersections.mesh_mesh
    monkeypatch.setattr(intersections, "mesh_mesh", lambda a, b: looked_at.append((a, b)) or search(a, b))
    assert {mesh.id() for mesh in meshes} == {""} and len({key_of(mesh) for mesh in meshes}) == 3
    first, second = (edge_set(meshes, [True] * 3, memory) for _ in range(2))
    assert len(looked_at) == 2  # of both small cubes with the large one, once
    assert second.junctions.edges is first.junctions.edges


def test_messages_tell_what_an_unnamed_shape_is(llvm):
    shapes = mi.load_dict({"type": "scene", "a": {"type": "sphere", "id": "ball"}, "b": {"type": "cube"}}).shapes()
    assert sorted(shown_name(shape) for shape in shapes) == ["b", "ball"]
    cube = mi.load_string(CUBES, optimize=False).shapes()[0]
    assert shown_name(cube) == "unnamed cube of 12 faces"
