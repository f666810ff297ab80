"""`psdr_bdpt`: steps of smooth caustics of points, where something comes in the way of the light or of the view.

A plane mirror shows a point light a second time: its shadows are those of a light behind it, of things behind it, which
`psdr_path` knows without caustics. For glass, finite differences of the image itself are the reference.
"""

from __future__ import annotations

import mitsuba as mi
import pytest
from helpers import adjoint_identity, assert_grad_close, forward
from test_smooth_caustics import SEEDS, TOLERANCE, X, Y, bdpt, differences, film, floor, spot

from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb

SLOW = pytest.mark.slow
BLACK = {"type": "twosided", "sheet": {"type": "diffuse", "reflectance": 0.0}}
STEPS = {"form": "spatial", "sppc": 64, "sppp": 16, "spps": 512, "sppd": 16, "sppi": 16}

pytestmark = pytest.mark.filterwarnings("ignore::psdr_jit.errors.UnsupportedWarning")


def card(at, towards, size: float = 0.06) -> dict:
    """A black card at `at`, square to the direction `towards`."""
    pose = mi.ScalarTransform4f().look_at(origin=at, target=[a + b for a, b in zip(at, towards)], up=[0, 0, 1])
    return {"type": "rectangle", "to_world": pose @ mi.ScalarTransform4f().scale(size), "bsdf": BLACK}


def mirrored(mirror: bool, before: bool) -> mi.Scene:
    """A card in the light of a spot that a mirror at x = −1 throws onto the floor, before or behind the mirror."""
    pose = mi.ScalarTransform4f()
    camera = {"type": "perspective", "fov": 55, "film": film(),
              "to_world": pose.look_at(origin=[0.3, 1.5, 1.8], target=[0.2, -1, 0], up=[0, 1, 0])}  # fmt: skip
    scene = {"type": "scene", "camera": camera, "floor": floor()}
    if before:
        scene["card"] = card([-0.55, 0.6, 0.03], [-1, -1, 0]) if mirror else card([-1.45, 0.6, 0.03], [1, -1, 0])
    else:
        scene["card"] = card([-0.6, -0.25, 0.03], [1, -1, 0])
    if not mirror:
        return mi.load_dict({**scene, "lamp": spot([-1.8, 0.9, 0], [-1, 0.1, 0])}, optimize=False)
    sheet = {"type": "rectangle", "to_world": pose.translate([-1, 0.1, 0]).rotate([0, 1, 0], 90),
             "bsdf": {"type": "conductor", "material": "none"}}  # fmt: skip
    return mi.load_dict({**scene, "mirror": sheet, "lamp": spot([-0.2, 0.9, 0], [-1, 0.1, 0])}, optimize=False)


@pytest.mark.parametrize("moved, before, as_if", [
    pytest.param("card.to_world", True, {"card.to_world": -1}, marks=SLOW),
    pytest.param("mirror.to_world", True, {"card.to_world": 2, "lamp.to_world": 2}, marks=SLOW),
    pytest.param("lamp.to_world", True, {"lamp.to_world": -1}, marks=SLOW),
    pytest.param("card.to_world", False, {"card.to_world": 1}, marks=SLOW),
    pytest.param("mirror.to_world", False, {"lamp.to_world": 2}, marks=SLOW),
], ids=lambda value: value if isinstance(value, str) else "")  # fmt: skip
def test_a_card_and_a_mirror(llvm, moved, before, as_if):
    """What moves across the mirror moves the other way behind it; no finite differences."""
    there = mirrored(False, before)
    spec = {"type": "psdr_path", "max_depth": 2, "form": "spatial", "sppc": 64, "sppp": 16, "sppd": 512}
    exact = sum(f * forward(perturb(there, name, X), spec, SEEDS, 0) for name, f in as_if.items())
    ours = forward(perturb(mirrored(True, before), moved, X), bdpt(**STEPS), SEEDS, 0)
    assert_grad_close(ours, exact)


def glass(body: str = "ball", way: str | None = None, sensor: str = "perspective", step: bool = False) -> mi.Scene:
    """The caustic of a body of smooth glass on the floor, with a card in the `way` of the light or of the view."""
    T = mi.ScalarTransform4f
    pose = T().look_at(origin=[-1.6, 1.0, 1.6], target=[-0.35, -1, 0.35], up=[0, 1, 0])
    kinds = {"perspective": {"fov": 40}, "orthographic": {},
             "thinlens": {"fov": 40, "aperture_radius": 0.1, "focus_distance": 2.5}}  # fmt: skip
    if sensor == "orthographic":
        pose = pose @ T().scale([0.9, 0.9, 1])
    turned = T().translate([0, -0.35, 0]).rotate([0.436, 0.873, 0.218], 40).scale(0.3)
    bodies = {"ball": {"type": "sphere", "center": [0, -0.15, 0], "radius": 0.5},
              "cube": {"type": "cube", "to_world": turned}}  # fmt: skip
    cards = {"light": card([0.4, 1.0, -0.3], [-0.4, -1.15, 0.3], 0.1),
             "caustic": card([-0.25, -0.8, 0.15], [0.25, 0.65, -0.15], 0.08),
             "view": card([-1.0, 0.1, 1.0], [-0.6, 0.9, 0.6], 0.15)}  # fmt: skip
    things = {"card": cards[way]} if way else {}
    if step:
        things["step"] = {"type": "cube", "to_world": T().translate([-0.3, -1, 0.2]).scale([0.15, 0.1, 0.15])}
    return mi.load_dict({
        "type": "scene", "lamp": spot([0.8, 2.2, -0.6], [0, -0.15, 0], 20), "floor": floor(), **things,
        "camera": {"type": sensor, "to_world": pose, "film": film(), **kinds[sensor]},
        "body": {**bodies[body], "bsdf": {"type": "psdr_dielectric"}},
    }, optimize=False)  # fmt: skip


