"""Edges inside of other bodies are left out; where something sees or shines inside, they are not."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import psdr_jit
from psdr_jit.derivative import integrator_specs
from psdr_jit.derivative.perturbation import perturb
from psdr_jit.edges import buried, scene_table
from psdr_jit.edges.curves import curve_set
from psdr_jit.scene import io as scene_io

BODIES = {
    "block": '<shape type="cube" id="floor"><transform name="to_world"><scale x="2" y="0.5" z="2"/>'
             '<translate y="-1.4"/></transform>{bsdf}</shape>',
    "ball": '<shape type="sphere" id="floor"><point name="center" x="0" y="-2.7" z="0"/>'
            '<float name="radius" value="2"/>{bsdf}</shape>',
}  # fmt: skip
DIFFUSE = '<bsdf type="diffuse"/>'
BOX = "box.vertex_positions"
BUDGETS = {"sppc": 0, "sppp": 64, "sppd": 64, "sppi": 64}


def scene_with(body: str, bsdf: str = DIFFUSE, extra: str = "") -> mi.Scene:
    """A box sunk into another body instead of a floor."""
    text = scene_io.shipped_scene("sunk_box.xml").read_text()
    start = text.index('<shape type="rectangle" id="floor">')
    end = text.index("</shape>", start) + len("</shape>")
    return mi.load_string(text[:start] + BODIES[body].format(bsdf=bsdf) + extra + text[end:], res=16)


def buried_edges(scene: mi.Scene) -> int:
    """How many edges the plan leaves out for this reason."""
    integrator = {"type": "psdr_path", "max_depth": 3, "form": "spatial", **BUDGETS}
    counts = {t.edges.buried for t in psdr_jit.make_plan(scene, [BOX], integrator=integrator).terms if t.edges}
    assert len(counts) == 1
    return counts.pop()


@pytest.mark.parametrize("body", BODIES)
def test_sunk_edges_are_left_out(llvm, body):
    assert 4 <= buried_edges(scene_with(body)) <= 8  # of 12 and of their diagonals; edges that leave the body count


def test_edges_that_may_be_reached_are_kept(llvm):
    glass = '<bsdf type="roughdielectric"/>'
    lamp = '<emitter type="point"><point name="position" x="0.6" y="-1.4" z="0.6"/></emitter>'
    assert buried_edges(scene_with("block", glass)) == 0
    assert buried_edges(scene_with("block", extra=lamp)) == 0
    scene = scene_with("block")
    params = mi.traverse(scene)
    params["camera.to_world"] = mi.Transform4f().look_at([0.9, -1.4, 0.9], [0, -1, 0], [0, 1, 0])
    params.update()
    assert buried_edges(scene) == 0


@pytest.mark.parametrize("form", ["spatial", "material"])
@pytest.mark.parametrize("body", BODIES)
def test_what_is_left_out_is_zero(llvm, monkeypatch, body, form):
    """With the buried edges alone, whichever body moves, the boundary terms vanish exactly."""
    monkeypatch.setattr(scene_table, "buried", lambda *args: ~buried.buried(*args))
    monkeypatch.setattr(scene_table, "curve_set", lambda shapes: curve_set([]))
    scene = scene_with(body)
    names = [BOX, "floor.vertex_positions" if body == "block" else "floor.to_world"]
    for name in names:
        motion = perturb(scene, name, (1, 0.3, 0))
        motion.attach()
        integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4, "form": form, **BUDGETS})
        image = np.array(integrator.render_forward(scene, motion.params))
        motion.restore()
        assert len(integrator.plan.running) == 3 and np.abs(image).max() == 0


def test_the_others_are_not(llvm, monkeypatch):
    """The test above can fail: the edges that are left do contribute."""
    scene = scene_with("block")
    motion = perturb(scene, BOX, (1, 0.3, 0))
    motion.attach()
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 4, **BUDGETS})
    assert np.abs(np.array(integrator.render_forward(scene, motion.params))).max() > 0.01
    motion.restore()
