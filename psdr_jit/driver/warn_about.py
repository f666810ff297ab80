"""What a call warns of that takes a look at the scene as it is, not only at what is in it."""

from __future__ import annotations

from ..plan.call import Call
from ..scene.behind_lights import warn_about_shapes_behind_lights
from ..scene.bent_away import warn_about_bent_normals
from ..scene.bent_terminator import warn_about_terminators
from ..scene.clipping import warn_about_clipping
from ..scene.facts import SceneFacts
from ..scene.painted_lights import warn_about_painted_lights
from ..scene.sight_lines import is_time
from ..scene.stale_values import warn_about_stale_values


def warn_about(call: Call, facts: SceneFacts) -> None:
    """Each warning once in the life of an integrator."""
    warn_about_painted_lights(call.scene, facts, call.memory)
    if call.options.hide_emitters:
        warn_about_shapes_behind_lights(call.scene, call.sensor, facts, call.memory)
    if is_time(call.sensor, call.memory):
        if facts.geometry_moves:
            warn_about_clipping(call.scene, call.sensor, facts, call.memory)
        warn_about_bent_normals(call.scene, call.sensor, facts, call.memory)
        warn_about_terminators(call.scene, facts, call.memory)
    if call.mode == "backward":
        warn_about_stale_values(call.scene, facts, call.memory)
