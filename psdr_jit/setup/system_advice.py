"""The exact command that provides a missing piece on this system. Standard library only."""

from __future__ import annotations

import platform
import sys
from pathlib import Path

# what is missing -> package manager family -> command
COMMANDS = {
    "llvm": {
        "debian": "sudo apt-get update && sudo apt-get install {llvm}",
        "fedora": "sudo dnf install llvm-libs",
        "suse": "sudo zypper install llvm",
        "arch": "sudo pacman -S llvm-libs",
        "macos": "brew install llvm",
        "windows": "winget install LLVM.LLVM",
        "other": "your system's package of LLVM 16 or newer",
    },
    "venv": {
        "debian": "sudo apt-get update && sudo apt-get install python{py}-venv",
        "fedora": "sudo dnf install python3 python3-pip",
        "suse": "sudo zypper install python3 python3-pip",
        "arch": "sudo pacman -S python python-pip",
        "macos": "brew install python",
        "windows": "winget install Python.Python.3.12",
        "other": "your system's package of Python 3.10 or newer with venv and ensurepip",
    },
    "libatomic": {
        "debian": "sudo apt-get update && sudo apt-get install libatomic1",
        "fedora": "sudo dnf install libatomic",
        "suse": "sudo zypper install libatomic1",
        "arch": "sudo pacman -S gcc-libs",
        "other": "your system's package that contains libatomic.so.1",
    },
}

FAMILIES = {
    "debian": {"debian", "ubuntu"},
    "fedora": {"fedora", "rhel", "centos"},
    "suse": {"suse", "opensuse"},
    "arch": {"arch"},
}


def family() -> str:
    """Which family of `COMMANDS` describes this system, from the platform or /etc/os-release."""
    if sys.platform == "darwin":
        return "macos"
    if sys.platform == "win32":
        return "windows"
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return "other"
    names = {release.get("ID", ""), *release.get("ID_LIKE", "").split()}
    names |= {name.split("-", 1)[0] for name in names}
    return next((key for key, ids in FAMILIES.items() if ids & names), "other")


def install_command(piece: str, llvm_package: str = "libllvm19") -> str:
    """Command line for `piece` (a key of `COMMANDS`); `llvm_package` is the newest that apt knows."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    # A Python outside the system's folders (pyenv, /usr/local) has no package of its own.
    python = version if Path(f"/usr/bin/python{version}").exists() else "3"
    commands = COMMANDS[piece]
    return commands.get(family(), commands["other"]).format(py=python, llvm=llvm_package)
