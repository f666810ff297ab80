"""Render a Mitsuba scene file, with the plugins of psdr_jit available to it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from psdr_jit.cli import common
from psdr_jit.errors import OptionError

#: Samples of a render that is not taken apart: some seconds.
SLICE = 1 << 24

NAME = "render"
HELP = "render a scene"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_scene_arguments(parser)
    parser.add_argument("-o", "--output", metavar="FILE",
                        help=".exr or .png (default: the scene's name with .exr, in this folder)")
    parser.add_argument("--spp", type=int, help="samples per pixel (default: the scene's own)")
    parser.add_argument("--sensor", type=int, default=0, help="index of the sensor (default: 0)")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default: 0)")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def slices(sensor: Any, spp: int, seed: int) -> list[tuple[int, int]]:
    """`(samples per pixel, seed)` of renders whose mean is asked for: Ctrl-C is heard between kernels only.

    One alone where samples of a pixel depend on each other.
    """
    from psdr_jit.core.streams import other_seed

    spp = spp or sensor.sampler().sample_count()
    width, height = sensor.film().crop_size()
    most = max(1, SLICE // (int(width) * int(height)))
    if spp <= most or sensor.sampler().class_name() != "IndependentSampler":
        return [(spp, seed)]
    parts = [min(most, spp - done) for done in range(0, spp, most)]
    return [(part, int(other_seed(seed, k)[0]) if k else seed) for k, part in enumerate(parts)]


def run(args: argparse.Namespace) -> int:
    """Render and write; 0."""
    common.require_positive(spp=args.spp)
    common.require_seed(args.seed)
    from psdr_jit.derivative import images
    from psdr_jit.scene import io as scene_io

    output = images.check_writable(args.output or Path(args.scene).with_suffix(".exr").name)
    if output.suffix.lower() not in (".exr", ".png"):
        raise OptionError(f"cannot write '{output}': the name must end in .exr or .png")
    scene_io.use_variant(args.variant)
    scene = scene_io.load_scene(args.scene, **common.definitions(args))
    scene_io.check_sensor(scene, args.sensor)

    import mitsuba as mi

    from psdr_jit.core.film import require_samples
    from psdr_jit.derivative.integrator_specs import aovs_of, names_of_aovs, to_image

    require_samples(scene.sensors()[args.sensor], args.spp or 0)
    parts = slices(scene.sensors()[args.sensor], args.spp or 0, args.seed)
    total = sum(spp for spp, _ in parts)
    image = sum(spp / total * to_image(mi.render(scene, sensor=args.sensor, spp=spp, seed=seed)) for spp, seed in parts)
    aovs = aovs_of(scene.integrator()) or names_of_aovs(scene, args.sensor, image.shape[-1])
    if output.suffix.lower() == ".exr":
        images.write_exr(output, {"primal": image}, aovs=aovs)
    else:
        images.write_picture(output, images.colours(image, aovs))
    if not args.quiet:
        print(f"wrote {output}")
    return 0
