"""Scenes that once gave a wrong boundary term: one test each, against another way to build the same thing."""

from __future__ import annotations

import warnings
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from helpers import assert_grad_close, fd, forward
from variants import also

from benchmarks import cases, meshes, stability
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.derivative.statistics import gain
from psdr_jit.errors import UnsupportedWarning

X = (1, 0, 0)
SEEDS = 8
ROOM = [  # (origin, axis, angle): the walls of a room of side 2
    ((0, -1, 0), (1, 0, 0), -90), ((0, 1, 0), (1, 0, 0), 90), ((-1, 0, 0), (0, 1, 0), 90), ((1, 0, 0), (0, 1, 0), -90),
    ((0, 0, -1), (0, 1, 0), 0), ((0, 0, 1), (0, 1, 0), 180),
]  # fmt: skip


def T():
    return mi.ScalarTransform4f()


def camera(origin, target, fov: float = 60):
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {"type": "perspective", "fov": fov, "film": film,
            "to_world": T().look_at(origin=list(origin), target=list(target), up=[0, 1, 0])}  # fmt: skip


def scene(**objects) -> mi.Scene:
    objects.setdefault("integrator", {"type": "path", "max_depth": 2})
    return mi.load_dict({"type": "scene", **objects}, optimize=False)


def white(two_sided: bool = False) -> dict:
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}
    return {"type": "twosided", "bsdf": bsdf} if two_sided else bsdf


def term(name: str, depth: int, rr_depth: int = 1000) -> dict:
    budgets = {"sppc": 0, "sppp": 0, "sppd": 0, "sppi": 0, name: 1}
    return {"type": "psdr_path", "form": "spatial", "max_depth": depth, "rr_depth": rr_depth, **budgets}


def mean_of(motion, spec: dict, spp: int) -> tuple[float, float]:
    means = forward(motion, spec, SEEDS, spp).mean((1, 2, 3))
    return means.mean(), means.std(ddof=1) / np.sqrt(SEEDS)


def assert_same(a, b, power: float = 5.0):
    """Two means with errors agree, and are known well enough to tell half of them apart."""
    error = np.hypot(a[1], b[1])
    assert abs(a[0] - b[0]) < 4 * error, (a, b)
    assert abs(a[0]) > power * error, (a, b)


@pytest.mark.parametrize("budget", ["sppd", also("sppi")])
def test_roulette_changes_nothing_on_average(llvm, budget):
    walls = {f"wall{i}": {"type": "rectangle", "to_world": T().translate(o).rotate(axis, angle), "bsdf": white()}
             for i, (o, axis, angle) in enumerate(ROOM)}  # fmt: skip
    lamp = {"type": "rectangle", "to_world": T().translate([0, 0.95, 0]).rotate([1, 0, 0], 90).scale(0.3),
            "emitter": {"type": "area"}}  # fmt: skip
    box = {"type": "cube", "to_world": T().translate([0.2, -0.4, -0.2]).scale(0.25), "bsdf": white()}
    built = scene(camera=camera((0.3, 0.2, 0.9), (0, -0.4, -0.3)), lamp=lamp, box=box, **walls)
    motion = perturb(built, "box.vertex_positions", X)
    spp = 64 if budget == "sppd" else 512
    assert_same(mean_of(motion, term(budget, 6, 2), spp), mean_of(motion, term(budget, 6), spp), power=3.0)


def test_the_camera_inside_of_a_closed_mesh(llvm):
    """A room made of one two-sided cube, normals outward, and the same room made of six rectangles."""
    found = []
    lamp = {"type": "point", "position": [0.4, 0.5, -0.3], "intensity": 1.0}
    view = camera((-0.4, 0.3, 0.5), (0.3, -0.6, -1), 80)
    for walls in (
        {"room": {"type": "cube", "bsdf": white(True)}},
        {f"wall{i}": {"type": "rectangle", "to_world": T().translate(o).rotate(axis, angle), "bsdf": white()}
         for i, (o, axis, angle) in enumerate(ROOM)},
    ):  # fmt: skip
        motion = perturb(scene(camera=view, lamp=lamp, **walls), "camera.to_world", (1, 0, 0))
        found.append(mean_of(motion, term("sppi", 3), 256))
    assert_same(*found)


