"""The Cornell box: its derivative beside finite differences, then a box put back where a picture shows it.

Takes a minute or two on two cores, the first time some more: kernels are compiled. Writes gradient.png, gradient.exr
and recovery.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from psdr_jit.cli import common
from psdr_jit.core import progress
from psdr_jit.errors import OptionError

NAME = "demo"
HELP = "run the bundled scenes and show their gradients"

SHADOW_TERMS = ("direct", "indirect")   # boundaries between the light and what the sensor sees


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", default="out", metavar="DIR", help="folder for the images (default: ./out)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--res", type=int, default=128, help="width and height in pixels, a multiple of 32")
    parser.add_argument("--iterations", type=int, default=60, help="optimisation steps (default: 60)")
    parser.add_argument("--integrator", help=argparse.SUPPRESS)
    parser.add_argument("--quiet", action="store_true", help="no progress bars")


def run(args: argparse.Namespace) -> int:
    """Both parts; 0."""
    common.require_positive(res=args.res, iterations=args.iterations)
    if args.res % 32:
        raise OptionError(f"--res must be a multiple of 32, got {args.res}")
    from psdr_jit.cli import demo_run
    from psdr_jit.derivative import images, integrator_specs
    from psdr_jit.scene import io as scene_io

    out = make_folder(args.out)
    for name in ("gradient.exr", "gradient.png", "recovery.png"):
        images.check_writable(out / name)
    scene_io.use_variant(args.variant)
    scene = demo_run.load(args.res)
    terms = integrator_specs.terms_of(integrator_specs.integrator_spec(scene, args.integrator))
    print(f"Terms in the gradient: {', '.join(terms) or 'those of ' + str(args.integrator)}.")
    missing = [name for name in SHADOW_TERMS if name not in terms]
    if missing:
        print(f"Not in it yet: {', '.join(missing)}, the edges of shadows. Where finite differences show a "
              "shadow\nmoving, the gradient is still blank.")
    print()
    show_gradient(args, scene, out)
    show_recovery(args, scene, out)
    return 0


def make_folder(path: str) -> Path:
    """The output folder, made if need be."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        cause = error.strerror or error
        raise OptionError(f"cannot make the folder '{folder}': {cause}; choose another with --out") from error
    return folder


def show_gradient(args: argparse.Namespace, scene: Any, out: Path) -> None:
    """Part 1: primal, derivative and finite differences in one picture."""
    from psdr_jit.cli import demo_run
    from psdr_jit.derivative import images

    with progress.bar("gradient ", args.quiet) as report:
        result, reference = demo_run.compare(scene, args.integrator, progress=report)
    panels = [("primal", "Cornell box", result.primal),
              ("derivative", f"box moved in x: {' + '.join(result.terms) or 'total'}", result.total),
              ("derivative", "finite differences: everything", reference.mean)]
    png = images.write_panels(out / "gradient.png", panels)
    layers = {**result.layers(), "finite_differences": reference.mean}
    exr = images.write_exr(out / "gradient.exr", layers, result.metadata(), result.aovs)
    print(f"1. Derivative of the image as the small box moves along x\n"
          f"   derivative         {result.seconds:5.1f} s, {result.seeds} seeds x {result.spp} spp\n"
          f"   finite differences {reference.seconds:5.1f} s, eps {reference.eps:.3g}\n"
          f"   wrote {png} and {exr}\n")


def show_recovery(args: argparse.Namespace, scene: Any, out: Path) -> None:
    """Part 2: move the box back onto the target view."""
    from psdr_jit.cli import demo_run
    from psdr_jit.derivative import images

    def note(history: Any) -> str:
        k = len(history.losses) - 1
        return (f"loss {history.losses[k]:.5f}, off by {history.shift_px(k):.1f} px "
                f"and {history.angle_degrees(k):.1f} degrees")

    with progress.bar("recovery ", args.quiet) as report:
        history = demo_run.recover_pose(scene, args.integrator, args.iterations,
                                    progress=lambda done, total, h: report(done, total, note(h)))
    png = images.write_panels(out / "recovery.png", [("primal", "target", history.target),
                                                     ("primal", "start", history.first),
                                                     ("primal", "result", history.last)])
    print(f"2. Put the box back where the target shows it ({args.iterations} steps)\n"
          f"   start  off by {history.shift_px(0):5.1f} px, {history.angle_degrees(0):5.1f} degrees\n"
          f"   result off by {history.shift_px(-1):5.2f} px, {history.angle_degrees(-1):5.2f} degrees\n"
          f"   loss {history.losses[0]:.5f} -> {history.losses[-1]:.5f}\n"
          f"   wrote {png}")
