"""Mitsuba's own integrators at their best: configurations, and meshes welded where seams would pass for borders."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import cases, meshes
from benchmarks.cases import Case
from psdr_jit.derivative.perturbation import Perturbation
from psdr_jit.edges.topology import weld_vertices

#: A guide that costs less to build: `prb_projective` reads these from its attributes, not from XML.
SMALL_OCTREE = {"proj_seed_spp": 16, "octree_extra_leaf_sample": 8, "octree_max_depth": 6}


def integrator(spec: dict[str, Any], tuning: dict[str, Any]) -> Any:
    built = mi.load_dict(spec)
    for name, value in tuning.items():
        if not hasattr(built, name):
            raise AttributeError(f"{spec['type']} has no attribute '{name}'")
        setattr(built, name, value)
    return built


def has_seams(motion: Perturbation) -> bool:
    """The mesh that moves stores positions twice for no better reason than flat shading."""
    shape = motion.params.properties[motion.name][2]
    if not motion.name.endswith("vertex_positions") or not isinstance(shape, mi.Mesh):
        return False
    textured = any(name.startswith(f"{shape.id()}.") and name.endswith(".data") for name in motion.params.keys())
    return not textured and len(_weld(shape)[0]) < shape.vertex_count()


def welded(motion: Perturbation, case: Case) -> Perturbation:
    """The case's scene with the mesh that moves welded by position, and the same motion of it."""
    moving = motion.params.properties[motion.name][2]
    return cases.perturbed(meshes.replaced(motion.scene, moving.id(), *_weld(moving)), case)


def _weld(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Distinct positions (V, 3), and the faces (F, 3) that refer to them."""
    params = mi.traverse(mesh)
    points = np.array(dr.detach(params["vertex_positions"])).reshape(-1, 3)
    faces = np.array(params["faces"]).reshape(-1, 3)
    kept, inverse = np.unique(weld_vertices(points), return_inverse=True)
    return points[kept], inverse.ravel()[faces]
