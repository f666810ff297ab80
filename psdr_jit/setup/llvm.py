"""Find a libLLVM that really compiles Dr.Jit's kernels, remember it, and hand it to Dr.Jit.

Dr.Jit brings no LLVM: it loads the file named by DRJIT_LIBLLVM_PATH, or the first one it meets, and a bad
one aborts the process while compiling. So libraries are tried newest first, each in a child process
(`llvm_probe`), and the verdict is kept in one small file of the environment. A path that the user set is
respected, never replaced. Nothing here imports drjit or mitsuba.
"""

from __future__ import annotations

import ctypes
import glob
import json
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from psdr_jit.errors import SetupError
from psdr_jit.setup import llvm_fetch

VARIABLE = "DRJIT_LIBLLVM_PATH"
CHOICE_FILE = "psdr-llvm.json"
USER_FILE = "psdr-llvm-user.json"  # the last good verdict on a path that the user named
PROBING = "PSDR_PROBING"  # set in a probe, which has to find out by itself what is missing
PROBE_SECONDS = 180.0  # a probe takes about 1 s; a loaded machine may need much longer

PATTERNS = (
    "/usr/lib/*-linux-gnu*/libLLVM*.so*",
    "/usr/lib/llvm*/lib/libLLVM*.so*",
    "/usr/lib/llvm/*/lib*/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib64/llvm*/lib*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/local/lib*/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
    "C:/Program Files/LLVM/bin/LLVM-C.dll",
)


HOOK_MODULE = "psdr_llvm_startup"
HOOK = f'''"""Written by psdr: names the LLVM that passed its probe, after loading what that one lacks."""

import os

*PRELOAD, LIBRARY = {{paths!r}}
if (
    os.environ.get("{VARIABLE}", LIBRARY) == LIBRARY
    and "{PROBING}" not in os.environ
    and all(map(os.path.exists, [*PRELOAD, LIBRARY]))
):
    if PRELOAD:
        import ctypes

        for path in PRELOAD:
            ctypes.CDLL(path)
    os.environ["{VARIABLE}"] = LIBRARY
'''


@dataclass(frozen=True)
class Choice:
    """A library that passed the probe, with what makes the verdict stale and what it needs loaded first."""

    path: str
    version: str
    mtime: float
    drjit: str  # version it was probed with
    preload: tuple[str, ...]  # dependencies that the system lacks, in load order


@dataclass(frozen=True)
class Verdict:
    """Outcome of one probe: `choice` if the library works, else the `reason` it does not."""

    path: str
    choice: Choice | None
    reason: str


def drjit_version() -> str:
    """Version of the installed drjit, without importing it."""
    import importlib.metadata  # slow to import, and `apply_saved_choice` does without

    try:
        return importlib.metadata.version("drjit")
    except importlib.metadata.PackageNotFoundError as error:
        raise SetupError("drjit is not installed; install it with: pip install mitsuba") from error


def read_choice(name: str = CHOICE_FILE) -> Choice | None:
    """The saved choice, or None if there is none or the file is unreadable."""
    try:
        fields = json.loads((llvm_fetch.state_folder() / name).read_text())
        return Choice(**{**fields, "preload": tuple(fields["preload"])})
    except (OSError, ValueError, KeyError, TypeError):
        return None  # absent, cut short, or from another version: same as no choice


def save_choice(choice: Choice, name: str = CHOICE_FILE) -> None:
    """Keep `choice` for later processes; written in one step, as two may do so at once."""
    folder = llvm_fetch.state_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=folder, delete=False) as file:
            json.dump(asdict(choice), file)
        os.chmod(file.name, 0o644)
        os.replace(file.name, folder / name)
        if name == CHOICE_FILE and folder == Path(sys.prefix) and llvm_fetch.is_own_environment():
            write_startup_hook(choice)
    except OSError:
        pass  # read-only, or an environment owned by someone else: this user probes anew each time


def write_startup_hook(choice: Choice) -> None:
    """Hand `choice` over at the start of every Python of the launcher's own environment.

    There the right LLVM must be in place even if a script sets a variant before it imports psdr_jit; Dr.Jit
    would otherwise take the first library it meets.
    """
    import sysconfig

    packages = Path(sysconfig.get_path("purelib"))
    (packages / f"{HOOK_MODULE}.py").write_text(HOOK.format(paths=(*choice.preload, choice.path)))
    (packages / f"{HOOK_MODULE}.pth").write_text(f"import {HOOK_MODULE}\n")


def is_fresh(choice: Choice) -> bool:
    """Whether the library and drjit are still those that were probed together."""
    return choice.mtime == modified(choice.path) and choice.drjit == drjit_version()


def modified(path: str) -> float:
    """Modification time of `path`; 0 for a name that only the loader can resolve."""
    return os.path.getmtime(path) if os.path.exists(path) else 0.0


def apply_saved_choice() -> Choice | None:
    """Hand the saved library to Dr.Jit if the user named no other; return it if so.

    Called at `import psdr_jit`: costs one small file, and loads the dependencies that the system lacks so
    that Dr.Jit's dlopen finds them by SONAME (LD_LIBRARY_PATH is read at process start only).
    """
    choice = read_choice()
    if choice is None or os.environ.get(VARIABLE, choice.path) != choice.path:
        return None
    try:
        for library in choice.preload:
            ctypes.CDLL(library)
    except OSError:
        return None  # half of it is gone; `ensure_llvm` and `psdr doctor` search again
    os.environ[VARIABLE] = choice.path
    return choice


