"""Check what psdr_jit needs on this machine, one line each, and say what to do about anything wrong."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

from psdr_jit.errors import SetupError
from psdr_jit.setup import drjit_libraries, llvm, llvm_fetch

NAME = "doctor"
HELP = "check Python, Mitsuba, Dr.Jit and LLVM"

WANTED = (
    "llvm_ad_rgb",
    "llvm_ad_mono",
    "llvm_ad_spectral",
    "cuda_ad_rgb",
    "cuda_ad_mono",
    "cuda_ad_spectral",
)
IMPORT_SECONDS = 120.0

# In a child: a broken binary package may take the process down with it.
IMPORT_CHECK = """
import json, mitsuba, drjit
print(json.dumps({"variants": mitsuba.variants(), "cuda": drjit.has_backend(drjit.JitBackend.CUDA)}))
"""


@dataclass
class Report:
    """Lines as they are found, and the remedies for what is wrong."""

    remedies: list[str] = field(default_factory=list)

    def line(self, label: str, text: str) -> None:
        """Print one finding."""
        print(f"{label:<9} {text}", flush=True)

    def advise(self, remedy: str) -> None:
        """Keep a remedy for the end, each once."""
        if remedy not in self.remedies:
            self.remedies.append(remedy)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Register `--fix`."""
    parser.add_argument(
        "--fix", action="store_true", help="fetch an LLVM into this environment if none works (apt, no root)"
    )


def run(args: argparse.Namespace) -> int:
    """Print the report; 0 if at least one variant can be used, else 3."""
    report = Report()
    check_python(report)
    installed = [check_package(report, name) for name in ("mitsuba", "drjit")]
    imported = check_import(report, args.fix) if all(installed) else {}
    works = check_llvm(report, args.fix) if imported else False
    usable = check_variants(report, imported, works)
    for remedy in report.remedies:
        report.line("to do", remedy)
    report.line("result", f"ready, e.g. {usable[0]}" if usable else "not usable yet")
    return 0 if usable else 3


def check_python(report: Report) -> None:
    """The interpreter and its environment."""
    report.line("Python", f"{platform.python_version()}  {sys.executable}")


def check_package(report: Report, name: str) -> bool:
    """Whether a package is installed, without importing it."""
    try:
        report.line(name, importlib.metadata.version(name))
        return True
    except importlib.metadata.PackageNotFoundError:
        report.line(name, "not installed")
        launcher = Path(__file__).parents[2] / "psdr"
        again = f"{sys.executable} -m pip install mitsuba"
        if launcher.exists():
            again = f"{launcher} doctor  (needs a network)"
        report.advise(f"install the packages:  {again}")
        return False


def check_import(report: Report, fix: bool) -> dict:
    """What Mitsuba and Dr.Jit say when imported; empty if they cannot be."""
    library = drjit_libraries.missing_library()
    if library is not None and fix:
        try:
            drjit_libraries.provide_missing()
            library = None
        except SetupError as error:
            report.line("fetch", f"FAILED: {str(error).splitlines()[0]}")
    if library is not None:
        report.line("import", f"FAILED: Dr.Jit needs {library}, which this system lacks")
        report.advise(drjit_libraries.advice(library))
        return {}
    command = [sys.executable, "-c", IMPORT_CHECK]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=IMPORT_SECONDS, cwd=os.sep)
    except subprocess.TimeoutExpired:
        report.line("import", f"FAILED: no answer within {IMPORT_SECONDS:.0f} s")
        return {}
    if child.returncode != 0:
        last = (child.stderr.strip().splitlines() or [f"status {child.returncode}"])[-1]
        report.line("import", f"FAILED: {last}")
        report.advise(f"reinstall them:  {sys.executable} -m pip install --force-reinstall mitsuba")
        return {}
    return json.loads(child.stdout.splitlines()[-1])


def check_llvm(report: Report, fix: bool) -> bool:
    """Probe the library that would be used, afresh; search the others if it fails."""
    named = llvm.user_path()
    saved = None if named else llvm.read_choice()
    path = named or (saved.path if saved else None)
    if path is not None:
        verdict = llvm.probe(path)
        if verdict.choice is not None:
            return report_llvm(report, verdict.choice, " (DRJIT_LIBLLVM_PATH)" if named else "")
        report.line("LLVM", path)
        report.line("probe", f"FAILED: {verdict.reason}")
        if named:
            report.advise("unset DRJIT_LIBLLVM_PATH to let psdr choose, or point it at another libLLVM")
            return False
    choice, verdicts = llvm.try_candidates()
    for tried in verdicts:
        if tried.choice is None and tried.path != path:
            report.line("LLVM", f"{tried.path}: {tried.reason}")
    if choice is None and fix:
        try:
            choice = llvm_fetch.fetch(llvm.accept_fetched)
        except SetupError as error:
            report.line("fetch", f"FAILED: {str(error).splitlines()[0]}")
    if choice is not None:
        llvm.save_choice(choice)
        return report_llvm(report, choice, "")
    report.line("LLVM", "none that works")
    report.line("probe", "FAILED: nothing to compile with")
    for advice in llvm_fetch.advice():
        report.advise(advice)
    return False


def report_llvm(report: Report, choice: llvm.Choice, origin: str) -> bool:
    """The lines of a library that works."""
    report.line("LLVM", f"{choice.version}  {choice.path}{origin}")
    report.line("probe", "ok, compiled and ran a kernel")
    return True


def check_variants(report: Report, imported: dict, llvm_works: bool) -> list[str]:
    """One line for each variant psdr_jit can use, with the reason if it cannot be."""
    usable = []
    for name in WANTED:
        if name not in imported.get("variants", ()):
            reason = "no: not in this Mitsuba" if imported else "no: Mitsuba cannot be imported"
        elif name.startswith("cuda"):
            reason = "yes" if imported["cuda"] else "no: no CUDA device"
        else:
            reason = "yes" if llvm_works else "no: no LLVM that works"
        usable += [name] if reason == "yes" else []
        report.line("variant", f"{name}: {reason}")
    return usable
