"""Set-up of the checkout, run by the launcher: `python setup_env.py ROOT KEY`.

Makes `.venv`, installs the checkout into it and provides an LLVM. Runs by path under the system's Python,
before any package is installed, hence standard library only; the last step runs inside the new environment
(`setup_env.py --llvm`). Each step leaves a file that says it is complete, written last, so the
next run repairs what an interrupted one left:

    .venv/psdr-made      the environment is ours: it may be wiped and rebuilt
    .venv/psdr-packages  packages are complete for this key and Python
    .venv/psdr-stamp     all is complete; the launcher compares it without starting Python
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import types
from collections.abc import Iterator
from pathlib import Path

if not __package__:
    # Run by path. An empty stand-in for the package lets its modules be imported without its __init__, which
    # imports Mitsuba: not installed yet, or (for want of a library that we are about to fetch) not loadable.
    _package = types.ModuleType("psdr_jit")
    _package.__path__ = [str(Path(__file__).resolve().parents[1])]
    sys.modules["psdr_jit"] = _package

from psdr_jit.setup import private_apt, system_advice  # noqa: E402

SETUP_MISSING = 3  # exit status: the machine lacks something
MADE, PACKAGES, STAMP = "psdr-made", "psdr-packages", "psdr-stamp"
KEPT = ("llvm", MADE)  # survive a rebuild: the fetched LLVM does not depend on the Python


class SetupFailure(RuntimeError):
    """A step of the set-up failed; the message says what to do."""


def say(text: str) -> None:
    """One line of progress; standard output belongs to the command that runs after the set-up."""
    print(f"psdr: {text}", file=sys.stderr, flush=True)


def run(command: list[str], **options: object) -> int:
    """Run a step with its output on standard error; PIP_USER and the like must not lead pip astray."""
    overridden = ("PIP_USER", "PIP_TARGET", "PIP_PREFIX", "PIP_REQUIRE_VIRTUALENV", "PYTHONHOME")
    environment = {key: value for key, value in os.environ.items() if key not in overridden}
    environment["PIP_USER"] = "0"
    try:
        return subprocess.run(command, stdout=sys.stderr, env=environment, check=False, **options).returncode
    except OSError:
        return 127  # not an executable, as a shell would say


@contextlib.contextmanager
def exclusive(root: Path) -> Iterator[None]:
    """Only one set-up at a time in a checkout. The kernel drops the lock when its holder dies."""
    try:
        import fcntl

        handle = os.open(root, os.O_RDONLY)
    except ImportError:  # not a POSIX system: the launcher does not run there
        yield
        return
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("waiting for another set-up of this checkout to finish ...")
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(handle)


def stamp_text(venv: Path, key: str) -> str:
    """What a complete step records: the launcher's key and the interpreter behind the environment."""
    return f"{key}\n{os.path.realpath(venv / 'bin' / 'python')}\n"


def is_complete(venv: Path, name: str, key: str) -> bool:
    """Whether the step that writes `name` was completed for this key and interpreter."""
    try:
        written = (venv / name).read_text()
    except OSError:
        return False
    return os.access(venv / "bin" / "python", os.X_OK) and written == stamp_text(venv, key)


def write_stamp(venv: Path, name: str, key: str) -> None:
    """Record a completed step, in one piece."""
    fresh = venv / f"{name}.new"
    fresh.write_text(stamp_text(venv, key))
    os.replace(fresh, venv / name)


def make_environment(venv: Path) -> None:
    """Create `.venv`, or rebuild it if it is ours. An environment that the user made is used, not wiped."""
    if (venv / "pyvenv.cfg").exists() and not (venv / MADE).exists():
        check = "import sys; sys.exit(sys.version_info < (3, 10) or sys.prefix == sys.base_prefix)"
        python = venv / "bin" / "python"
        if python.exists() and run([str(python), "-c", check]) == 0 and has_pip(python):
            say(f"using your environment {venv}")
            return
        raise SetupFailure(
            f"{venv} was not made by psdr and does not work; move it away:  mv {venv} {venv}.old"
        )
    say(f"creating {venv} (Python {sys.version.split()[0]}) ...")
    venv.mkdir(exist_ok=True)
    (venv / MADE).touch()
    for entry in venv.iterdir():
        if entry.name not in KEPT:
            shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
    if importlib.util.find_spec("ensurepip") is not None:
        if run([sys.executable, "-m", "venv", str(venv)], stderr=subprocess.DEVNULL) == 0:
            return
    if run([sys.executable, "-m", "venv", "--without-pip", str(venv)]) != 0:
        raise SetupFailure(no_venv_message())
    add_pip(venv)


