"""The picture at the top of the README: a scene, its derivative, and finite differences on the same colour scale.

    python -m benchmarks.overview       some minutes on two cores
"""

from __future__ import annotations

from pathlib import Path

from benchmarks import rows
from psdr_jit.derivative import images, integrator_specs
from psdr_jit.derivative.finite_differences import finite_differences
from psdr_jit.derivative.gradient import gradient
from psdr_jit.scene import io as scene_io

PICTURE = rows.RESULTS / "overview.png"
SCENE, PARAMETER, DIRECTION = "cbox.xml", "small-box.vertex_positions", (1, 0, 0)
RES, MAX_DEPTH = 160, 4
SPP, SEEDS = 64, 24  # of the derivative
REFERENCE_SPP, REFERENCE_SEEDS = 64, 64  # of finite differences, for each of two halves


def draw(path: Path = PICTURE, res: int = RES, seeds: int = SEEDS, reference_seeds: int = REFERENCE_SEEDS) -> Path:
    """Render the three images of res x res pixels and write them side by side."""
    scene_io.use_variant(scene_io.DEFAULT_VARIANT)
    options = {"res": res, "max_depth": MAX_DEPTH, "rr_depth": integrator_specs.NO_ROULETTE}
    scene = scene_io.load_scene(scene_io.shipped_scene(SCENE), **options)
    ours = gradient(scene, PARAMETER, DIRECTION, spp=SPP, seeds=seeds)
    reference = finite_differences(scene, PARAMETER, DIRECTION, spp=REFERENCE_SPP, seeds=reference_seeds)
    panels = [
        ("primal", SCENE, ours.primal),
        ("derivative", "psdr_path: the small box moves to the right", ours.total),
        ("derivative", "finite differences of path", reference.mean),
    ]
    return images.write_panels(path, panels, unit="change of radiance per scene unit")


if __name__ == "__main__":
    print(f"wrote {draw()}")
