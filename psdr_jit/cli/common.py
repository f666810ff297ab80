"""What the subcommands share: argument types, the scene, the integrator, the workers."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from psdr_jit.errors import OptionError


def vector(text: str) -> tuple[float, float, float]:
    """Parse `x,y,z`."""
    try:
        numbers = tuple(float(part) for part in text.replace(" ", ",").split(",") if part)
    except ValueError:
        numbers = ()
    if len(numbers) != 3:
        raise argparse.ArgumentTypeError(f"expected three numbers x,y,z, got '{text}'")
    return numbers


def require_positive(**options: float | None) -> None:
    """Raise `OptionError` for each named option that is given and not greater than zero."""
    for name, value in options.items():
        if value is not None and not value > 0:
            raise OptionError(f"--{name.replace('_', '-')} must be greater than 0, got {value}")


def require_seed(seed: int) -> None:
    """Raise `OptionError` unless Mitsuba's samplers can be seeded with it."""
    if not 0 <= seed < 2**32:
        raise OptionError(f"--seed must be from 0 to 2^32 - 1, got {seed}")


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """The scene and the options that every rendering command has."""
    parser.add_argument("scene", metavar="SCENE.xml", help="Mitsuba scene file")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
    parser.add_argument("-D", "--define", action="append", default=[], metavar="NAME=VALUE",
                        help="override a <default> of the scene file; may be repeated")


def add_integrator_argument(parser: argparse.ArgumentParser) -> None:
    """Which of our integrators: for the commands that differentiate."""
    parser.add_argument("--integrator", metavar="NAME",
                        help="psdr_path or psdr_bdpt (default: the scene's own, or psdr_path)")


def add_cluster_arguments(parser: argparse.ArgumentParser) -> None:
    """Who renders: for commands whose work can be handed out."""
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--workers", type=int, metavar="N", help="render in N processes of this machine, by Dask")
    who.add_argument("--scheduler", metavar="ADDRESS",
                     help="render with the workers of a Dask scheduler, such as tcp://10.0.0.1:8786")
    parser.add_argument("--send", action="store_true",
                        help="let scene, meshes and textures travel to workers that do not share the folder")


@contextmanager
def cluster(args: argparse.Namespace) -> Iterator[Any]:
    """A Dask client as asked for, or None: this process renders."""
    if args.workers is None and args.scheduler is None:
        yield None
        return
    from psdr_jit.cluster import engine

    require_positive(workers=args.workers)
    with engine.local(args.workers) if args.workers else engine.connected(args.scheduler) as client:
        yield client


def source(args: argparse.Namespace) -> Any:
    """Where workers find the scene."""
    from psdr_jit.cluster.source import SceneFile

    return SceneFile(args.scene, definitions(args), args.send)


def definitions(args: argparse.Namespace) -> dict[str, str]:
    """The -D options as a dictionary."""
    for item in args.define:
        if "=" not in item:
            raise OptionError(f"-D {item}: expected NAME=VALUE")
    return dict(item.split("=", 1) for item in args.define)


def integrator_of(args: argparse.Namespace, scene: Any) -> dict[str, Any]:
    """The scene's own integrator with all its options if it is one of ours, or ours with the scene's path lengths."""
    from psdr_jit.derivative import integrator_specs
    from psdr_jit.scene import io as scene_io

    own = scene_io.integrator_properties(args.scene, **definitions(args))
    default = own["type"] if own.get("type") in integrator_specs.OURS else integrator_specs.DEFAULT_INTEGRATOR
    named = getattr(args, "integrator", None) or default
    given: Mapping[str, Any] | str = own if own.get("type") == named else named
    return integrator_specs.integrator_spec(scene, given, max_depth=args.max_depth)
