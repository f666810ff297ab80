"""The shape of the code base: imports point one way, no variant is needed or set, errors are typed, files short."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import psdr_jit

ROOT = Path(psdr_jit.__file__).parent
MAX_LINES = 300
MAX_FUNCTION = 60  # lines
MAX_PARAMETERS = 8
PUBLIC = {f"psdr_jit.{name}" for name in (*psdr_jit.__all__, "finite_differences")}
LAST_RESORT = "cli.main"  # turns whatever arrives into one line and an exit status

ROOMS = (
    "errors", "options", "setup", "core", "scene", "paths", "plan", "edges", "sampling", "interior", "boundary",
    "driver", "plugins", "cluster", "export", "derivative", "inverse", "report", "cli",
)  # fmt: skip
"""Folders (and the modules that lie flat) in the order of import: each may import from those before it only."""

MAX_FLAT = 8
"""Modules that lie directly in psdr_jit."""

INDEPENDENT = {("interior", "boundary"), ("boundary", "interior")}
"""Rooms that must not know each other, whatever their order."""


def modules() -> dict[str, Path]:
    """Our modules by their name below psdr_jit, without the packages' __init__ files."""
    found = {}
    for root, prefix in ((ROOT, ""), (ROOT.parent / "plugins", "plugins.")):
        for path in sorted(root.rglob("*.py")):
            name = prefix + ".".join(path.relative_to(root).with_suffix("").parts)
            if not name.endswith("__init__"):
                found[name] = path
    return found


def imports(name: str, path: Path) -> set[str]:
    """Names of our modules that a module imports, relative or absolute, on loading or inside of its functions."""
    package = ["psdr_jit", *name.split(".")[:-1]]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{base}.{alias.name}" for alias in node.names}
    known = modules()
    ours = {f.removeprefix("psdr_jit.") for f in found if f.startswith("psdr_jit.")}
    return {m for f in ours for m in (f, f.rpartition(".")[0]) if m in known} - {name}


def room(module: str) -> str:
    top = module.split(".")[0]
    assert top in ROOMS, f"psdr_jit.{module}: give the room a place in ROOMS, after all that it imports from"
    return top


@pytest.mark.parametrize("module", modules())
def test_imports_point_one_way(module):
    for imported in imports(module, modules()[module]):
        own, other = room(module), room(imported)
        assert ROOMS.index(other) <= ROOMS.index(own), f"{module} must not import {imported}"
        assert (own, other) not in INDEPENDENT, f"{module} must not know {imported}"


@pytest.mark.parametrize("name", ROOMS)
def test_no_circles_inside_of_a_room(name):
    """Modules of one room can be put in an order in which each imports from earlier ones only."""
    inside = {m for m in modules() if room(m) == name}
    left = {m: imports(m, modules()[m]) & inside for m in inside}
    while left:
        free = {m for m, needs in left.items() if not needs & left.keys()}
        assert free, f"these import each other: {sorted(left)}"
        left = {m: needs for m, needs in left.items() if m not in free}


def test_the_import_scan_sees_imports():
    assert {"boundary.primary", "interior.term", "plan.term"} <= imports("driver.terms", modules()["driver.terms"])
    assert "core.sensor_frame" in imports("boundary.primary", modules()["boundary.primary"])
    assert "setup.drjit_libraries" in imports("cli.setup_env", modules()["cli.setup_env"])  # inside of a function


def test_every_room_says_what_it_is_for():
    """And few modules lie flat: a stranger sees the architecture from the list of folders."""
    flat = [path.name for path in ROOT.glob("*.py") if path.name != "__init__.py"]
    assert len(flat) <= MAX_FLAT
    for folder in (f for f in ROOT.iterdir() if f.is_dir() and (f / "__init__.py").is_file()):
        assert folder.name in ROOMS
        assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")))


def test_unit_tests_mirror_the_rooms():
    folders = {f.name for f in (Path(__file__).parent / "unit").iterdir() if f.is_dir() and f.name != "__pycache__"}
    assert folders <= {*ROOMS, "benchmarks", "docs"}, "a folder of tests/unit is named after the room that it tests"


@pytest.mark.parametrize("module", modules())
def test_files_are_short(module):
    lines = modules()[module].read_text(encoding="utf-8").count("\n")
    assert lines <= MAX_LINES, f"{module} has {lines} lines: one file, one concept"


@pytest.mark.parametrize("module", modules())
def test_functions_are_short_and_take_little(module):
    """Options of the public functions, keyword-only, are not counted: they are names, not positions."""
    for node in ast.walk(ast.parse(modules()[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno - node.lineno < MAX_FUNCTION, f"{module}.{node.name}: one function, one step"
            given = [a.arg for a in node.args.posonlyargs + node.args.args if a.arg not in ("self", "cls")]
            options = [] if f"psdr_jit.{node.name}" in PUBLIC else [a.arg for a in node.args.kwonlyargs]
            assert len(given) + len(options) <= MAX_PARAMETERS, f"{module}.{node.name}: group what belongs together"


@pytest.mark.parametrize("module", modules())
def test_errors_are_typed_and_not_swallowed(module):
    for node in ast.walk(ast.parse(modules()[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Raise) and node.exc is not None:
            raised = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            assert getattr(raised, "id", "") not in ("Exception", "BaseException"), f"{module}:{node.lineno}"
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"{module}:{node.lineno} catches everything"
            everything = getattr(node.type, "id", "") in ("Exception", "BaseException")
            raises_again = isinstance(node.body[-1], ast.Raise) and node.body[-1].exc is None
            allowed = raises_again or module == LAST_RESORT
            assert not everything or allowed, f"{module}:{node.lineno} swallows whatever goes wrong"


@pytest.mark.parametrize("module", modules())
def test_annotations_are_not_evaluated(module):
    """Without this, importing a core module would need a variant."""
    assert "from __future__ import annotations" in modules()[module].read_text(encoding="utf-8")


def test_core_imports_without_a_variant_and_sets_none():
    core = [m for m in modules() if m.split(".")[0] not in ("plugins", "cli") and not m.endswith("__main__")]
    code = "; ".join([
        "import mitsuba as mi, importlib, psdr_jit",
        f"[importlib.import_module('psdr_jit.' + m) for m in {core!r} if m != 'setup.llvm_probe']",
        "assert mi.variant() is None, mi.variant()",
    ])  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
