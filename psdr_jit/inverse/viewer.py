"""A Rerun viewer on this machine: the one that runs, or a new one that only this machine can reach.

Rerun's own `spawn` listens on every network interface, and says nothing of a viewer that finds no display.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sysconfig
import tempfile
import time

from psdr_jit.errors import SetupError

LOOPBACK, PORT = "127.0.0.1", 9876  # where Rerun's viewers listen
ADDRESS = f"rerun+http://{LOOPBACK}:{PORT}/proxy"
PATIENCE = 20.0  # seconds for a viewer to start
SETTLED = 2.0  # seconds that it must live: it listens before it looks for a display
POLL = 0.1  # seconds
WAYS_OUT = ("write a file with --rerun FILE.rrd and open it with `rerun FILE.rrd`; or run "
            f"`rerun --serve-web --bind {LOOPBACK}` first, whose pages need no display here")  # fmt: skip


def require_viewer() -> None:
    """Raise `SetupError` unless a viewer listens, now or after it has been started."""
    if _listens():
        return
    scripts = sysconfig.get_path("scripts")  # where pip puts the viewer, which may not be searched
    program = shutil.which("rerun", path=os.pathsep.join([scripts, os.environ.get("PATH", os.defpath)]))
    if program is None:
        raise SetupError(f"the program `rerun` is missing, which comes with the package rerun-sdk: {WAYS_OUT}")
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen([program, "--bind", LOOPBACK, "--port", str(PORT)], stdin=subprocess.DEVNULL,
                                   stdout=said, stderr=said, start_new_session=True)  # fmt: skip
        begin, since = time.monotonic(), None
        while process.poll() is None and time.monotonic() - begin < PATIENCE:
            since = since or (time.monotonic() if _listens() else None)
            if since is not None and time.monotonic() - since > SETTLED:
                return
            time.sleep(POLL)
        process.terminate()
        said.seek(0)
        lines = [line for line in said.read().decode(errors="replace").splitlines() if line.startswith("Error")]
    cause = lines[-1] if lines else "it does not answer"
    raise SetupError(f"no Rerun viewer could be opened here ({cause}): {WAYS_OUT}")


def _listens() -> bool:
    with socket.socket() as probe:
        probe.settimeout(POLL)
        return probe.connect_ex((LOOPBACK, PORT)) == 0
