"""Recover parameters of a scene from images, as a TOML file says.

Log, checkpoints, snapshots, pictures and the scene that was found, final.xml, go to a folder (see --out). Ctrl-C ends
the current iteration and writes a checkpoint (a second one stops at once, without); --resume goes on from it with the
same seeds and moments. Exit status: 0 done or out of time, 1 the run diverged, 2 wrong input, 3 final values could not
be saved, 130 interrupted.

    psdr optimize scenes/inverse/shadow.toml                    # results in out/shadow
    psdr report out/shadow                                      # a page of them for a browser
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from psdr_jit.cli import common
from psdr_jit.core import progress
from psdr_jit.errors import OptionError, StorageError

NAME = "optimize"
HELP = "recover parameters of a scene from images"

OK, DIVERGED, INTERRUPTED = 0, 1, 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", metavar="CONFIG.toml",
                        help="scene, targets and variables; scenes/inverse/README.md describes the file")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder (default: out/ and the name of the file)")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in the folder")
    parser.add_argument("--iterations", type=int, metavar="N", help="number of steps, instead of that in the file")
    parser.add_argument(
        "--max-seconds", type=float, metavar="S", help="stop after the iteration in which this time ends"
    )
    parser.add_argument("--perturb", type=int, metavar="SEED", help="displace the start at random, within its spread")
    parser.add_argument(
        "--integrator", metavar="PLUGIN", help="another integrator, for comparison, such as prb_projective"
    )
    parser.add_argument("--rerun", metavar="FILE.rrd", help="record images, curves, meshes and cameras for the viewer "
                        "Rerun; \"live\" instead of a file opens it (needs the extra 'rerun')")
    parser.add_argument("--tensorboard", metavar="DIR", help="write curves and images for TensorBoard (needs the extra "
                        "'tensorboard')")
    common.add_cluster_arguments(parser)
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="print only errors and warnings")


def run(args: argparse.Namespace) -> int:
    """Check, optimise, report."""
    from psdr_jit.inverse import config as configs
    from psdr_jit.inverse import loop
    from psdr_jit.inverse.remote import with_crew
    from psdr_jit.scene import io as scene_io

    common.require_positive(iterations=args.iterations, max_seconds=args.max_seconds)
    if args.perturb is not None and args.perturb < 0:
        raise OptionError(f"--perturb must be from 0 on, got {args.perturb}")
    scene_io.use_variant(args.variant)
    given = {"iterations": args.iterations, "max_seconds": args.max_seconds, "perturb": args.perturb}
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    config = configs.read(args.config, **changes)
    if args.integrator:
        config = configs.with_integrator(config, args.integrator)
    out = args.out or Path("out") / Path(args.config).stem
    loop.require_folder(out, args.resume)  # before targets are rendered
    observers = observers_of(args)
    problem = configs.problem_of(config, args.send)
    start = time.perf_counter()
    with common.cluster(args) as client, progress.bar("optimize", args.quiet) as report:
        if client is not None:
            problem = with_crew(problem, client, config.integrator)
        result = loop.run(problem, out, args.resume, report, observers)
    if not args.quiet:
        print(describe(result, out, time.perf_counter() - start))
    if result.lost:
        raise StorageError(unsaved(result, out))
    return {loop.DIVERGED: DIVERGED, loop.INTERRUPTED: INTERRUPTED}.get(result.status, OK)


def observers_of(args: argparse.Namespace) -> list[Any]:
    """Who looks at the run, as asked for."""
    from psdr_jit.inverse.event_files import EventFiles
    from psdr_jit.inverse.live_view import LiveView

    found = [LiveView(args.rerun)] if args.rerun is not None else []
    return [*found, EventFiles(args.tensorboard)] if args.tensorboard is not None else found


def describe(result: Any, out: Path, seconds: float) -> str:
    """What became of the run, in a few lines."""
    loss = f"loss {result.loss:.3e} (mean of the last ones)"
    lines = [f"{result.status} after {result.iterations} iterations, {seconds:.1f} s; {loss}"]
    if not result.losses:
        lines.append("  there was nothing left to do; raise --iterations to go on")
    for name, now in result.offsets.items():
        for kind, value in now.items():
            lines.append(f"  {name}: {kind} from the scene file {result.start_offsets[name][kind]:.4g} -> {value:.4g}")
    if result.lost:
        return "\n".join(lines)
    left = "log and checkpoint are in {}; go on with --resume" if result.status == "interrupted" else (
        "log, pictures and values are in {}")  # fmt: skip
    return "\n".join([*lines, left.format(out)])


def unsaved(result: Any, out: Path) -> str:
    """Which final values are missing, and the way out."""
    from psdr_jit.inverse import checkpoint, loop

    (_, said), *more = result.lost.items()
    also = f" (nor could {', '.join(name for name, _ in more)})" if more else ""
    again = "run it again"
    if (out / checkpoint.NAME).is_file() and result.status != loop.DIVERGED:
        again = "go on with --resume"
    return f"{said}{also}; then {again}"