CASES = [
    ("card.to_world", dict(direction=X), dict(way="light")),
    ("card.to_world", dict(direction=X), dict(way="caustic")),
    ("card.to_world", dict(direction=X), dict(way="view")),
    ("camera.to_world", dict(direction=X), dict(way="view")),
    ("camera.to_world", dict(direction=X), dict(way="view", sensor="orthographic")),
    ("camera.to_world", dict(direction=X), dict(way="view", sensor="thinlens")),
    ("floor.to_world", dict(direction=Y), dict(way="view")),
    ("step.vertex_positions", dict(direction=X), dict(step=True)),
    ("body.vertex_positions", dict(direction=X), dict(body="cube")),
    ("body.bsdf.eta", {}, dict(body="cube")),
]


@pytest.mark.slow
def test_paths_as_long_as_may_be(llvm):
    """In, out, floor, sensor: what the sensor sees of the last vertex that there may be steps as well."""
    motion = perturb(glass(way="view"), "card.to_world", direction=X)
    estimate = forward(motion, bdpt(form="spatial", max_depth=4), SEEDS, 512)
    assert_grad_close(estimate, differences(motion, bdpt(max_depth=4), 0.001, 2048), max_stderr=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("max_depth, lit", [(3, False), (4, True)])
def test_no_path_is_longer_than_it_may_be(llvm, max_depth, lit):
    """The card is in the shadow of the ball: only what comes through the ball, by two vertices, can light it."""
    motion = perturb(glass(way="caustic"), "card.to_world", direction=X)
    steps = {"form": "spatial", "sppc": 0, "sppp": 0, "spps": 64, "sppd": 0, "sppi": 0}
    assert forward(motion, bdpt(**steps, max_depth=max_depth), 1, 0).any() == lit


def sunk_cube() -> mi.Scene:
    """A cube of glass in the floor; all light enters by its top, is reflected by its sides, and stays inside."""
    T = mi.ScalarTransform4f
    pose = T().look_at(origin=[-1.6, 1.0, 1.6], target=[-0.35, -1, 0.35], up=[0, 1, 0])
    return mi.load_dict({
        "type": "scene", "lamp": spot([0.8, 2.2, -0.6], [0, -0.5, 0], 5), "floor": floor(),
        "camera": {"type": "perspective", "to_world": pose, "film": film(), "fov": 40},
        "body": {"type": "cube", "to_world": T().translate([0, -0.8, 0]).rotate([0, 1, 0], 25).scale(0.3),
                 "bsdf": {"type": "psdr_dielectric"}},
    }, optimize=False)  # fmt: skip


@pytest.mark.slow
def test_a_sunk_cube_hides_the_floor_inside_of_it(llvm):
    """Also where that is a few units in the last place from its wall, and from what the sensor sees."""
    motion = perturb(sunk_cube(), "body.vertex_positions", direction=X)
    steps = {"form": "spatial", "sppc": 0, "sppp": 0, "spps": 256, "sppd": 0, "sppi": 0}
    assert not forward(motion, bdpt(**steps, max_depth=4), 1, 0).any()


@pytest.mark.slow
@pytest.mark.parametrize("param, how, scene", CASES, ids=lambda value: "")
def test_glass(llvm, param, how, scene):
    motion = perturb(glass(**scene), param, **how)
    estimate = forward(motion, bdpt(form="spatial"), SEEDS, 512)
    assert_grad_close(estimate, differences(motion, bdpt(), 0.001, 2048), max_stderr=0.05)


@pytest.mark.parametrize("param, way", [
    ("card.to_world", "light"), pytest.param("camera.to_world", "view", marks=SLOW),
    pytest.param("lamp.to_world", "caustic", marks=SLOW), pytest.param("body.bsdf.eta", "caustic", marks=SLOW),
])  # fmt: skip
def test_forward_and_backward_are_transposes(variant, param, way):
    budgets = {"form": "spatial", "sppc": 0, "sppp": 0, "spps": 8, "sppd": 0, "sppi": 0}
    integrator = integrator_specs.build(bdpt(**budgets))
    wJv, JTwv, w, Jv = adjoint_identity(glass(way=way), param, integrator)
    assert Jv > 1e-6
    assert abs(wJv - JTwv) <= TOLERANCE * w * Jv, f"forward {wJv:.8g}, backward {JTwv:.8g}, bound on {w * Jv:.3g}"