def has_pip(python: Path | str) -> bool:
    """Whether this interpreter has a pip."""
    return run([str(python), "-m", "pip", "--version"], stderr=subprocess.DEVNULL) == 0


def add_pip(venv: Path) -> None:
    """Put pip into an environment whose Python came without ensurepip (Debian without python3-venv).

    Either the system's pip does it, or the pip wheel of Debian's own package, which is runnable as it is.
    """
    python = str(venv / "bin" / "python")
    system_pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "pip"]
    if has_pip(sys.executable) and run(system_pip) == 0:
        return
    if not private_apt.is_available():
        raise SetupFailure(no_venv_message())
    say("this Python has no ensurepip; fetching the pip wheel (apt, without root) ...")
    with tempfile.TemporaryDirectory(prefix=".fetch-", dir=venv) as scratch:
        work = Path(scratch)
        try:
            private_apt.unpack(private_apt.update(work), ["python3-pip-whl"], work / "tree")
        except private_apt.AptError as error:
            raise SetupFailure(f"{error}\n{no_venv_message()}") from error
        wheels = sorted((work / "tree").glob("usr/share/python-wheels/pip-*.whl"))
        install = ["install", "--quiet", "--no-index", "--no-deps"]
        if not wheels or run([python, f"{wheels[-1]}/pip", *install, str(wheels[-1])]) != 0:
            raise SetupFailure(no_venv_message())


def no_venv_message() -> str:
    """How to get a Python that can make environments."""
    command = system_advice.install_command("venv")
    return f"this Python cannot make a virtual environment with pip; run:  {command}\nthen run psdr again"


def install_packages(root: Path, venv: Path) -> None:
    """Install the checkout, editable, with its test dependencies."""
    say("installing Mitsuba, Dr.Jit and the other packages (a minute or two) ...")
    pip = [str(venv / "bin" / "python"), "-m", "pip", "--disable-pip-version-check"]
    if run([*pip, "install", "--quiet", "--no-input", "-e", ".[test]"], cwd=root) != 0:
        raise SetupFailure(
            "the packages could not be installed (pip's message is above).\n"
            "Check the network and pip's index, then run psdr again; or by hand:\n"
            f"  cd {root} && .venv/bin/python -m pip install -e '.[test]'"
        )


def set_up(root: Path, key: str) -> None:
    """Bring the environment of the checkout `root` to completion."""
    venv = root / ".venv"
    (venv / STAMP).unlink(missing_ok=True)
    if not is_complete(venv, PACKAGES, key):
        if only_project_changed(venv, key):
            say("pyproject.toml has changed; updating the packages")
        else:
            make_environment(venv)
        (venv / PACKAGES).unlink(missing_ok=True)
        install_packages(root, venv)
        write_stamp(venv, PACKAGES, key)
    python = str(venv / "bin" / "python")
    status = run([python, __file__, "--llvm"], cwd=root)
    if status != 0:
        raise SystemExit(status)  # it has said why
    write_stamp(venv, STAMP, key)


def only_project_changed(venv: Path, key: str) -> bool:
    """Whether the packages were complete for this checkout and Python, but another pyproject.toml.

    The key is "psdr <format> <checksum> <size> <root>"; what follows the size must agree.
    """
    try:
        written = (venv / PACKAGES).read_text()
    except OSError:
        return False
    same = written.split(" ", 4)[4:] == stamp_text(venv, key).split(" ", 4)[4:]
    return same and has_pip(venv / "bin" / "python")


def provide_llvm() -> int:
    """Last step, inside the environment: choose an LLVM or fetch one."""
    from psdr_jit.errors import SetupError
    from psdr_jit.setup import drjit_libraries, llvm

    say("looking for an LLVM that compiles Dr.Jit's kernels ...")
    try:
        drjit_libraries.provide_missing()
        choice = llvm.ensure_llvm(fetch=True)
    except SetupError as error:
        print(f"psdr: error: {error}", file=sys.stderr)
        return SETUP_MISSING
    say(f"using LLVM {choice.version}: {choice.path}")
    return 0


def main(argv: list[str]) -> int:
    """Run the set-up; exit status 0, 3 (something is missing) or 130 (interrupted)."""
    try:
        if argv == ["--llvm"]:
            return provide_llvm()
        root, key = Path(argv[0]), argv[1]
        with exclusive(root):
            if not is_complete(root / ".venv", STAMP, key):
                set_up(root, key)
        return 0
    except (SetupFailure, OSError) as error:
        print(f"psdr: error: {error}", file=sys.stderr)
        return SETUP_MISSING
    except KeyboardInterrupt:
        say("interrupted; the next run continues the set-up")
        return 130


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
