"""The public way to recover parameters of a scene from images."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi

from psdr_jit.cluster.source import SceneFile
from psdr_jit.core.progress import reporting
from psdr_jit.core.threads import one_at_a_time
from psdr_jit.errors import OptionError
from psdr_jit.inverse import loop
from psdr_jit.inverse.observer import Observer
from psdr_jit.inverse.parts import Stage
from psdr_jit.inverse.problem import make_problem
from psdr_jit.inverse.remote import with_crew
from psdr_jit.inverse.settings import Settings
from psdr_jit.inverse.variables import Variable


@one_at_a_time
def optimize(
    scene: mi.Scene | Sequence[Stage],
    variables: Variable | Sequence[Variable],
    targets: Any = None,
    *,
    loss: Any = "l2",
    integrator: Any = None,
    out: str | os.PathLike | None = None,
    resume: bool = False,
    progress: Callable[[int, int, str], None] | bool | None = None,
    client: Any = None,
    source: SceneFile | str | None = None,
    observers: Sequence[Observer] = (),
    **settings: Any,
) -> loop.Result:
    """Change `variables` of `scene` until its sensors see `targets`; the scene is left at what was found.

    `variables`: `Parameter`, `Pose`, `Vertices`, `Profile`, or objects of your own with the methods of
    `inverse.variables.Variable`. `targets`: one image (H, W, C) of linear radiance for the first sensor, a list with
    one per sensor, or a dict by sensor index; arrays, Dr.Jit tensors, or names of image files. `loss`: "l1", "l2",
    "relative_l2", "dual_l2", a function of (image, target) that returns one number, or an `inverse.losses.Loss`.
    Several scenes in one loss: a list of `psdr_jit.Stage(scene, targets, weight, name, source)` in place of `scene`,
    and no `targets` beside. Losses add up; a variable acts on each scene that has its parameter (`inverse.parts`).
    `integrator`: as in `gradient`: an integrator, a dict of its properties, a plugin name, or None for `psdr_path` with
    the scene's own path lengths. `settings`: fields of `inverse.settings.Settings`, such as `iterations`, `spp`,
    `views_per_step`, `seed`, `decay`.

    With a folder `out`: a log, checkpoints, snapshots, pictures, the final values and, if `source` is given, the scene
    file `final.xml` with them are written there, and `resume=True` goes on where an interrupted run of the same problem
    stopped, with the seeds and the moments that it would have had. Ctrl-C ends the iteration, writes a checkpoint and
    returns.
    `progress(done, total, note)` is called after every iteration; True shows a bar, None does so in notebooks.
    `client`: a `distributed.Client`, whose workers then render, view by view; `source`: the file that the scene was
    loaded from, with the defaults. What a worker has begun is done by another one if it dies.
    `observers`: who looks at each iteration, such as `psdr_jit.LiveView("run.rrd")`; see `inverse.observer`.

    Raises `ParameterError`, `OptionError`, `SceneError` or `UnsupportedError` before the first iteration. Warns
    (`StalledWarning`) where the loss does not depend on a variable, and of a loss that diverges; the run then ends and
    the best state is kept.
    """
    known = set(Settings.__dataclass_fields__)
    unknown = sorted(set(settings) - known)
    if unknown:
        raise OptionError(f"there is no setting {', '.join(map(repr, unknown))}; there are {', '.join(sorted(known))}")
    if not isinstance(scene, Sequence):
        source = SceneFile(source) if isinstance(source, str) else source
        scene, targets = [Stage(scene, targets, source=source)], None
    elif source is not None:
        raise OptionError("source: several scenes have a file each: give each psdr_jit.Stage its source, none beside")
    problem = make_problem(scene, variables, targets, loss, integrator, Settings(**settings))
    if client is not None:
        problem = with_crew(problem, client, integrator)
    with reporting("optimize", progress) as report:
        return loop.run(problem, None if out is None else Path(out), resume, report, observers)
