"""Edges that share a part of their length, and edges in faces of other shapes: found, counted once, named if parted."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver.prepare import prepare
from psdr_jit.edges.scene_table import scene_edges
from psdr_jit.edges.touching import parts_in_faces, shared_parts
from psdr_jit.errors import UnsupportedWarning

TOL = 1e-6
FRAME = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]  # nothing is aligned with the axes


def segments(*pairs) -> np.ndarray:
    return np.array(pairs, float) @ FRAME.T + 0.3


@pytest.mark.parametrize(("ends", "on_a", "on_b"), [
    ((0.25, 0.75), (0.25, 0.75), (0, 1)),  # the other one lies within
    ((0.75, 0.25), (0.25, 0.75), (1, 0)),  # the same, the other way round
    ((0.5, 2.5), (0.5, 1), (0, 0.25)),
    ((2.5, 0.5), (0.5, 1), (1, 0.75)),
    ((-1, 3), (0, 1), (0.25, 0.5)),
    ((0, 1), (0, 1), (0, 1)),
    ((1, 2), None, None),  # they meet in a point
])  # fmt: skip
def test_common_part_of_two_edges(ends, on_a, on_b):
    a, b = segments([(0, 0, 0), (1, 0, 0)]), segments([(ends[0], 0, 0), (ends[1], 0, 0)])
    found = shared_parts(a, b, TOL)
    assert len(found.a) == (on_a is not None)
    if on_a is not None:
        assert np.allclose(found.on_a, [on_a]) and np.allclose(found.on_b, [on_b])
    beside, aslant = b + FRAME @ (0, 1e-4, 0), segments([(0, 0, 0), (1, 1e-4, 0)])
    assert len(shared_parts(a, beside, TOL).a) == len(shared_parts(a, aslant, TOL).a) == 0


def test_parts_of_edges_in_a_face():
    triangle = segments([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    there = segments([(-1, 0.25, 0), (1, 0.25, 0)], [(0.1, 0.1, 0), (0.2, 0.1, 0)], [(0, 0, 0), (2, 0, 0)])
    above = segments([(-1, 0.25, 1e-3), (1, 0.25, 1e-3)], [(0.1, 0.1, 0), (0.2, 0.1, 0.1)], [(2, 0, 0), (2, 1, 0)])
    found = parts_in_faces(np.concatenate([there, above]), triangle, TOL)
    assert found.edge.tolist() == [0, 1, 2] and not found.face.any()
    assert np.allclose(found.on_edge, [(0.5, 0.875), (0, 1), (0, 0.5)], atol=1e-5)


# ------------------------------------------------------------------------------------------ in scenes


def T():
    return mi.ScalarTransform4f()


def cube(centre, half) -> dict:
    return {"type": "cube", "to_world": T().translate(list(centre)).scale(list(half))}


def flat(x: float, half: float) -> dict:
    return {"type": "rectangle", "to_world": T().translate([x, 0, 0]).rotate([1, 0, 0], -90).scale(half)}


def tube(bottom: float, top: float) -> dict:
    return {"type": "cylinder", "p0": [0.1, bottom, 0.2], "p1": [0.1, top, 0.2], "radius": 0.4}


def lid(height: float, radius: float) -> dict:
    turned = T().translate([0.1, height, 0.2]).rotate([1, 0, 0], -90).rotate([0, 0, 1], 20)
    return {"type": "disk", "to_world": turned.scale([radius, radius, 1])}


def shapes_of(name: str) -> dict:
    """Two shapes, `moved` and `still`."""
    box, floor = ((0.1, 0.4, 0), (0.4, 0.4, 0.4)), flat(0, 3)
    return {
        "on a floor": lambda: {"still": floor, "moved": cube(*box)},
        "above a floor": lambda: {"still": floor, "moved": cube((0.1, 0.41, 0), box[1])},
        "sunk into a floor": lambda: {"still": floor, "moved": cube((0.1, 0.39, 0), box[1])},
        "under a box": lambda: {"still": cube(*box), "moved": floor},
        "on a leg": lambda: {"still": cube((0, 0.3, 0), (0.1, 0.3, 0.1)), "moved": cube((0, 0.7, 0), (1, 0.1, 1))},
        "wall": lambda: {"still": floor, "moved": {"type": "rectangle", "to_world": T().translate([0, 1, 0])}},
        "tiles": lambda: {"still": flat(-1, 1), "moved": flat(1, 1)},
        "flush in front": lambda: {"still": cube((0, 0.3, 0), (0.6, 0.3, 0.5)),
                                   "moved": cube((0.3, 0.9, 0.2), (0.6, 0.3, 0.3))},
        "cup on a floor": lambda: {"still": floor, "moved": tube(0, 0.7)},
        "cup over a floor": lambda: {"still": floor, "moved": tube(0.01, 0.7)},
        "cup in a floor": lambda: {"still": floor, "moved": tube(-0.1, 0.7)},
        "ball in a floor": lambda: {"still": floor, "moved": {"type": "sphere", "center": [0, 0.2, 0], "radius": 0.5}},
        "under a cup": lambda: {"still": tube(0, 0.7), "moved": floor},
        "cup on a round table": lambda: {"still": lid(0, 1.1), "moved": tube(0, 0.7)},
        "lid of a tube": lambda: {"still": tube(-0.5, 0), "moved": lid(0, 0.4)},
    }[name]()  # fmt: skip


AXES = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}
PARTED = ("on a floor: move y", "on a floor: turn x", "under a box: move y", "on a leg: turn z", "wall: move y",
          "tiles: move x", "flush in front: move z", "cup on a floor: move y", "cup on a floor: turn x",
          "under a cup: move y", "cup on a round table: move y", "lid of a tube: move y")  # fmt: skip
FINE = ("on a floor: move x", "on a floor: turn y", "under a box: move x", "on a leg: turn y", "wall: move z",
        "tiles: move z", "flush in front: move x", "above a floor: move y", "sunk into a floor: move y",
        "cup on a floor: move x", "cup on a floor: turn y", "cup over a floor: move y", "under a cup: move z",
        "lid of a tube: move x")  # fmt: skip


def edges_of(scene: mi.Scene, param: str, how: dict, **options):
    motion = perturb(scene, param, **how)
    motion.attach()
    spec = {"type": "psdr_path", "max_depth": 2, "form": "spatial", "sppc": 1, **options}
    integrator = integrator_specs.build(spec)
    table = scene_edges(prepare(integrator.call(scene, scene.sensors()[0], 0, 1)).jobs[0][1])
    motion.restore()
    return table


def scene_of(shapes: dict) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    view = T().look_at(origin=[1, 2, 5], target=[0, 0.3, 0], up=[0, 1, 0])
    camera = {"type": "perspective", "to_world": view, "film": film}
    lamp = {"type": "point", "position": [2, 4, 3]}
    return mi.load_dict({"type": "scene", **shapes, "lamp": lamp, "camera": camera}, optimize=False)


def test_flush_shapes_that_are_parted_are_named(llvm):
    """What slides is not."""
    for case in PARTED + FINE:
        name, way, axis = case.replace(":", "").rsplit(" ", 2)
        shapes = shapes_of(name)
        param = "moved.vertex_positions" if shapes["moved"]["type"] == "cube" else "moved.to_world"
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            edges_of(scene_of(shapes), param, {"direction" if way == "move" else "rotate": AXES[axis]})
        texts = [str(w.message) for w in said if issubclass(w.category, UnsupportedWarning)]
        assert len(texts) == (case in PARTED), case
        assert all("flush contact" in text and "'moved'" in text and "'still'" in text for text in texts)


@pytest.mark.parametrize(
    ("name", "form", "depth", "said"),
    [("on a floor", "material", 3, True), ("sunk into a floor", "material", 3, True),
     ("sunk into a floor", "spatial", 3, False), ("sunk into a floor", "material", 2, False),
     ("above a floor", "material", 3, False), ("cup on a floor", "material", 3, True)],
)  # fmt: skip
def test_material_form_at_contacts_is_named(llvm, name, form, depth, said):
    """A body in, on and above a floor that it slides along: of the total 10 % is missing where they touch."""
    scene, shapes = scene_of(shapes_of(name)), shapes_of(name)
    param = "moved.vertex_positions" if shapes["moved"]["type"] == "cube" else "moved.to_world"
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        edges_of(scene, param, {"direction": AXES["x"]}, form=form, max_depth=depth)
    assert any("move against each other" in str(w.message) for w in found) == said


@pytest.mark.parametrize(
    ("name", "form", "said"),
    [("on a floor", "material", True), ("sunk into a floor", "material", True), ("sunk into a floor", "spatial", False),
     ("above a floor", "material", False), ("wall", "material", True), ("tiles", "material", False),
     ("cup on a floor", "material", True), ("cup in a floor", "material", True), ("ball in a floor", "material", True),
     ("on a floor", "auto", False)],
)  # fmt: skip
def test_material_form_before_a_moving_camera_is_named(llvm, name, form, said):
    """What touches, and what is seen slides over: of the interior term the deviation is 30 times that of the other.

    Not where a pilot looks at the material form to choose another one.
    """
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        scene = scene_of(shapes_of(name))
        edges_of(scene, "camera.to_world", {"direction": AXES["x"]}, form=form, max_depth=3)
    assert any("slides over both" in str(w.message) for w in found) == said


@pytest.mark.parametrize(
    ("height", "lit", "said"),
    [(0.2, "still", True), (0.1, "still", True), (0.2, "moved", True), (0.1, None, False), (0.4, "still", False)],
)
def test_a_light_that_touches_something_is_known(llvm, height, lit, said):
    """A box on, in and above a larger one, of which one shines. The camera is enough of a motion."""
    shapes = {"still": cube((0, -0.3, 0), (0.3,) * 3), "moved": cube((0, height, 0), (0.2,) * 3)}
    if lit:
        shapes[lit]["emitter"] = {"type": "area"}
    lamps = touched_lamps(shapes)
    assert lamps == ([lit] if said else [])


def test_a_flat_light_on_a_ceiling_may_touch_it(llvm):
    ceiling, lamp = flat(0, 0.5), flat(0, 0.2)
    lamp["emitter"] = {"type": "area"}
    assert not touched_lamps({"ceiling": ceiling, "lamp": lamp})


def touched_lamps(shapes: dict) -> list[str]:
    table = edges_of(scene_of(shapes), "camera.to_world", {"direction": AXES["x"]})
    return [lamp.id() for lamp, _ in table.touching.lamps]


def test_common_parts_are_counted_once(llvm):
    """Along the line on which edges of two boxes overlap, rows of the table cover each point once."""
    rows = edges_of(scene_of(shapes_of("flush in front")), "camera.to_world", {"direction": AXES["x"]}).kinds[0].rows
    p0, p1 = np.array(rows.p0).T, np.array(rows.p1).T
    on_line = np.all([np.abs(p[:, 1:] - (0.6, 0.5)).max(1) < 1e-5 for p in (p0, p1)], axis=0)
    spans = np.sort(np.stack([p0[on_line, 0], p1[on_line, 0]], 1), axis=1)
    spans = spans[np.argsort(spans[:, 0])]
    assert np.allclose(spans, [(-0.6, -0.3), (-0.3, 0.6), (0.6, 0.9)], atol=1e-5)
    assert np.array(rows.traced)[on_line].all()