def test_a_light_with_several_sheets(llvm):
    """Of two parallel sheets that shine the same way, the lower one hides the upper one."""
    found = []
    for heights in ((1.0,), (1.0, 1.01)):
        corners = np.array([[-0.3, 0, -0.3], [0.3, 0, -0.3], [0.3, 0, 0.3], [-0.3, 0, 0.3]])
        points = np.concatenate([corners + [0, h, 0] for h in heights]).astype(np.float32)
        square = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
        faces = np.concatenate([square + np.uint32(4 * i) for i in range(len(heights))])
        props = mi.Properties()
        props["emitter"] = mi.load_dict({"type": "area", "radiance": 5.0})
        mesh = mi.Mesh("lamp", len(points), len(faces), props=props)
        params = mi.traverse(mesh)
        params["vertex_positions"], params["faces"] = points.ravel(), faces.ravel()
        params.update()
        floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2), "bsdf": white()}
        card = {"type": "cube", "to_world": T().translate([0, 0.4, 0]).scale(0.15), "bsdf": white()}
        built = scene(camera=camera((0, 1.2, 2), (0, 0, 0)), lamp=mesh, floor=floor, card=card)
        found.append(mean_of(perturb(built, "card.vertex_positions", (1, 0, 0.3)), term("sppd", 2), 128))
    assert_same(*found)


@pytest.mark.slow
def test_a_light_that_the_centre_of_a_ball_does_not_face(llvm):
    """The plane of the lamp passes above the centre; the top of the ball's contour is lit nevertheless."""
    turned = T().translate([2.5, 0, 0]).rotate([0, 1, 0], -90).scale(4)
    wall = {"type": "rectangle", "to_world": turned, "bsdf": white()}
    ball = {"type": "sphere", "to_world": T().scale(0.5), "bsdf": white()}
    normal = np.array([0.8, 0.6, 0])  # lamp at (-0.35, 0.55): the centre is 0.05 behind its plane
    aim = T().look_at(origin=[-0.35, 0.55, 0], target=list(np.array([-0.35, 0.55, 0]) + normal), up=[0, 0, 1])
    lamp = {"type": "rectangle", "to_world": aim.scale(0.1), "emitter": {"type": "area", "radiance": 20.0}}
    built = scene(camera=camera((0.5, 1.5, 3), (2.5, 0.6, 0), 45), wall=wall, ball=ball, lamp=lamp)
    motion = perturb(built, "ball.to_world", (0, 1, 0))
    spec = {"type": "psdr_path", "max_depth": 2, "rr_depth": 1000}
    assert np.abs(forward(motion, term("sppd", 2), 1, 64)).max() > 0
    estimate, reference = forward(motion, spec, 16, 128), fd(motion, spec, 0.002, 64, 512)
    assert_grad_close(estimate, reference, 0.03)


@pytest.mark.slow
def test_a_camera_that_leaves_a_room(llvm):
    """Seen from inside first, the same integrator must still know the box as closed from outside, and the reverse."""
    from psdr_jit.derivative import integrator_specs

    box = {"room": {"type": "cube", "to_world": T().scale(0.5), "bsdf": white(True)}}
    lamp = {"type": "point", "position": [0.1, 0.2, -0.1], "intensity": 1.0}
    inside, outside = (camera(o, (0, 0, 0), 70) for o in ((0.1, 0.1, 0.3), (1, 1, 3)))
    sun = {"type": "constant"}
    built = scene(inside=inside, outside=outside, lamp=lamp, sun=sun, **box)
    motion = perturb(built, "room.vertex_positions", (1, 0, 0))
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 3})

    def image(number: int) -> np.ndarray:
        motion.attach()
        return np.array(integrator.render_forward(built, motion.params, sensor=built.sensors()[number], seed=1, spp=4))

    first, _, again = image(0), image(1), image(0)
    assert np.array_equal(first, again) and first.any()


