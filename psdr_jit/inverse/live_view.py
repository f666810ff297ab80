"""An optimisation in the viewer Rerun: curves, images beside their targets, meshes and cameras over the iterations.

Needs the package `rerun-sdk`. What is logged, on the timeline `iteration`:

    loss, learning_rate, gradient_norm/..., offset/..., value/...     curves, see `observer.curves`
    world/shapes/NAME        meshes, boxes around other shapes; anew where a variable moves them; SCENE_NAME of several
    world/cameras/VIEW       pose, and the image as the loss has seen it
    targets/VIEW             what it should become

Two recordings of one problem, such as a run and its resumption, have one identity: opened together they are one.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from psdr_jit.derivative.images import check_writable, colours, srgb
from psdr_jit.errors import OptionError, SetupError
from psdr_jit.inverse import stage, viewer
from psdr_jit.inverse.observer import Care, Seen, curves, frame_due

LIVE = "live"
NAME = "psdr optimize"  # of the application, as viewers list it
TIMELINE = "iteration"
GREY = (190, 190, 190)  # of meshes
PLANE = 0.15  # distance of a camera's image from the camera, in diagonals of the scene


def require_rerun() -> Any:
    """The module `rerun`. Raises `SetupError` where it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise SetupError(
            f"the live view needs the package rerun-sdk ('{error.name}' is missing): pip install rerun-sdk"
        ) from error
    return rerun


class LiveView:
    """An observer that logs to `target`: a new file FILE.rrd, or "live", a viewer of this machine.

    With "live", one that runs already is used, at Rerun's usual port, else one is started. Raises `OptionError` for
    files that cannot be written or are there already, `SetupError` where the package or a viewer is missing.
    """

    def __init__(self, target: str | os.PathLike) -> None:
        self._rr = require_rerun()
        self._file = None if os.fspath(target) == LIVE else Path(target)
        if self._file is not None:
            require_new(self._file)
        else:
            viewer.require_viewer()
        self._care = Care("the live view" if self._file is None else f"'{self._file}'")
        self._log: Any = None
        self._problem: Any = None
        self._moving: set[str] = set()

    def begin(self, problem: Any) -> None:
        self._problem, self._moving = problem, stage.moving(problem)
        self._log = self._rr.RecordingStream(NAME, recording_id=problem.fingerprint)
        if self._file is None:
            self._log.connect_grpc(viewer.ADDRESS, default_blueprint=self._blueprint())
        else:
            self._open()
        self._care.attempt(self._background)

    def step(self, seen: Seen) -> None:
        self._care.attempt(lambda: self._step(seen))

    def close(self, iteration: int) -> None:
        if self._log is None:
            return
        self._care.attempt(lambda: self._end(iteration))
        self._log.disconnect()

    def _open(self) -> None:
        try:
            self._log.save(self._file, default_blueprint=self._blueprint())
        except RuntimeError as error:
            raise OptionError(f"cannot write '{self._file}': {error}; choose another name") from error

    def _background(self) -> None:
        """What rests, and the targets."""
        rr, problem = self._rr, self._problem
        for view in problem.views:
            self._image(["targets", view.name], colours(np.array(view.target), view.aovs), static=True)
        for name, shape in stage.bodies(problem).items():
            if name not in self._moving:
                self._shape(name, shape, static=True)
        for view in problem.views:
            if view.name not in self._moving:
                self._camera(view, static=True)
        self._log.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)

    def _step(self, seen: Seen) -> None:
        self._log.set_time(TIMELINE, sequence=seen.iteration)
        for name, values in curves(seen).items():
            self._log.log(name.split("/"), self._rr.Scalars(values))
        if frame_due(seen.iteration, self._problem.settings.iterations):
            self._move()
            for k, image in seen.images.items():
                view = self._problem.views[k]
                self._image(["world", "cameras", view.name], colours(image, view.aovs))

    def _end(self, iteration: int) -> None:
        self._log.set_time(TIMELINE, sequence=iteration)
        self._move()
        self._log.flush()

    def _move(self) -> None:
        for name, shape in stage.bodies(self._problem).items():
            if name in self._moving:
                self._shape(name, shape)
        for view in self._problem.views:
            if view.name in self._moving:
                self._camera(view)

    def _shape(self, name: str, shape: Any, static: bool = False) -> None:
        rr, found = self._rr, stage.standing(shape)
        if isinstance(found, stage.Box):
            drawn = rr.Boxes3D(centers=[found.centre], half_sizes=[found.half])
        else:
            drawn = rr.Mesh3D(vertex_positions=found.vertices, triangle_indices=found.faces,
                              vertex_normals=found.normals, albedo_factor=GREY)  # fmt: skip
        self._log.log(["world", "shapes", name], drawn, static=static)

    def _camera(self, view: Any, static: bool = False) -> None:
        rr, found = self._rr, stage.camera(view.sensor)
        parts = [rr.Transform3D(translation=found.pose[:3, 3], mat3x3=found.pose[:3, :3])]
        if found.intrinsics is not None:
            bbox = self._problem.parts[view.part].scene.bbox()
            parts.append(rr.Pinhole(
                image_from_camera=found.intrinsics, resolution=found.size, camera_xyz=rr.ViewCoordinates.LUF,
                image_plane_distance=PLANE * float(np.linalg.norm(np.array(bbox.extents()))),
            ))  # fmt: skip
        self._log.log(["world", "cameras", view.name], *parts, static=static)

    def _image(self, path: list[str], image: np.ndarray, static: bool = False) -> None:
        shown = np.round(255 * srgb(image)).astype(np.uint8)
        self._log.log(path, self._rr.Image(shown), static=static)

    def _blueprint(self) -> Any:
        """The first arrangement that a viewer shows."""
        import rerun.blueprint as rrb

        escape = self._rr.escape_entity_path_part
        pairs = []
        for view in self._problem.views:
            now, target = f"world/cameras/{escape(view.name)}", f"targets/{escape(view.name)}"
            pairs += [rrb.Spatial2DView(origin=now, name=view.name), rrb.Spatial2DView(origin=target, name="target")]
        curves = [rrb.TimeSeriesView(origin="/", contents=f"+ /{name}/**", name=title)
                  for name, title in (("loss", "loss"), ("offset", "offset from the scene file"))]  # fmt: skip
        scene = rrb.Spatial3DView(origin="world", name="scene")
        return rrb.Blueprint(rrb.Horizontal(rrb.Grid(*pairs, grid_columns=2), scene, rrb.Vertical(*curves)),
                             collapse_panels=True)  # fmt: skip


def require_new(path: Path) -> None:
    """Raise `OptionError` unless a recording can be made at `path` without replacing one."""
    if path.suffix != ".rrd":
        raise OptionError(f'--rerun {path}: expected a file that ends in .rrd, or "{LIVE}"')
    if path.exists():
        raise OptionError(
            f"'{path}' is there already: choose another name, also to go on with a run (Rerun shows both recordings as "
            "one), or remove it"
        )
    check_writable(path)
