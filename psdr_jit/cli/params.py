"""List the parameters of a scene: which can be differentiated, and why the others cannot."""

from __future__ import annotations

import argparse

from psdr_jit.cli import common

NAME = "params"
HELP = "list the parameters of a scene"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_scene_arguments(parser)
    parser.add_argument("--all", action="store_true", help="list those that cannot be differentiated as well")


def run(args: argparse.Namespace) -> int:
    """Print a table; 0."""
    from psdr_jit.scene import io as scene_io
    from psdr_jit.scene.params import differentiable_params

    scene_io.use_variant(args.variant)
    scene = scene_io.load_scene(args.scene, **common.definitions(args))
    infos = differentiable_params(scene)
    shown = [i for i in infos if i.differentiable or args.all]
    rows = [("parameter", "kind", "shape", "d?", "remark")]
    for i in shown:
        shape = " x ".join(str(n) for n in i.shape) or "-"
        rows.append((i.name, i.kind, shape, "yes" if i.differentiable else "no", i.reason))
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    for row in rows:
        print("  ".join([row[k].ljust(widths[k]) for k in range(4)] + [row[4]]).rstrip())
    hidden = len(infos) - len(shown)
    if hidden:
        print(f"{hidden} more cannot be differentiated; --all lists them with the reason")
    return 0
