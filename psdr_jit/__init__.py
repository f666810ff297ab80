"""psdr_jit: path-space differentiable rendering as Mitsuba 3 integrator plugins.

Symbols of the papers, and what they are called in the code (`_d`: attached to the AD graph):

    x_B            point on an edge                                   EdgePoint.x
    x_D, x_S       ends of a boundary segment, sensor and source side x_d, x_s
    ω, τ, n_⊥      segment direction, edge tangent, normal across     view.ω, τ, EdgePoint.side
    v, u           material velocity, velocity of the path's flow     derivative of an attached point
    f, G, L_e      BSDF · cosine, geometry term, emitted radiance     f, measure, value
    β, η           path throughput, accumulated relative IOR          β, η
    δL, λ          adjoint radiance, adjoint of a ray's origin        δL, λ_o

Data flows one way, through the rooms (folders) in this order; each imports from those before it only:

    setup → core → scene → paths → plan → edges → sampling → interior, boundary → driver → plugins
    → cluster → export → derivative → inverse → report → cli
"""

from __future__ import annotations

__version__ = "0.1.0"

from pathlib import Path as _Path

from .setup.drjit_libraries import mitsuba_can_load as _mitsuba_can_load
from .setup.llvm import apply_saved_choice as _apply_saved_choice
from .setup.quick_compile import apply_if_asked as _compile_quickly_if_asked

_here = _Path(__file__).parent
if not (_here / "plugins").exists():  # in a clone, whose Python sees this folder first, they lie beside it
    __path__.append(str(_here.parent))

_apply_saved_choice()  # before drjit is loaded: it looks for libLLVM once
_compile_quickly_if_asked()

if _mitsuba_can_load():  # otherwise `psdr doctor` must be able to say what is wrong
    from . import plugins as plugins  # registers the integrators, now and after every variant switch
    from .cluster.source import SceneFile
    from .derivative.check import CheckResult, check_gradient
    from .derivative.gradient import GradientResult, gradient
    from .derivative.make_plan import make_plan
    from .export.write import write_scene
    from .inverse.event_files import EventFiles
    from .inverse.live_view import LiveView
    from .inverse.optimize import optimize
    from .inverse.parts import Stage
    from .inverse.shapes import Profile, Vertices
    from .inverse.variables import Parameter, Pose
    from .plan.plan import Plan
    from .scene import io as scene_io  # the name by which scenes are loaded: psdr_jit.scene_io.load_scene
    from .scene.names import traverse
    from .scene.params import ParamInfo, differentiable_params

    __all__ = [
        "CheckResult",
        "EventFiles",
        "GradientResult",
        "LiveView",
        "ParamInfo",
        "Parameter",
        "Plan",
        "Pose",
        "Profile",
        "SceneFile",
        "Stage",
        "Vertices",
        "check_gradient",
        "differentiable_params",
        "gradient",
        "make_plan",
        "optimize",
        "scene_io",
        "traverse",
        "write_scene",
    ]
