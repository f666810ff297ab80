"""Differentiate the image of a scene with respect to one of its parameters.

Writes a multi-layer OpenEXR file (primal, total, each term, their standard errors) and a PNG beside it.
With --check the derivative is compared with finite differences; the exit status is then 1 unless it passes.

    psdr params scenes/cbox.xml                                                    # names for --wrt
    psdr gradient scenes/cbox.xml --wrt small-box.vertex_positions --direction 1,0,0          # the box moves along x
    psdr gradient scenes/cbox.xml -D res=32 --wrt small-box.vertex_positions --direction 1,0,0 --spp 16 --check
    psdr gradient scenes/cbox.xml --wrt light.to_world --rotate 0,1,0                         # the light turns about y

A parameter of several numbers, such as positions or a pose, needs one of --direction, --rotate and --index.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from psdr_jit.cli import common
from psdr_jit.errors import OptionError

NAME = "gradient"
HELP = "differentiate a scene by one of its parameters"

OK, CHECK_FAILED = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_scene_arguments(parser)
    parser.add_argument("--wrt", required=True, metavar="PARAM",
                        help="the parameter that changes; 'psdr params SCENE.xml' lists them")
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--direction", type=common.vector, metavar="x,y,z",
                     help="how it changes: a shift in world space, or one number per colour channel")
    way.add_argument("--rotate", type=common.vector, metavar="x,y,z",
                     help="it turns: about this world axis through its centre; the derivative is per radian")
    way.add_argument("--index", type=int, metavar="I", help="only this one of its numbers changes, counted from 0")
    # argparse takes -1,0,0 for an option unless told that it is a number
    parser._negative_number_matcher = re.compile(r"^-[\d.][\d.,eE+-]*$")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel, seed and term (default: 64)")
    parser.add_argument("--seeds", type=int, default=8,
                        help="independent images that are averaged; standard errors are their scatter (default: 8)")
    parser.add_argument("--max-depth", type=int, metavar="N",
                        help="longest path in segments; 2 is direct light (default: the scene's own)")
    parser.add_argument("--sensor", type=int, default=0, help="index of the sensor (default: 0)")
    parser.add_argument("-o", "--output", metavar="FILE",
                        help=".exr file (default: the scene's name with _gradient.exr, in this folder)")
    parser.add_argument("--check", action="store_true", help="compare with finite differences as well")
    parser.add_argument("--check-seconds", type=float, default=120, metavar="S",
                        help="time limit of the check (default: 120)")
    parser.add_argument("--check-step", type=float, metavar="EPS",
                        help="step of its differences (default: chosen, and made smaller where it may be the cause)")
    common.add_integrator_argument(parser)
    common.add_cluster_arguments(parser)
    parser.add_argument("--quiet", action="store_true", help="print only errors and the check's verdict")


def run(args: argparse.Namespace) -> int:
    """Render, write, check; 0, or 1 for a check that did not pass."""
    common.require_positive(spp=args.spp, seeds=args.seeds, max_depth=args.max_depth,
                             check_seconds=args.check_seconds, check_step=args.check_step)
    from psdr_jit.derivative import integrator_specs
    from psdr_jit.derivative.gradient import gradient
    from psdr_jit.derivative.perturbation import perturb
    from psdr_jit.scene import io as scene_io

    exr, png = outputs(args)
    scene_io.use_variant(args.variant)
    scene = scene_io.load_scene(args.scene, **common.definitions(args))
    scene_io.check_sensor(scene, args.sensor)
    spec = common.integrator_of(args, scene)
    parameter = perturb(scene, args.wrt, args.direction, rotate=args.rotate, index=args.index)
    with common.cluster(args) as client:
        who = {} if client is None else {"client": client, "source": common.source(args)}
        result = gradient(scene, parameter, integrator=spec, spp=args.spp, seeds=args.seeds, sensor=args.sensor,
                          progress=not args.quiet, **who)
        write(args, result, exr, png)
        return check(args, scene, parameter, integrator_specs.integrator_spec(scene, spec), who) if args.check else OK


def write(args: argparse.Namespace, result: Any, exr: Path, png: Path) -> None:
    """The files, and what is in them."""
    from psdr_jit.derivative import images

    images.write_exr(exr, result.layers(), result.metadata(), result.aovs)
    title = f"d image / d {result.param}\n{result.direction}"
    images.write_derivative_png(png, images.colours(result.total, result.aovs), title)
    if not args.quiet:
        print(describe(result, exr, png))


def outputs(args: argparse.Namespace) -> tuple[Path, Path]:
    """Where the .exr and the .png go; both can be written."""
    from psdr_jit.derivative import images

    named = Path(args.output or Path(args.scene).stem + "_gradient.exr")
    images.check_writable(named)
    if named.suffix.lower() not in (".exr", ".png", ""):
        raise OptionError(f"cannot write '{named}': the name must end in .exr (a .png is written beside it)")
    return images.check_writable(named.with_suffix(".exr")), images.check_writable(named.with_suffix(".png"))


def describe(result: Any, exr: Path, png: Path) -> str:
    """What was computed, in a few lines."""
    alone = "" if result.terms else (
        "\n  by automatic differentiation alone: what moving edges and shadows bring is missing"
    )
    return f"{result}{alone}\nwrote {exr} and {png}"


def check(args: argparse.Namespace, scene: Any, parameter: Any, spec: dict[str, Any], who: dict[str, Any]) -> int:
    """Run the check and print its verdict."""
    from psdr_jit.derivative.check import check_gradient

    result = check_gradient(scene, parameter, integrator=spec, spp=args.spp, sensor=args.sensor,
                            max_seconds=args.check_seconds, eps=args.check_step, progress=not args.quiet, **who)
    print(result)
    return OK if result.passed else CHECK_FAILED