def major_version(path: str) -> int:
    """LLVM's major version by the file's name, else its folder's; 0 if neither tells.

    Debian: libLLVM-15.so.1, libLLVM.so.19.1. Ubuntu: llvm-18/lib/libLLVM.so.1, whose 1 is not the version.
    """
    name = os.path.basename(path)
    found = re.search(r"libLLVM-(\d+)", name) or re.search(r"\.so\.(\d\d+)", name)
    folders = re.findall(r"llvm[-@/]?(\d+)", os.path.dirname(path))
    return int(found.group(1) if found else (folders or [0])[-1])


def candidates() -> list[str]:
    """Every libLLVM on this machine, newest first, each file once."""
    fetched = [f"{llvm_fetch.library_folder()}/*/libLLVM*.so*"]
    prefix = [f"{sys.prefix}/lib/libLLVM*.so*", f"{sys.prefix}/lib/libLLVM*.dylib"]
    found = [path for pattern in (*PATTERNS, *prefix, *fetched) for path in sorted(glob.glob(pattern))]
    unique = dict.fromkeys(os.path.realpath(path) for path in found)
    return sorted(unique, key=major_version, reverse=True)


def probe(path: str) -> Verdict:
    """Compile and run a kernel with the library `path` in a child process."""
    version = drjit_version()
    script = Path(__file__).with_name("llvm_probe.py")
    # A private kernel cache: a kernel compiled by another LLVM must not be taken from the user's.
    with tempfile.TemporaryDirectory(prefix="psdr-probe-") as cache:
        environment = {**os.environ, VARIABLE: path, PROBING: "1", "DRJIT_CACHE_DIR": cache, "LC_ALL": "C"}
        command = [sys.executable, str(script), path]
        if llvm_fetch.library_folder() in Path(path).parents:  # what it lacks was fetched along with it
            command.append(str(Path(path).parent))
        try:
            child = subprocess.run(
                command, env=environment, cwd=cache, capture_output=True, text=True, timeout=PROBE_SECONDS
            )
        except subprocess.TimeoutExpired:
            return Verdict(path, None, f"no answer within {PROBE_SECONDS:.0f} s")
    if child.returncode != 0:
        return Verdict(path, None, failure_reason(child.returncode, child.stderr))
    answer = json.loads(child.stdout.splitlines()[-1])
    choice = Choice(path, answer["version"], modified(path), version, tuple(answer["preload"]))
    return Verdict(path, choice, "compiled and ran a kernel")


def failure_reason(returncode: int, stderr: str) -> str:
    """One line that says why the child failed: LLVM's own error, or the last thing it printed."""
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    fatal = [re.sub(r" 0x[0-9a-f]+[:,]?", "", line) for line in lines if "LLVM ERROR" in line]
    missing = [line for line in lines if "cannot open shared object" in line]
    text = (fatal or missing or lines[-1:] or ["no message"])[0][:120]
    return f"aborts while compiling ({text})" if returncode < 0 else text


def try_candidates() -> tuple[Choice | None, list[Verdict]]:
    """Probe this machine's libraries, newest first, until one passes."""
    verdicts: list[Verdict] = []
    for path in candidates():
        if 0 < major_version(path) < llvm_fetch.OLDEST_MAJOR:
            reason = f"too old, Dr.Jit needs LLVM {llvm_fetch.OLDEST_MAJOR} or newer"
            verdicts.append(Verdict(path, None, reason))
            continue
        verdicts.append(probe(path))
        if verdicts[-1].choice is not None:
            return verdicts[-1].choice, verdicts
    return None, verdicts


def accept_fetched(path: str) -> Choice | None:
    """Probe a fetched library, saying why it is turned down."""
    verdict = probe(path)
    if verdict.choice is None:
        llvm_fetch.say(f"{os.path.basename(path)} does not work here: {verdict.reason}")
    return verdict.choice


def user_path() -> str | None:
    """The library that the user named in the environment; None if we put it there, or nobody did."""
    named, saved = os.environ.get(VARIABLE), read_choice()
    return None if not named or (saved is not None and saved.path == named) else named


def ensure_llvm(fetch: bool | None = None) -> Choice:
    """Make sure that this process will use a working LLVM, or raise a `SetupError` that says what to do.

    `fetch` allows a download where the system has none that works; by default only in the environment that
    the launcher made, because it is ours to change.
    """
    named = user_path()
    if named:
        return accept_user_path(named)
    choice = apply_saved_choice()
    if choice is not None and is_fresh(choice):
        return choice
    choice, verdicts = try_candidates()
    if choice is None and (llvm_fetch.is_own_environment() if fetch is None else fetch):
        choice = llvm_fetch.fetch(accept_fetched)
    if choice is None:
        raise SetupError(no_llvm_message(verdicts))
    save_choice(choice)
    os.environ.pop(VARIABLE, None)
    apply_saved_choice()
    os.environ[VARIABLE] = choice.path  # also where the choice could not be saved
    return choice


def accept_user_path(path: str) -> Choice:
    """Probe the library that the user named; never fall back to another behind the user's back."""
    saved = read_choice(USER_FILE)
    if saved is not None and saved.path == path and is_fresh(saved):
        return saved
    verdict = probe(path)
    if verdict.choice is None:
        raise SetupError(
            f"{VARIABLE}={path} does not work: {verdict.reason}\n"
            f"  unset {VARIABLE} to let psdr choose, or point it at another libLLVM"
        )
    save_choice(verdict.choice, USER_FILE)
    return verdict.choice


def no_llvm_message(verdicts: list[Verdict]) -> str:
    """What was tried and the command that helps."""
    tried = [f"  {v.path}: {v.reason}" for v in verdicts] or ["  no libLLVM was found on this machine"]
    return "\n".join(["no LLVM that works for Dr.Jit", *tried, *llvm_fetch.advice()])
