"""What does a dense moving object cost? A gradient call on balls of 1 k and of 1 M triangles.

    python -m benchmarks.large_mesh                (a minute; append to benchmarks/results/large_mesh.jsonl)

The ball moves over a floor under an area light (`scenes/area_shadow.xml` with the ball for the box). Timed is a call of
`render_backward` in steady state, with every term; `params.update()`, in which Mitsuba rebuilds its own acceleration
structure, is left out.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks import rows
from psdr_jit import scene_io

BENCH = "large_mesh"
PARAMETER = "blocker.vertex_positions"
RINGS = {1_000: (16, 32), 1_000_000: (500, 1000)}  # rings and segments of a sphere of about as many triangles
WARM_UP, CALLS = 3, 9


def sphere(rings: int, segments: int) -> mi.Mesh:
    """A sphere of radius 0.4 from rings of triangles."""
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    θ, φ = np.meshgrid(np.linspace(0, np.pi, rings + 1), turn, indexing="ij")
    p = 0.4 * np.stack([np.sin(θ) * np.cos(φ), np.cos(θ), np.sin(θ) * np.sin(φ)], -1) + [0, -0.3, 0]
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rings), np.arange(segments), indexing="ij"))
    k = (j + 1) % segments
    a, b, c, d = i * segments + j, i * segments + k, (i + 1) * segments + j, (i + 1) * segments + k
    faces = np.concatenate([np.stack([a, b, c], 1)[i > 0], np.stack([b, d, c], 1)[i < rings - 1]])
    mesh = mi.Mesh("blocker", p.size // 3, len(faces), props=_diffuse())
    params = mi.traverse(mesh)
    params["vertex_positions"] = p.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    return mesh


def _diffuse() -> mi.Properties:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "diffuse"})
    return props


def scene(triangles: int, res: int) -> mi.Scene:
    shipped = scene_io.load_scene(scene_io.shipped_scene("area_shadow.xml"), res=res)
    kept = {s.id(): s for s in shipped.shapes() if s.id() != "blocker"}
    return mi.load_dict({
        "type": "scene", "sensor": shipped.sensors()[0], **kept, "blocker": sphere(*RINGS[triangles]),
    })  # fmt: skip


def seconds(triangles: int, res: int, spp: int) -> tuple[list[float], int]:
    """Seconds of each call in steady state, and the number of triangles."""
    built = scene(triangles, res)
    params = mi.traverse(built)
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 3, "rr_depth": 100})
    grad_in = dr.full(mi.TensorXf, 1 / res**2, (res, res, 3))
    original = mi.Float(params[PARAMETER])
    taken = []
    for seed in range(WARM_UP + CALLS):
        value = mi.Float(original) + 1e-4 * seed  # as in an optimisation: the shape has moved
        dr.enable_grad(value)
        params[PARAMETER] = value
        params.update()
        dr.eval()
        dr.sync_thread()
        start = time.perf_counter()
        integrator.render_backward(built, params, grad_in, seed=seed, spp=spp)
        dr.eval(dr.grad(params[PARAMETER]))
        dr.sync_thread()
        taken.append(time.perf_counter() - start)
    return taken[WARM_UP:], built.shapes()[-1].face_count()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--res", type=int, default=128)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--variant", default=scene_io.DEFAULT_VARIANT)
    parser.add_argument("--out", type=Path, default=rows.RESULTS / f"{BENCH}.jsonl")
    args = parser.parse_args()
    scene_io.use_variant(args.variant)
    settings = {"res": args.res, "spp": args.spp, "max_depth": 3, "parameter": PARAMETER}
    medians = []
    for triangles in RINGS:
        taken, count = seconds(triangles, args.res, args.spp)
        row = {"bench": BENCH, "case": f"moving ball of {triangles} triangles", "method": "psdr_path backward",
               "settings": {**settings, "faces": count}, "seeds": CALLS, "seconds": rows.summary(taken)}  # fmt: skip
        rows.append(args.out, {**row, **rows.circumstances()})
        medians.append(row["seconds"]["median"])
        print(f"{count:8d} triangles: {medians[-1] * 1e3:.0f} ms a call", flush=True)
    print(f"ratio {medians[-1] / medians[0]:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
