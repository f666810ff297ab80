"""Functions that `dr.freeze` records: images can be made there, derivatives say that they cannot."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.errors import UnsupportedError

RED = "red.reflectance.value"
QUICK = {"type": "psdr_path", "max_depth": 2}

pytestmark = pytest.mark.usefixtures("nothing_collected")


@pytest.fixture
def scene(llvm):
    box = mi.cornell_box()
    box["sensor"]["film"] = {**box["sensor"]["film"], "width": 8, "height": 8}
    return mi.load_dict(box)


def test_images_can_be_frozen(scene):
    ours, path = (mi.load_dict({**QUICK, "type": name}) for name in ("psdr_path", "path"))
    frozen = dr.freeze(lambda seed: mi.render(scene, integrator=ours, spp=4, seed=seed))
    for seed in range(3):
        image = mi.render(scene, integrator=path, spp=4, seed=mi.UInt32(seed))
        assert np.allclose(frozen(mi.UInt32(seed)), image)


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_derivatives_say_that_they_cannot(scene, mode):
    params, ours = mi.traverse(scene), mi.load_dict(QUICK)

    @dr.freeze
    def frozen(red: mi.Float):
        params[RED] = mi.Color3f(red, 0.1, 0.1)
        params.update()
        image = mi.render(scene, params, integrator=ours, spp=4)
        if mode == "forward":
            return dr.forward_to(image)
        dr.backward(dr.sum(image.array))
        return dr.grad(red)

    red = mi.Float(0.5)
    dr.enable_grad(red)
    dr.set_grad(red, 1)
    with pytest.raises(RuntimeError) as raised:
        frozen(red)
    assert isinstance(raised.value.__cause__, UnsupportedError)
    assert "outside of the frozen function" in str(raised.value.__cause__)