def stretched(case, **budgets) -> np.ndarray:
    """Derivative images of the edges alone, of a benchmark's case at low resolution."""
    motion = cases.load(case, 16, rfilter="gaussian")
    return forward(motion, {"type": "psdr_path", **case.limits, "sppc": 0, **budgets}, SEEDS, 64)


def assert_alike(images: np.ndarray, others: np.ndarray, tolerance: float):
    slope = gain(images, others[0::2], others[1::2])
    assert abs(slope.value - 1) < tolerance + 3 * slope.stderr, slope
    assert slope.stderr < 0.02, slope


@pytest.mark.slow
def test_slivers_do_not_stop_the_rays_that_pass_them(llvm):
    """Rounding lets a ray hit a sliver of aspect ratio 1000 beside its edge; a ball of slivers is a ball."""
    coarse, fine = (stretched(stability.of_mesh(partial(meshes.ball, 3, n))) for n in (64, 4096))
    assert_alike(fine, coarse, 0.02)


@pytest.mark.parametrize("shift, tolerance", [(100, 0.005), (1000, 0.03)])
def test_place_in_space_does_not_matter(llvm, shift, tolerance):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the scene is only", UnsupportedWarning)
        assert_alike(stretched(stability.placed(1, shift)), stretched(stability.placed(1, 0)), tolerance)


@pytest.mark.slow
def test_fine_creases_are_sampled_by_what_they_show(llvm):
    """Flat faces of a ball are the less visible the more there are: few samples should go to each."""
    balls = [stability.of_mesh(partial(meshes.round_ball, n)) for n in (1e4, 1e5)]
    coarse, fine = (stretched(ball, sppd=0).var(0, ddof=1).mean() for ball in balls)
    assert fine < 4 * coarse


def test_the_outline_of_a_sphere_has_no_fireflies(llvm):
    """Where a ray just touches a sphere, rounding makes the cosine 0 and the derivative anything at all."""
    from psdr_jit.derivative import integrator_specs
    from psdr_jit.scene import io as scene_io

    scene = scene_io.load_scene(scene_io.shipped_scene("envmap_rotation.xml"), res=64)
    motion = perturb(scene, "ball.to_world", X)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "sppp": 0, "sppi": 0})
    largest = []
    for seed in range(64, 80):
        motion.attach()
        largest.append(np.abs(np.array(integrator.render_forward(scene, motion.params, seed=seed, spp=16))).max())
    motion.restore()
    assert max(largest) < 1e3  # 6e6 with such a ray
    assert 0 < int(integrator.stats["grazing"]) < 1e-4 * 16 * 16 * 64 * 64


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rectangle", "sphere"])
def test_shadows_are_seen_through_a_hidden_light(llvm, kind):
    """The lamp hangs between sensor and floor, on which a box casts its shadow; `hide_emitters` looks through it.

    Through a sphere rays go on twice, each time a little off the surface: ends of theirs that do not allow for it lie
    behind the edges that they should see.
    """
    lit = scene(
        camera=camera((0, 5, 0.01), (0, 0, 0)),
        lamp={"type": kind, "to_world": T().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(0.6),
              "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}},
        floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(3), "bsdf": white()},
        box={"type": "cube", "to_world": T().translate([0.2, 1.2, 0.1]).rotate([0, 1, 0], 20).scale([0.4, 0.1, 0.3])},
    )  # fmt: skip
    motion = perturb(lit, "box.vertex_positions", (1, 0, 0.3))
    spec = {"type": "psdr_path", "max_depth": 2, "hide_emitters": True}
    reference = fd(motion, spec, 0.02, 16, 1024)
    assert_grad_close(forward(motion, spec, SEEDS, 64), reference, 0.02)


