"""A disk that takes nothing more: what is there is whole, and the run says that its values are missing."""

from __future__ import annotations

import errno
import json
import os
import subprocess

import numpy as np
import pytest
from inverse_problems import BOX, problem_of, write_config
from variants import also

from psdr_jit.cli import main
from psdr_jit.inverse import journal, loop

BLOCK = 4096  # bytes that a tmpfs hands out at a time
VALUES = {"final.npz", "blocker.ply", "result.json"}


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a disk of 512 KiB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", folder], capture_output=True)
    if made.returncode != 0:
        pytest.skip("file systems cannot be mounted here")
    yield folder
    subprocess.run(["umount", folder], check=True)


def fill(folder, leave=0):
    """Take all room but `leave` blocks."""
    (folder / "filler").unlink(missing_ok=True)
    free = os.statvfs(folder).f_bavail * os.statvfs(folder).f_frsize // BLOCK
    (folder / "filler").write_bytes(bytes(BLOCK * max(0, free - leave)))


def require_whole(folder):
    """No file is empty, half written or temporary."""
    for path in folder.rglob("*"):
        assert path.is_dir() or path.stat().st_size > 0, path
        assert not path.name.startswith("."), path
    if (folder / "final.npz").exists():
        with np.load(folder / "final.npz") as values:
            assert values[BOX].shape == (24, 3)
    if (folder / "result.json").exists():
        json.loads((folder / "result.json").read_text())


def test_a_disk_that_is_full_at_the_end(llvm, small_disk):
    problem = problem_of(iterations=2)
    with pytest.warns(RuntimeWarning, match="No space left"):
        result = loop.run(problem, small_disk / "out", progress=lambda *_: fill(small_disk))
    assert result.status == "finished" and set(result.lost) == VALUES <= set(result.not_written)
    assert all(name in said and "No space left" in said for name, said in result.lost.items())
    require_whole(small_disk / "out")
    os.unlink(small_disk / "filler")
    again = loop.run(problem, small_disk / "out", resume=(small_disk / "out" / "checkpoint.npz").exists())
    assert not again.lost and VALUES <= {path.name for path in (small_disk / "out").iterdir()}


@pytest.mark.parametrize("leave", [0, also(1), also(2), also(3), 4])
def test_a_disk_that_is_nearly_full_at_the_end(llvm, small_disk, leave):
    """Whatever of the last files still finds room is whole."""
    problem = problem_of(iterations=1)
    result = loop.run(problem)
    out = small_disk / "out"
    kept = journal.Journal(out, problem, keep=0)
    kept.picture(problem, problem.start())
    fill(small_disk, leave)
    with pytest.warns(RuntimeWarning, match="No space left"):
        kept.finish(problem, result)
    kept.close()
    require_whole(out)
    assert set(kept.lost) == VALUES - {path.name for path in out.iterdir()} and len(kept.lost) >= 3 - leave


def test_a_disk_that_is_full_at_the_start(llvm, small_disk, capsys):
    config = write_config(small_disk, 2)
    fill(small_disk)
    assert main.main(["optimize", str(config), "--out", str(small_disk / "out"), "--quiet"]) == 3
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "No space left" in said[0]
    assert not list((small_disk / "out").rglob("*.*"))


class Disk:
    """Refuses the n-th file that is flushed to it, or all from the n-th on."""

    def __init__(self, monkeypatch, refused):
        self.count, self.refused = 0, refused
        flush = os.fsync

        def fsync(handle):
            self.count += 1
            if self.refused(self.count):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            flush(handle)

        monkeypatch.setattr(os, "fsync", fsync)


@pytest.mark.slow  # the real full disks above are not
def test_each_write_in_turn(llvm, tmp_path, monkeypatch, capsys):
    """The command ends with status 3 exactly if a file with final values is missing, and names it in one line."""
    config = write_config(tmp_path, 1)
    with monkeypatch.context() as patch:
        disk = Disk(patch, lambda k: False)
        assert main.main(["optimize", str(config), "--out", str(tmp_path / "all"), "--quiet"]) == 0
    written = disk.count
    everything = {path.name for path in (tmp_path / "all").iterdir()}
    assert written >= len(everything) - 1  # all but the folder of snapshots
    capsys.readouterr()
    statuses = []
    for k in range(1, written + 1):
        out = tmp_path / str(k)
        with monkeypatch.context() as patch:
            Disk(patch, lambda count, k=k: count == k)
            statuses.append(main.main(["optimize", str(config), "--out", str(out), "--quiet"]))
        said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("psdr: error: ")]
        require_whole(out)
        missing = VALUES - {path.name for path in out.iterdir()}
        if statuses[-1] == 3 and k > 1:
            (name,) = missing
            assert len(said) == 1 and f"'{out / name}'" in said[0] and "--resume" in said[0]
        elif k > 1:
            assert statuses[-1] == 0 and not missing and not said
    assert statuses[0] == 3 and statuses.count(3) == 1 + len(VALUES)  # the log cannot even be begun; then the values


def test_everything_from_some_write_on(llvm, tmp_path, monkeypatch, capsys):
    config = write_config(tmp_path, 1)
    out = tmp_path / "out"
    Disk(monkeypatch, lambda count: count > 1)
    assert main.main(["optimize", str(config), "--out", str(out), "--quiet"]) == 3
    said = capsys.readouterr().err
    assert "final.npz' could not be written: No space left on device" in said and "run it again" in said
    require_whole(out)
