"""Two runs in one folder: the second is told who is there; what a dead one has left is taken over."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys

import pytest
from inverse_problems import problem_of, write_config

from psdr_jit.cli import main
from psdr_jit.errors import LockedError, StorageError
from psdr_jit.inverse import lock, loop

HOLDER = """
import sys, time
from pathlib import Path
from psdr_jit.inverse import lock
with lock.held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def other(tmp_path):
    """Another process that is at work in the folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path / "out")], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_the_second_is_told_who_is_there(llvm, tmp_path, other, capsys):
    config = write_config(tmp_path, 2)
    for options in ([], ["--resume"]):
        assert main.main(["optimize", str(config), "--out", str(tmp_path / "out"), "--quiet", *options]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"process {other.pid} on {socket.gethostname()}, since 2" in line and "choose another folder" in line
    with pytest.raises(LockedError, match=rf"process {other.pid} on .* since \d{{4}}-\d\d-\d\d \d\d:\d\d"):
        loop.run(problem_of(iterations=2), tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [lock.NAME]


def test_the_lock_of_a_dead_process_is_taken_over(llvm, tmp_path, other):
    other.kill()
    other.wait()
    assert (tmp_path / "out" / lock.NAME).is_file()  # as SIGKILL leaves it
    result = loop.run(problem_of(iterations=2), tmp_path / "out")
    assert result.status == "finished" and not (tmp_path / "out" / lock.NAME).exists()


def test_the_folder_is_locked_while_a_run_is_at_work(llvm, tmp_path):
    seen = []

    def progress(*_):
        seen.append((tmp_path / lock.NAME).read_text())
        with pytest.raises(LockedError, match=f"process {os.getpid()} "):
            loop.run(problem_of(iterations=1), tmp_path)
        with pytest.raises(LockedError):
            loop.require_folder(tmp_path, resume=True)

    problem = problem_of(iterations=2)
    loop.run(problem, tmp_path, progress=progress)
    assert len(seen) == 2 and re.fullmatch(r"process \d+ on \S+, since [-0-9 :]+\n", seen[0])
    assert not (tmp_path / lock.NAME).exists()
    assert loop.run(problem, tmp_path, resume=True).status == "finished"  # free again


def test_an_error_frees_the_folder(tmp_path):
    with pytest.raises(StorageError), lock.held(tmp_path):
        raise StorageError("no room")
    assert not list(tmp_path.iterdir())
    with lock.held(tmp_path), pytest.raises(LockedError):
        lock.require_free(tmp_path)
    lock.require_free(tmp_path)
    lock.require_free(tmp_path / "missing")
