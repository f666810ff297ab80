"""apt without root: its own state folder, `apt-get update` and `download` into it, unpack by `dpkg-deb -x`.

apt's sources, keys and proxies stay those of the system; only the folders it writes to are ours. Nothing is
installed: the caller picks files out of the unpacked tree. Standard library only, because the set-up also
uses it before any package is there (see `psdr_jit.cli.setup_env`).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

TOOLS = ("apt-get", "apt-cache", "dpkg-deb")

# Present on every Debian, and tied to the running C library: a second copy would do harm.
BASE_PACKAGES = re.compile(r"(libc6|libc-bin|libcrypt1|libgcc-s1|libgcc1|libstdc\+\+6)$")

# The hooks under APT::Update are written for root (they refresh caches of other programs) and would fail
# for an ordinary user. Locks guard the system's folders only, which we do not touch. The list of installed
# packages is empty: an installed version that is no longer in the archives must not be asked for.
CONFIG = """\
#clear APT::Update;
Dir::State "{work}/state";
Dir::State::lists "{work}/state/lists";
Dir::State::status "{work}/state/status";
Dir::Cache "{work}/cache";
Acquire::Languages "none";
Acquire::Retries "2";
APT::Sandbox::User "root";
Debug::NoLocking "true";
"""


class AptError(RuntimeError):
    """apt or dpkg-deb could not do what was asked; the message holds their last lines."""


def is_available() -> bool:
    """Whether this system has the three tools, i.e. is a Debian or one of its descendants."""
    return all(shutil.which(tool) for tool in TOOLS)


def run_tool(command: list[str], cwd: Path | None = None) -> str:
    """Run one tool in the C locale and return its standard output."""
    environment = {**os.environ, "LC_ALL": "C"}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        tail = "\n".join((done.stderr.strip() or done.stdout.strip()).splitlines()[-4:])
        raise AptError(f"{' '.join(command[:1] + command[3:5])} failed: {tail}")
    return done.stdout


def update(work: Path) -> Path:
    """Fetch the package lists into `work`; return the configuration file that the other calls take.

    A source that fails (an unreachable third-party archive) is tolerated: whether the lists suffice shows
    when a package is looked up.
    """
    for folder in ("state/lists/partial", "cache/archives/partial"):
        (work / folder).mkdir(parents=True, exist_ok=True)
    (work / "state/status").touch()
    config = work / "apt.conf"
    config.write_text(CONFIG.format(work=work))
    problem = "apt-get update reached no archive; is there a network?"
    try:
        run_tool(["apt-get", "-c", str(config), "-q", "update"])
    except AptError as error:
        problem = str(error)
    if not any((work / "state/lists").glob("*_Packages*")):
        raise AptError(problem)
    return config


def package_names(config: Path | None, pattern: str) -> list[str]:
    """Names of the packages that match `pattern`, by our lists or (`config` None) by the system's own."""
    options = ["-c", str(config)] if config else []
    lines = run_tool(["apt-cache", *options, "search", "--names-only", pattern]).splitlines()
    return [line.split()[0] for line in lines if line.strip()]


def with_dependencies(config: Path, package: str) -> list[str]:
    """`package` and all libraries it depends on, without those that every Debian has.

    apt-cache prints dependants unindented; `<name>` is a virtual package and `name:arch` a foreign one.
    """
    skip = [f"--no-{kind}" for kind in "recommends suggests conflicts breaks replaces enhances".split()]
    text = run_tool(["apt-cache", "-c", str(config), "depends", "--recurse", *skip, package])
    names = [line.strip() for line in text.splitlines() if line[:1].isalnum()]
    libraries = [n for n in names if re.match(r"lib|zlib", n) and ":" not in n and not BASE_PACKAGES.match(n)]
    return sorted({package, *libraries})


def unpack(config: Path, packages: list[str], into: Path) -> None:
    """Download `packages` and unpack them into the folder `into`."""
    archives = into / "archives"
    archives.mkdir(parents=True, exist_ok=True)
    run_tool(["apt-get", "-c", str(config), "-q", "download", *packages], cwd=archives)
    for archive in sorted(archives.glob("*.deb")):
        run_tool(["dpkg-deb", "-x", str(archive), str(into)])
    shutil.rmtree(archives)


def collect_libraries(tree: Path, folder: Path) -> Path:
    """Move the shared libraries of an unpacked tree into one flat folder, keeping their SONAME links.

    A link that leads to another folder is dropped: its target arrives under its own name.
    """
    folder.mkdir()
    for path in [*tree.glob("usr/lib/**/*.so*"), *tree.glob("lib/**/*.so*")]:
        if path.is_symlink() and "/" in os.readlink(path):
            continue
        if path.is_symlink() or path.is_file():
            os.replace(path, folder / path.name)
    return folder
