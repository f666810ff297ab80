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

RANK = {
    # nothing of ours below
    "errors": -1, "ad": 0, "support": 0, "records": 0, "statistics": 0, "system_advice": 0, "llvm_probe": 0,
    "private_apt": 0, "ply": 0, "edge_distribution": 0, "analytic_edges": 0, "streams": 0, "scattering": 0,
    "low_discrepancy": 0, "rejected": 0, "threads": 1, "warn_once": 0, "scene_guard": 0, "upload": 0,
    # host-side descriptions
    "compat": 1, "options": 1, "scene_names": 1, "mesh_edges": 1, "film": 1, "path_steps": 1, "images": 1,
    "llvm_fetch": 1, "scene_io": 1,
    "params": 2, "scene_probes": 3, "batch": 4,
    "edge_geometry": 2, "mesh_shells": 2, "sensor_frame": 2, "path_records": 2, "touch": 2,
    "intersections": 2, "walk_tangents": 2, "perturbation": 3, "llvm": 2,
    "scene_analysis": 4, "interior": 6, "drjit_libraries": 3, "llvm_guard": 3,
    "scene_checks": 6, "scene_size": 5, "stale_normals": 5,
    "plan": 5, "velocities": 5, "convexity": 5, "forms": 5, "trial": 5,
    "job": 6,
    "edge_rows": 2, "junctions": 6, "junction_points": 7, "shape_pairs": 3,
    "edge_set": 7,
    # estimators
    "boundary": 8, "interior_term": 8,
    "terms": 9,
    # plugins and the tools on top of them
    "pilot": 10, "noise_log": 11, "integrators": 10, "planning": 12, "plugins": 13,
    "gradient": 14, "finite_differences": 14,
    "check": 15, "demo": 15, "inverse": 15,
    "cli": 16,
}  # fmt: skip
"""Stage of each module or package; an import must lead to a lower one, or stay within a package."""


def modules() -> dict[str, Path]:
    """Our modules by their name below psdr_jit, without the packages' __init__ files."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        if not name.endswith("__init__"):
            found[name] = path
    return found


def imports(name: str, path: Path) -> set[str]:
    """Names of our modules that a module imports when it is loaded, relative or absolute."""
    package = ["psdr_jit", *name.split(".")[:-1]]
    found = set()
    for node in module_level(ast.parse(path.read_text(encoding="utf-8")).body):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{base}.{alias.name}" for alias in node.names}
    known = modules()
    ours = {f.removeprefix("psdr_jit.") for f in found if f.startswith("psdr_jit.")}
    return {m for f in ours for m in (f, f.rpartition(".")[0]) if m in known}


def module_level(body: list[ast.stmt]) -> list[ast.stmt]:
    """Statements that run on import: not those inside of functions."""
    found = []
    for node in body:
        found.append(node)
        for block in ("body", "orelse", "finalbody"):
            if not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                found += module_level(getattr(node, block, []))
    return found


def rank(module: str) -> int:
    top = module.split(".")[0]
    assert top in RANK, f"give psdr_jit.{module} a stage in RANK: above all it imports, below all that import it"
    return RANK[top]


@pytest.mark.parametrize("module", modules())
def test_imports_point_one_way(module):
    for imported in imports(module, modules()[module]):
        same_package = "." in module and module.split(".")[0] == imported.split(".")[0]
        assert same_package or rank(imported) < rank(module), f"{module} must not import {imported}"


def test_the_import_scan_sees_imports():
    assert {"boundary.primary", "interior_term", "job"} <= imports("terms", modules()["terms"])
    assert "sensor_frame" in imports("boundary.primary", modules()["boundary.primary"])


@pytest.mark.parametrize("module", modules())
def test_files_are_short(module):
    lines = modules()[module].read_text(encoding="utf-8").count("\n")
    assert lines <= MAX_LINES, f"{module} has {lines} lines: one file, one concept"


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
            assert not everything or raises_again, f"{module}:{node.lineno} swallows whatever goes wrong"


@pytest.mark.parametrize("module", modules())
def test_annotations_are_not_evaluated(module):
    """Without this, importing a core module would need a variant."""
    assert "from __future__ import annotations" in modules()[module].read_text(encoding="utf-8")


def test_core_imports_without_a_variant_and_sets_none():
    core = [m for m in modules() if m.split(".")[0] not in ("plugins", "cli") and not m.endswith("__main__")]
    code = "; ".join([
        "import mitsuba as mi, importlib, psdr_jit",
        f"[importlib.import_module('psdr_jit.' + m) for m in {core!r} if m != 'llvm_probe']",
        "assert mi.variant() is None, mi.variant()",
    ])  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
