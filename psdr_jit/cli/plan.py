"""Show what differentiating a scene would compute: terms, edges, samples and form, with the reasons.

Renders nothing but, where form or budgets depend on noise, a pilot of a few samples per pixel.
Example: 'psdr plan SCENE.xml --wrt box.vertex_positions --wrt lamp.position'.
"""

from __future__ import annotations

import argparse

from psdr_jit.cli import common
from psdr_jit.errors import OptionError

NAME = "plan"
HELP = "show what differentiating a scene would compute, and why"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_scene_arguments(parser)
    parser.add_argument("--wrt", action="append", default=[], metavar="PARAM",
                        help="parameter to differentiate by, may be repeated; 'psdr params' lists them")
    parser.add_argument("--spp", type=int, metavar="N", help="samples per pixel (default: the scene's own)")
    parser.add_argument("--max-depth", type=int, metavar="N", help="path length (default: the scene's own)")
    parser.add_argument("--sensor", type=int, default=0, help="index of the sensor (default: 0)")
    common.add_integrator_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Print the table; 0."""
    common.require_positive(spp=args.spp, max_depth=args.max_depth)
    if not args.wrt:
        raise OptionError(f"--wrt PARAM is missing: nothing is differentiated; 'psdr params {args.scene}' lists what "
                          "can be")  # fmt: skip
    from psdr_jit.derivative.make_plan import make_plan
    from psdr_jit.scene import io as scene_io

    scene_io.use_variant(args.variant)
    scene = scene_io.load_scene(args.scene, **common.definitions(args))
    scene_io.check_sensor(scene, args.sensor)
    print(make_plan(scene, args.wrt, args.sensor, common.integrator_of(args, scene), args.spp or 0))
    return 0
