"""The `psdr` command: exit statuses, lazy imports, and a doctor that survives what it diagnoses."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import types
from pathlib import Path

import pytest

from psdr_jit.cli import doctor, main
from psdr_jit.cli import test as test_command
from psdr_jit.errors import ParameterError, SetupError, StorageError
from psdr_jit.setup import drjit_libraries, llvm, llvm_fetch

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test may change the environment's saved choice."""
    monkeypatch.setattr(llvm_fetch, "state_folder", lambda: tmp_path)
    monkeypatch.setenv(llvm.VARIABLE, os.environ.get(llvm.VARIABLE, ""))


def install_command(monkeypatch: pytest.MonkeyPatch, run) -> None:
    """Register `psdr fake`, which calls `run`."""
    module = types.ModuleType("psdr_fake_command")
    module.add_arguments, module.run = lambda parser: None, run
    monkeypatch.setitem(sys.modules, "psdr_fake_command", module)
    monkeypatch.setitem(main.COMMANDS, "fake", main.Command("psdr_fake_command", "fake", renders=False))


def raiser(error: BaseException):
    """A `run` that fails with `error`."""

    def run(args: object) -> int:
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (ParameterError("no such parameter"), 2, "psdr: error: no such parameter"),
        (SetupError("no LLVM"), 3, "psdr: error: no LLVM"),
        (ModuleNotFoundError("x", name="mitsuba"), 3, "'mitsuba' is not installed; see: psdr doctor"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_become_statuses(error, status, text, monkeypatch, capsys) -> None:
    install_command(monkeypatch, raiser(error))
    monkeypatch.delenv(main.TRACEBACK_VARIABLE, raising=False)
    assert main.main(["fake"]) == status
    message = capsys.readouterr().err
    assert text in message and "Traceback" not in message


def test_traceback_on_request(monkeypatch, capsys) -> None:
    install_command(monkeypatch, raiser(ParameterError("why")))
    monkeypatch.setenv(main.TRACEBACK_VARIABLE, "1")
    assert main.main(["fake"]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("error", [
    ModuleNotFoundError("no module", name="psdr_jit.nonsense"), ZeroDivisionError("division by zero"), KeyError("name"),
    RuntimeError("first line\nsecond line"), TypeError(), OSError(5, "Input/output error"),
])  # fmt: skip
def test_what_nobody_foresaw_is_one_line_and_its_traceback_on_request(error, monkeypatch, capsys) -> None:
    """Status 1 is left to checks that did not pass."""
    install_command(monkeypatch, raiser(error))
    monkeypatch.delenv(main.TRACEBACK_VARIABLE, raising=False)
    assert main.main(["fake"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert type(error).__name__ in line and f"{main.TRACEBACK_VARIABLE}=1 shows where" in line
    monkeypatch.setenv(main.TRACEBACK_VARIABLE, "1")
    assert main.main(["fake"]) == 3
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(("cause", "status", "text"), [
    (ParameterError("no such parameter"), 2, "psdr: error: no such parameter"),
    (StorageError("no room"), 3, "psdr: error: no room"),
    (RuntimeError("jit_malloc(): out of memory!"), 3, "fewer samples per pixel"),
    (ValueError("the cause"), 3, "ValueError: the cause"),
])  # fmt: skip
def test_what_drjit_has_wrapped_is_found(cause, status, text, monkeypatch, capsys) -> None:
    wrapped = RuntimeError("drjit.custom(): error while performing a custom differentiable operation. (see above).")
    wrapped.__cause__ = cause
    install_command(monkeypatch, raiser(wrapped))
    assert main.main(["fake"]) == status
    assert text in capsys.readouterr().err


def test_output_that_cannot_be_printed() -> None:
    code = "import sys; from psdr_jit.cli.main import main; sys.exit(main(['doctor']))"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert done.returncode == 3
    assert "no space left" in done.stderr and "Traceback" not in done.stderr and "Exception" not in done.stderr


def test_wrong_usage(capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        main.main(["nonsense"])
    assert caught.value.code == 2
    with pytest.raises(SystemExit) as caught:
        main.main([])
    assert caught.value.code == 2


@pytest.mark.parametrize("name", sorted(main.COMMANDS))
def test_table_agrees_with_the_modules(name: str) -> None:
    module = importlib.import_module(main.COMMANDS[name].module)
    assert module.NAME == name and module.HELP
    assert callable(module.add_arguments) and callable(module.run)


def test_help_needs_no_mitsuba() -> None:
    code = "import sys; from psdr_jit.cli.main import main\n"
    code += (
        "try: main(['--help'])\nfinally: assert 'mitsuba' not in sys.modules and 'drjit' not in sys.modules"
    )
    environment = {**os.environ, drjit_libraries.NO_PLUGINS: "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in main.COMMANDS)


def test_doctor_accepts_an_llvm_that_works(capsys) -> None:
    try:
        llvm.ensure_llvm(fetch=False)
    except SetupError:
        pytest.skip("this machine has no LLVM that works")
    assert main.main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    labels = [line.split()[0] for line in lines]
    assert labels[:3] == ["Python", "mitsuba", "drjit"] and {"LLVM", "probe", "variant", "result"} <= set(
        labels
    )
    assert "variant   llvm_ad_rgb: yes" in lines


def test_doctor_reports_a_bad_path_of_the_user(tmp_path: Path, monkeypatch, capsys) -> None:
    bad = tmp_path / "libLLVM-99.so"
    bad.write_text("not a library")
    monkeypatch.setenv(llvm.VARIABLE, str(bad))
    monkeypatch.setattr(doctor, "check_import", lambda report, fix: {"variants": [], "cuda": False})
    assert main.main(["doctor"]) == 3
    out = capsys.readouterr().out
    assert "probe     FAILED" in out and f"unset {llvm.VARIABLE}" in out


def test_doctor_without_any_llvm(monkeypatch, capsys) -> None:
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "candidates", lambda: [])
    assert main.main(["doctor"]) == 3
    out = capsys.readouterr().out
    assert "none that works" in out and "to do     install one:" in out and "llvm_ad_rgb: no" in out


def test_doctor_without_mitsuba(monkeypatch, capsys) -> None:
    def version(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.importlib.metadata, "version", version)
    assert main.main(["doctor"]) == 3
    out = capsys.readouterr().out
    assert "mitsuba   not installed" in out and "to do     install the packages:" in out


def test_doctor_names_a_missing_system_library(monkeypatch, capsys) -> None:
    monkeypatch.setattr(drjit_libraries, "missing_library", lambda: "libatomic.so.1")
    assert main.main(["doctor"]) == 3
    assert "Dr.Jit needs libatomic.so.1" in capsys.readouterr().out


def test_the_test_command_needs_a_clone(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(test_command.psdr_jit, "__file__", str(tmp_path / "psdr_jit/__init__.py"))
    assert main.main(["test"]) == 3
    assert "clone the repository" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["test", "--help"], ["test", "-h"], ["test", "-k", "edges", "--help"]])
def test_help_of_the_test_command_is_ours(words, monkeypatch, capsys) -> None:
    """pytest's own says neither what runs nor where; no clone and no LLVM are needed for it."""
    monkeypatch.setattr(test_command.subprocess, "run", raiser(AssertionError("started pytest")))
    monkeypatch.setattr(llvm, "ensure_llvm", raiser(AssertionError("looked for an LLVM")))
    with pytest.raises(SystemExit) as stopped:
        main.main(words)
    text = capsys.readouterr().out
    assert stopped.value.code == 0 and "usage: psdr test" in text
    assert "goes to pytest" in text and "./psdr test -m slow" in text and "Exit status" in text


def test_pytest_arguments_pass_through(monkeypatch) -> None:
    """Options are not ours to interpret, and pytest's statuses are translated."""
    seen = []

    def run(command: list[str], **options: object) -> types.SimpleNamespace:
        seen.append(command)
        return types.SimpleNamespace(returncode=5)

    monkeypatch.setattr(llvm, "ensure_llvm", lambda: None)
    monkeypatch.setattr(test_command.subprocess, "run", run)
    assert main.main(["test", "-k", "edges", "--collect-only"]) == 2
    assert seen[0][1:] == ["-m", "pytest", "-k", "edges", "--collect-only"]


def test_bytecode_of_tests_has_a_folder_of_its_own_where_sources_have_none(monkeypatch):
    monkeypatch.delenv(test_command.BYTECODE_FOLDER, raising=False)
    monkeypatch.delenv(test_command.NO_BYTECODE, raising=False)
    assert test_command.BYTECODE_FOLDER not in test_command.environment_of_tests()
    monkeypatch.setenv(test_command.NO_BYTECODE, "1")
    child = test_command.environment_of_tests()
    assert child[test_command.BYTECODE_FOLDER].endswith("bytecode") and test_command.NO_BYTECODE not in child