@pytest.mark.parametrize("height", [also(0.2), also(0.5)], ids=["halfway", "a corner"])
def test_the_floor_inside_of_a_hidden_lamp(llvm, height):
    """A glowing cube sunk into a floor: `hide_emitters` shows the dark floor within, up to where the cube cuts it.

    Seen through the cube, the camera's rays are shifted to the side by more than what they look beside an edge.
    """
    pose = T().translate([-0.2, height, 0]).rotate([1, 0.5, 0.2], 40).scale(0.5)
    lamp = {"type": "cube", "to_world": pose, "emitter": {"type": "area"}, "face_normals": True}
    floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(4), "bsdf": white()}
    seen = camera((1.6, 1.3, 3.4), (-0.1, 0.3, 0), 42)
    motion = perturb(scene(lamp=lamp, floor=floor, sky={"type": "constant"}, sensor=seen), "sensor.to_world", rotate=X)
    spec = {"type": "psdr_path", "max_depth": 2, "hide_emitters": True}
    reference = fd(motion, {**spec, "type": "path"}, 0.002, 32, 1024)
    slope = gain(forward(motion, spec, 16, 256), reference[0::2], reference[1::2])
    assert slope.stderr < 0.02
    assert abs(slope.value - 1) < 0.02 + 3 * slope.stderr, slope


def test_a_spherical_light_that_is_turned(llvm):
    """Casts the shadow of the same light before it was turned: Mitsuba's own normals of sampled points do not turn."""

    def shadow(pose) -> np.ndarray:
        placed = T().translate([0.4, 2, 0]) @ pose @ T().scale(0.4)
        lamp = {"type": "sphere", "to_world": placed, "emitter": {"type": "area"}}
        ball = {"type": "sphere", "to_world": T().translate([0, 0.7, 0]).scale(0.3)}
        floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2), "bsdf": white()}
        built = scene(camera=camera((0, 2.5, 2.5), (0, 0, 0), 50), lamp=lamp, ball=ball, floor=floor)
        return forward(perturb(built, "ball.to_world", X), term("sppd", 2), SEEDS, 128)

    straight, turned = shadow(T()), shadow(T().rotate([0.6, 0, 0.8], 140))
    slope = gain(turned, straight[::2], straight[1::2])
    assert abs(slope.value - 1) < 4 * slope.stderr and slope.stderr < 0.03


def test_coverage_needs_no_light(llvm):
    """A card of 4 x 4 units on a film of 16 x 16 px that shows 2 x 2, its left edge in the middle: moved to the right
    it covers 8 x 16 px less per unit; all of it in the alpha channel, in the columns beside that edge.
    """
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    view = {
        "type": "orthographic",
        "film": film,
        "to_world": T().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0]),
    }
    dark = scene(camera=view, card={"type": "rectangle", "to_world": T().translate([2, 0, 0]).scale(2)})
    for moved, expected in (("card.to_world", -8 * 16), ("camera.to_world", 8 * 16)):
        found = forward(perturb(dark, moved, X), {"type": "psdr_path", "max_depth": 2}, 2, 16).mean(0)
        assert (found[..., :3] == 0).all()
        assert found[..., 3].sum() == pytest.approx(expected, rel=0.02)
        assert np.abs(found[:, 7:9, 3]).sum() == pytest.approx(np.abs(found[..., 3]).sum())


def test_light_out_of_a_narrow_gap(llvm):
    """A lamp that faces the ceiling, h = 0.01 below it, lights a strip of the wall, by the height δ above it: what
    is seen is I = ∫ s δ dδ = s h²/2, and lifting the lamp changes it by -s h = -2 I/h. A tenth of that is light that
    leaves the lamp at a cosine below 5e-4.
    """
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    view = {"type": "perspective", "fov": 0.35, "film": film,
            "to_world": T().look_at(origin=[0, 1, 6.8], target=[0, 2.99, -2], up=[0, 1, 0])}  # fmt: skip
    lamp = {"type": "rectangle", "to_world": T().translate([0, 2.99, 0]).rotate([1, 0, 0], -90).scale(0.5),
            "emitter": {"type": "area"}}  # fmt: skip
    room = scene(camera=view, lamp=lamp, wall={"type": "rectangle", "to_world": T().translate([0, 1, -2]).scale(2)})
    seen = np.array(mi.render(room, spp=4096)).mean()
    found = forward(perturb(room, "lamp.to_world", (0, 1, 0)), {"type": "psdr_path", "max_depth": 2}, SEEDS, 256)
    assert found.mean() == pytest.approx(-2 * seen / 0.01, rel=0.02)
