"""What has to hold before anything touches a scene: it belongs to the active variant, and its meshes are not empty.

Mitsuba's own answers are an empty AssertionError, or an error from inside of a kernel.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from psdr_jit.errors import OptionError, SceneError, UnsupportedError


def require_scene(scene: Any) -> None:
    """Raise `SceneError` unless `scene` can be rendered in the active variant."""
    require_variant(scene, "the scene")
    if not isinstance(scene, mi.Scene):
        raise SceneError(
            f"expected a Mitsuba scene of variant '{mi.variant()}', got {type(scene).__name__}: load one with "
            "mi.load_file"
        )
    for k, shape in enumerate(scene.shapes()):
        if shape.is_mesh() and not (shape.vertex_count() and shape.face_count()):
            missing = "faces" if shape.vertex_count() else "vertices"
            label = f"mesh '{shape.id()}'" if shape.id() else f"mesh {k} of the scene"
            raise SceneError(f"{label} has no {missing}; remove it or fix its file")


def require_variant(thing: Any, what: str) -> None:
    """Raise `SceneError` if this object of Mitsuba was made for another variant than the active one."""
    if isinstance(thing, mi.Object) and thing.variant_name() != mi.variant():
        raise SceneError(
            f"{what} belongs to variant '{thing.variant_name()}', but '{mi.variant()}' is set: load it again, or call "
            f"mi.set_variant('{thing.variant_name()}') first"
        )


def require_integrator(integrator: Any) -> None:
    """Raise `OptionError` if this integrator was made for another variant than the active one."""
    if isinstance(integrator, mi.Object) and integrator.variant_name() != mi.variant():
        raise OptionError(
            f"the integrator belongs to variant '{integrator.variant_name()}', but '{mi.variant()}' is set: make it "
            "again with mi.load_dict"
        )


def require_derivatives() -> None:
    """Raise `UnsupportedError` in variants that compute none."""
    if not dr.is_diff_v(mi.Float):
        raise UnsupportedError(
            f"variant '{mi.variant()}' does not track derivatives; use mi.set_variant('llvm_ad_rgb')"
        )
