"""`psdr optimize CONFIG.toml`: a file that describes an optimisation. Everything wrong with it is reported at once.

scene = "scene.xml"               # relative to this file
loss = "l2"                       # l1, l2, relative_l2, dual_l2
iterations = 100                  # and every other field of `settings.Settings`

[defaults]                        # <default> values of the scene file
res = 64

[integrator]                      # properties; psdr_path and the scene's path lengths unless given
max_depth = 3

[optimizer]                       # adam, adamw, sgd or rmsprop, and its options
type = "adam"

[[target]]                        # one or more
sensor = 0                        # index, or a list of them (default: the number of the target)
file = "photo.exr"                # or rendered:
render = 256                      # samples per pixel, of the scene as its file says,
scene = "other.xml"               # or of another scene, with <default> values of its own
defaults = { mesh = "other.ply" }

[[variable]]                      # one or more: "parameter", "pose", "vertices" or "profile"
kind = "pose"
parameter = "box.vertex_positions"
learning_rate = 0.01              # and the other fields of `Parameter`, `Pose`, `Vertices`, `Profile`

Several scenes in one loss, instead of scene = "..." and [[target]]; variables act on every one that has the parameter,
or on one alone, as in parameter = "evening:lamp.position":

[[scene]]
file = "evening.xml"
name = "evening"                  # unless given, that of the file
weight = 0.5                      # of its loss in the sum
defaults = { res = 32 }           # beside those of all scenes
[[scene.target]]                  # one or more, as above
render = 256
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from psdr_jit.cluster.source import SceneFile
from psdr_jit.derivative import integrator_specs
from psdr_jit.errors import OptionError, did_you_mean
from psdr_jit.inverse.losses import LOSSES
from psdr_jit.inverse.parts import Stage
from psdr_jit.inverse.problem import Problem, make_problem
from psdr_jit.inverse.settings import Settings, is_number
from psdr_jit.inverse.shapes import Profile, Vertices
from psdr_jit.inverse.targets import rendered
from psdr_jit.inverse.variables import Parameter, Pose
from psdr_jit.options import Options
from psdr_jit.scene import io as scene_io

KINDS = {"parameter": Parameter, "pose": Pose, "vertices": Vertices, "profile": Profile}
TABLES = ("scene", "loss", "defaults", "integrator", "target", "variable")
TARGET_KEYS = {"sensor": (int, list), "file": str, "render": int, "scene": str, "defaults": Mapping}
EXPECTED = {int: "a whole number", str: "a text", Mapping: "a table", (int, list): "an index or a list of them"}


@dataclass(frozen=True)
class SceneTable:
    """A [[scene]]: one of several."""

    file: Path
    name: str = ""
    weight: float = 1.0
    defaults: Mapping[str, Any] = field(default_factory=dict)  # beside those of all scenes


@dataclass(frozen=True)
class Config:
    """A checked file; paths are absolute."""

    path: Path
    scene: Path
    loss: str
    defaults: Mapping[str, Any]
    integrator: Mapping[str, Any]
    targets: tuple[Mapping[str, Any], ...]  # of all scenes
    variables: tuple[Any, ...]
    settings: Settings
    scenes: tuple[SceneTable, ...] = ()  # if there are several; `scene` is the first then
    shown_by: str = integrator_specs.DEFAULT_INTEGRATOR  # whose images rendered targets are


def read(path: str | Path, **changes: Any) -> Config:
    """Parse and check a file; `changes` replace settings. Raises `OptionError` with all that is wrong with it."""
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib

    path = Path(path)
    if not path.is_file():
        raise OptionError(f"'{path}' is no file: check the path")
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        scene = "; a scene is named in such a file, see scenes/inverse/README.md" if path.suffix == ".xml" else ""
        raise OptionError(f"'{path}' is not valid TOML: {error}{scene}") from error
    wrong: list[str] = []
    config = _checked(path, {**content, **changes}, wrong)
    if wrong:
        listed = "".join(f"\n  - {text}" for text in wrong)
        raise OptionError(f"'{path}' has {len(wrong)} mistake{'s' if len(wrong) > 1 else ''}:{listed}")
    return config


def _checked(path: Path, content: Mapping[str, Any], wrong: list[str]) -> Config | None:
    setting_names = [f.name for f in fields(Settings)]
    _unknown("", content, [*TABLES, *setting_names], wrong)
    tables = {name: _table(content, name, wrong) for name in ("defaults", "integrator")}
    several = isinstance(content.get("scene"), list)
    for name in ("variable",) if several else ("target", "variable"):
        if not isinstance(content.get(name), list) or not all(isinstance(x, Mapping) for x in content[name]):
            wrong.append(f"there must be at least one [[{name}]]")
    listed = _tables(content, "scene")
    scenes = tuple(_scene(path, k, table, wrong) for k, table in enumerate(listed))
    if several and "target" in content:
        wrong.append("[[target]] does not say of which scene: several scenes have a [[scene.target]] each")
    scene = scenes[0].file if scenes else path.parent / str(content.get("scene", ""))
    if "scene" not in content:
        wrong.append('scene = "..." is missing')
    elif not several and not scene.is_file():
        wrong.append(f"scene = {content['scene']!r}: there is no file '{scene}'")
    loss = content.get("loss", "l2")
    if not isinstance(loss, str) or loss not in LOSSES:
        wrong.append(f"loss = {loss!r}: expected one of {', '.join(LOSSES)}")
    owners = listed if several else [content]
    targets = [{**_target(path, k, target, wrong), "stage": stage}
               for stage, owner in enumerate(owners) for k, target in enumerate(_tables(owner, "target"))]  # fmt: skip
    variables = [_variable(k, v, wrong) for k, v in enumerate(_tables(content, "variable"))]
    integrator = {"type": integrator_specs.DEFAULT_INTEGRATOR, **tables["integrator"]}
    if integrator["type"] == integrator_specs.DEFAULT_INTEGRATOR:
        _unknown("[integrator]: ", integrator, ["type", *(f.name for f in fields(Options))], wrong)
    try:
        settings = Settings(**{name: content[name] for name in setting_names if name in content})
    except OptionError as error:
        wrong += str(error).split("; ")
        return None
    own = integrator["type"] in integrator_specs.OURS  # they show light that `path` does not
    shown_by = integrator["type"] if own else integrator_specs.DEFAULT_INTEGRATOR
    return Config(path, scene, loss, tables["defaults"], integrator, tuple(targets), tuple(variables), settings,
                  scenes, shown_by)  # fmt: skip


def _table(content: Mapping[str, Any], name: str, wrong: list[str]) -> Mapping[str, Any]:
    found = content.get(name, {})
    if isinstance(found, Mapping):
        return found
    wrong.append(f"{name} = {found!r}: expected a table, [{name}]")
    return {}


def _tables(content: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    found = content.get(name)
    return [x for x in found if isinstance(x, Mapping)] if isinstance(found, list) else []


def _unknown(where: str, table: Mapping[str, Any], known: list[str], wrong: list[str]) -> None:
    for key in table:
        if key not in known:
            wrong.append(f"{where}there is no key '{key}'{did_you_mean(key, known)}")


def _scene(path: Path, k: int, table: Mapping[str, Any], wrong: list[str]) -> SceneTable:
    where = f"[[scene]] {k + 1}: "
    _unknown(where, table, ["file", "name", "weight", "defaults", "target"], wrong)
    file = path.parent / str(table.get("file", ""))
    if "file" not in table:
        wrong.append(f'{where}file = "..." is missing')
    elif not file.is_file():
        wrong.append(f"{where}there is no file '{file}'")
    weight, name, defaults = table.get("weight", 1.0), table.get("name", file.stem), table.get("defaults", {})
    if not is_number(weight) or not weight > 0:
        wrong.append(f"{where}weight = {weight!r}: expected a number above 0")
    if not isinstance(name, str):
        wrong.append(f"{where}name = {name!r}: expected a text")
    if not isinstance(defaults, Mapping):
        wrong.append(f"{where}defaults = {defaults!r}: expected a table")
    if not _tables(table, "target"):
        wrong.append(f"{where}there must be at least one [[scene.target]]")
    return SceneTable(file, name, weight, defaults)


def _target(path: Path, k: int, table: Mapping[str, Any], wrong: list[str]) -> dict[str, Any]:
    where = f"[[target]] {k + 1}: "
    _unknown(where, table, list(TARGET_KEYS), wrong)
    for key, kind in TARGET_KEYS.items():
        if key in table and (not isinstance(table[key], kind) or isinstance(table[key], bool)):
            wrong.append(f"{where}{key} = {table[key]!r}: expected {EXPECTED[kind]}")
            return {}
    if ("file" in table) == ("render" in table):
        wrong.append(f"{where}give either file or render, the samples per pixel")
    for key in ("scene", "defaults"):
        if key in table and "render" not in table:
            wrong.append(f"{where}{key} is for rendered targets: give render as well")
    if table.get("render", 1) < 1:
        wrong.append(f"{where}render = {table['render']}: expected at least one sample per pixel")
    return _with_paths(path, table, where, k, wrong)


def _with_paths(path: Path, table: Mapping[str, Any], where: str, k: int, wrong: list[str]) -> dict[str, Any]:
    """With a list of sensors and absolute paths of files, which must exist."""
    sensors = table.get("sensor", k)
    found = {**table, "sensor": sensors if isinstance(sensors, list) else [sensors]}
    if not all(isinstance(x, int) and not isinstance(x, bool) for x in found["sensor"]):
        wrong.append(f"{where}sensor = {sensors!r}: expected an index or a list of them")
    if "file" in table and len(found["sensor"]) != 1:
        wrong.append(f"{where}a file is the target of one sensor")
    for key in ("file", "scene"):
        if key in table:
            found[key] = path.parent / table[key]
            if not found[key].is_file():
                wrong.append(f"{where}there is no file '{found[key]}'")
    return found


def _variable(k: int, table: Mapping[str, Any], wrong: list[str]) -> Any:
    where = f"[[variable]] {k + 1}: "
    kind = KINDS.get(table["kind"]) if isinstance(table.get("kind"), str) else None
    if kind is None:
        wrong.append(f"{where}kind = {table.get('kind')!r}: expected one of {', '.join(KINDS)}")
        return None
    own = [f for f in fields(kind) if f.init]
    _unknown(where, table, ["kind", *(f.name for f in own)], wrong)
    missing = [f.name for f in own if f.default is MISSING and f.default_factory is MISSING and f.name not in table]
    if missing:
        wrong.append(f"{where}{' and '.join(missing)} must be given")
    bad = [f for f in own if f.name in table and not ACCEPTED[f.type.removesuffix(" | None")][1](table[f.name])]
    for f in bad:
        wrong.append(f"{where}{f.name} = {table[f.name]!r}: expected {ACCEPTED[f.type.removesuffix(' | None')][0]}")
    return None if missing or bad else kind(**{f.name: table[f.name] for f in own if f.name in table})


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and all(map(is_number, value))


ACCEPTED = {  # annotation of a variable's field: what to call its values, and which are such
    "float": ("a number", is_number),
    "str": ("a text", lambda value: isinstance(value, str)),
    "bool": ("true or false", lambda value: isinstance(value, bool)),
    "Sequence[float]": ("a list of three numbers", lambda value: _is_list(value) and len(value) == 3),
    "Any": ("a number or a list of numbers", lambda value: is_number(value) or _is_list(value)),
}


def problem_of(config: Config, send: bool = False) -> Problem:
    """Load the scenes, render or read the targets; `send`: to workers. Raises what loading and checking raise."""
    tables = config.scenes or (SceneTable(config.scene),)
    stages = [_stage(config, k, replace(table, defaults={**config.defaults, **table.defaults}), send)
              for k, table in enumerate(tables)]  # fmt: skip
    return make_problem(stages, config.variables, None, config.loss, config.integrator, config.settings)


def _stage(config: Config, k: int, table: SceneTable, send: bool) -> Stage:
    """One scene with its targets, which are rendered as the file says."""
    scene = scene_io.load_scene(table.file, **table.defaults)
    integrator_specs.build(integrator_specs.integrator_spec(scene, config.integrator))  # raises before rendering
    kept = {key: value for key, value in config.integrator.items() if key in (*integrator_specs.PATH_OPTIONS, "aovs")}
    shown_by = integrator_specs.build(integrator_specs.integrator_spec(scene, kept | {"type": config.shown_by}))
    targets: dict[int, Any] = {}
    for target in (target for target in config.targets if target["stage"] == k):
        source = scene
        if "scene" in target or "defaults" in target:
            defaults = {**table.defaults, **target.get("defaults", {})}
            source = scene_io.load_scene(target.get("scene", table.file), **defaults)
        for sensor in target["sensor"]:
            if sensor in targets:
                raise OptionError(f"'{config.path}': sensor {sensor} has two targets")
            spp = target.get("render")
            targets[sensor] = rendered(source, sensor, shown_by, spp) if spp else target["file"]
    source = SceneFile(str(table.file), dict(table.defaults), send)
    return Stage(scene, targets, table.weight, table.name, source)


def with_integrator(config: Config, plugin: str) -> Config:
    """The same with another integrator, which keeps the path lengths of the first; targets stay what they are."""
    kept = {key: config.integrator[key] for key in integrator_specs.PATH_OPTIONS if key in config.integrator}
    return replace(config, integrator={"type": plugin, **kept})
