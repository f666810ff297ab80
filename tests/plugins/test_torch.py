"""`dr.wrap` carries gradients of `psdr_path` into PyTorch. Skipped where PyTorch is not installed."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from psdr_jit.derivative import integrator_specs
from psdr_jit.scene import io as scene_io

torch = pytest.importorskip("torch")


def renderer():
    """A function of Dr.Jit tensors: intensity (3) of a lamp, and how far (3) it is moved."""
    scene = scene_io.load_scene(scene_io.shipped_scene("point_shadow.xml"), res=16)
    integrator = integrator_specs.build({"type": "psdr_path", "max_depth": 2, "sppc": 16, "sppp": 16, "sppi": 16})
    params = mi.traverse(scene)
    position = mi.Point3f(params["lamp.position"])

    def render(intensity, shift):
        params["lamp.intensity.value"] = dr.gather(mi.Color3f, intensity.array, 0)  # indexing would detach
        params["lamp.position"] = position + dr.gather(mi.Point3f, shift.array, 0)
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=16, seed=3, seed_grad=4)

    return render


def by_torch(render, values):
    device = "cuda" if mi.variant().startswith("cuda") else "cpu"  # or `dr.wrap` makes arrays of another backend
    inputs = [torch.tensor(value, requires_grad=True, device=device) for value in values]
    image = dr.wrap(source="torch", target="drjit")(render)(*inputs)
    (image * image).mean().backward()
    return image, [np.array(x.grad.tolist()) for x in inputs]


def test_gradients_are_those_of_drjit(llvm):
    values = [[10.0, 9.0, 8.0], [0.1, 0.0, -0.1]]
    render = renderer()
    image, grads = by_torch(render, values)
    assert tuple(image.shape) == (16, 16, 3)
    inputs = [mi.TensorXf(value) for value in values]
    dr.enable_grad(inputs)
    dr.backward(dr.mean(dr.square(render(*inputs)), axis=None))
    for found, x in zip(grads, inputs, strict=True):
        expected = np.array(dr.grad(x)).ravel()
        assert np.abs(expected).min() > 0 and np.allclose(found, expected, rtol=1e-3)


def test_repeated_calls_leave_nothing_behind(llvm):
    render = renderer()
    known = []
    for _ in range(6):
        by_torch(render, [[10.0, 9.0, 8.0], [0.0, 0.0, 0.0]])
        gc.collect()
        known.append(dr.whos(as_string=True).count("\n"))
    assert known[-1] <= known[1]
