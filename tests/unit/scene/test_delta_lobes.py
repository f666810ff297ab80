"""Which specular materials are followed: what bends normals is in the way only of lobes below it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.errors import UnsupportedError
from psdr_jit.scene.checks import findings
from psdr_jit.scene.facts import analyse

pytestmark = pytest.mark.usefixtures("llvm")


def bent(kind: str, bsdf: dict) -> dict:
    texels = mi.Bitmap(np.full((4, 4, 3 if kind == "normalmap" else 1), 0.5, np.float32))
    return {"type": kind, "normalmap": {"type": "bitmap", "bitmap": texels, "raw": True}, "inner": bsdf}


@pytest.mark.parametrize("kind", ["bumpmap", "normalmap"])
@pytest.mark.parametrize(("inner", "followed"), [({"type": "diffuse"}, True), ({"type": "conductor"}, False)])
def test_bent_normals_under_a_mask(kind, inner, followed):
    """Light passes through a mask whatever the normals of what it shows are."""
    leaf = {"type": "mask", "opacity": 0.5, "shown": {"type": "twosided", "inner": bent(kind, inner)}}
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film},
                          "leaf": {"type": "rectangle", "bsdf": leaf}}, optimize=False)  # fmt: skip
    params = mi.traverse(scene)
    dr.enable_grad(params["leaf.to_world"].matrix)
    refused = [f for f in findings(analyse(scene, 0)) if f.category is UnsupportedError]
    assert (not refused) == followed
