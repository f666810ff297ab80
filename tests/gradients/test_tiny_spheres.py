"""Spheres much smaller than how far away they are: rays that touch them are met in single precision by Mitsuba."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from variants import also

pytestmark = pytest.mark.usefixtures("llvm")

CENTRE = (-1.25, 0.1, 0)


@pytest.mark.parametrize("plugin", ["sphere", also("cylinder")])
@pytest.mark.parametrize("radius", [also(0.3), 0.03, also(0.01)])
def test_light_grows_as_the_square_of_its_size(plugin, radius):
    """I ∝ r² of a light that is seen, and of nothing else: dI/d log r = 2 I. Lost outlines made .8 I of it at .03."""
    look = mi.ScalarTransform4f().look_at([0, 2, 15], [-1.2, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    light = {"type": plugin, "emitter": {"type": "area", "radiance": 1 / radius**2}}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -9]).scale(9),
            "bsdf": {"type": "diffuse", "reflectance": 0.0}}  # fmt: skip
    scene = mi.load_dict({"type": "scene", "light": light, "wall": wall,  # which makes the scene large
                          "sensor": {"type": "perspective", "fov": 6, "to_world": look, "film": film}},
                         optimize=False)  # fmt: skip
    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 1, "sppp": 4096, "sppc": 1})
    log_r = mi.Float(0)
    dr.enable_grad(log_r)
    pose = mi.Transform4f().translate(CENTRE) @ mi.Transform4f().rotate([0.6, 0, 0.8], 70)
    params["light.to_world"] = pose @ mi.Transform4f().scale(radius * dr.exp(log_r))
    params.update()
    dr.forward(log_r, dr.ADFlag.ClearEdges)
    derivative = np.mean([np.array(integrator.render_forward(scene, params, seed=s, spp=1)).sum() for s in range(8)])
    primal = np.mean([np.array(mi.render(scene, integrator=integrator, spp=4096, seed=s)).sum() for s in range(48)])
    assert derivative == pytest.approx(2 * primal, rel=0.08)
