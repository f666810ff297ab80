"""The ways to start workers that psdr_jit/cluster/README.md tells: with TLS, by SLURM, by Kubernetes."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import resources
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
import pytest
from clusters import BOX, FILE

import psdr_jit
from psdr_jit.cli.main import main
from psdr_jit.cluster import engine
from psdr_jit.derivative import images
from psdr_jit.errors import ClusterError

pytestmark = pytest.mark.slow

PAGE = (Path(psdr_jit.__file__).parent / "cluster" / "README.md").read_text(encoding="utf-8")
MOVE = ["gradient", FILE, "-D", "res=16", "--wrt", BOX, "--direction", "1,0,0", "--spp", "4", "--seeds", "2", "--quiet"]
ROUNDING = 1e-5
BIN = Path(sys.executable).parent


@contextmanager
def running(*words: str, **env: str) -> Iterator[subprocess.Popen]:
    process = subprocess.Popen([str(BIN / words[0]), *words[1:]], env={**os.environ, **env},
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
    try:
        yield process
    finally:
        process.terminate()
        process.wait(timeout=60)


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind((engine.LOOPBACK, 0))
        return taken.getsockname()[1]


def shell_lines(begins: str) -> list[str]:
    """Commands of the page that begin so, continued lines in one."""
    text = PAGE.replace("\\\n", " ")
    return [re.sub(r"\s+", " ", line.split("   #")[0]).strip() for line in text.splitlines()
            if line.startswith("    ") and line.strip().startswith(begins)]  # fmt: skip


def snippet(holds: str) -> str:
    (found,) = [text for text in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if holds in text]
    return found


def assert_same(one: str, other: str) -> None:
    a, b = images.read_exr(one), images.read_exr(other)
    for name, plane in a.items():
        assert np.abs(plane - b[name]).max() <= ROUNDING * np.abs(a[name.replace("_stderr", "")]).max(), name


@pytest.fixture
def certificate(tmp_path, monkeypatch) -> dict[str, str]:
    """What the page says of keys is done; the environment variables for whoever is to have them."""
    if which("openssl") is None:
        pytest.skip("needs openssl")
    monkeypatch.chdir(tmp_path)
    (line,) = shell_lines("openssl req")
    subprocess.run(line, shell=True, check=True, capture_output=True)
    assert os.stat("psdr.key").st_mode & 0o077 == 0, "others could read the key"
    return dict(word.split("=") for line in shell_lines("export DASK_") for word in line.split()[1:])


def test_tls(certificate):
    distributed = pytest.importorskip("distributed")
    address = f"tls://{engine.LOOPBACK}:{free_port()}"
    (start,) = shell_lines("dask scheduler --protocol tls")
    (work,) = shell_lines("dask worker tls:")
    start = start.replace("10.0.0.1", engine.LOOPBACK) + f" --port {address.rpartition(':')[2]} --no-dashboard"
    work = re.sub(r"tls://\S+", address, work) + f" --nworkers 2 --host {engine.LOOPBACK} --no-dashboard"
    with running(*start.split(), **certificate), running(*work.split(), **certificate, PSDR_THREADS="2"):
        with pytest.raises(ClusterError, match="TLS.*DASK_DISTRIBUTED__COMM__TLS"):  # we have no certificate yet
            with engine.connected(address):
                pass
        assert main([*MOVE, "-o", "here.exr"]) == 0
        there = [str(BIN / "psdr"), *MOVE, "-o", "there.exr", "--scheduler", address]
        done = subprocess.run(there, env={**os.environ, **certificate}, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        key = {"tls_ca_file": "psdr.pem", "tls_client_cert": "psdr.pem", "tls_client_key": "psdr.key"}
        with distributed.Client(address, security=distributed.Security(**key)) as client:
            workers = list(client.scheduler_info(n_workers=-1)["workers"])
        assert len(workers) == 2 and all(name.startswith("tls://") for name in workers)
    assert_same("here.exr", "there.exr")


SBATCH = """#!{python}
import os, pathlib, subprocess, sys
here = pathlib.Path(__file__).parent
script = pathlib.Path(sys.argv[-1]).read_text()
(here / "scripts").open("a").write(script)
given = dict(os.environ, SLURM_CPUS_PER_TASK="2", SLURM_NTASKS="2")
job = subprocess.Popen(["bash", sys.argv[-1]], env=given, start_new_session=True, stdout=(here / "log").open("a"),
                       stderr=subprocess.STDOUT)
print("Submitted batch job", job.pid)
"""
SCANCEL = """#!{python}
import os, signal, sys
for word in sys.argv[1:]:
    if word.isdigit():
        os.killpg(int(word), signal.SIGTERM)
"""
SRUN = """#!/bin/bash
for k in $(seq "$SLURM_NTASKS"); do "$@" & done
wait
"""


@pytest.fixture
def slurm(tmp_path, monkeypatch) -> Path:
    """`sbatch`, `srun` and `scancel` that run jobs on this machine; the folder with their log."""
    folder = tmp_path / "slurm"
    folder.mkdir()
    for name, text in {"sbatch": SBATCH, "scancel": SCANCEL, "srun": SRUN}.items():
        (folder / name).write_text(text.replace("{python}", sys.executable))
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{BIN}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    return folder


def test_a_job_of_slurm(slurm, tmp_path):
    """The whole in one script: scheduler, workers, and who asks them."""
    pytest.importorskip("distributed")
    text = textwrap.dedent(re.search(r"^    #!/bin/bash\n(?:    .*\n|\n)+", PAGE, re.MULTILINE)[0])
    port = str(free_port())
    text = text.replace("$(hostname -i)", engine.LOOPBACK).replace("8786", port)
    text = re.sub(r"^psdr optimize .*$", " ".join(["psdr", *MOVE, "-o", "there.exr", "--scheduler", "$ADDRESS"]), text,
                  flags=re.MULTILINE)  # fmt: skip
    (tmp_path / "job.sh").write_text(text)
    submitted = subprocess.run(["sbatch", "job.sh"], capture_output=True, text=True, check=True).stdout
    job = int(submitted.split()[-1])
    assert main([*MOVE, "-o", "here.exr"]) == 0
    with ExitStack() as stack:
        stack.callback(subprocess.run, ["scancel", str(job)])
        for _ in range(240):
            if ended(job):
                break
            subprocess.run(["sleep", "1"])
    assert Path("there.exr").exists(), (slurm / "log").read_text()[-2000:]
    assert_same("here.exr", "there.exr")


def ended(process: int) -> bool:
    state = Path(f"/proc/{process}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z"


def test_jobs_written_by_dask_jobqueue(slurm, scene, source):
    pytest.importorskip("dask_jobqueue")
    names: dict[str, Any] = {"scene": scene, "source": source, "psdr_jit": psdr_jit}
    text = snippet("SLURMCluster").replace("jobs=16", "jobs=2")
    text = text.replace("job_cpu=8", f'job_cpu=8, interface=None, scheduler_options={{"host": "{engine.LOOPBACK}"}}')
    exec(compile(text, "README.md", "exec"), names)
    own = psdr_jit.gradient(scene, BOX, (1, 0, 0))
    assert np.abs(names["result"].total - own.total).max() <= ROUNDING * np.abs(own.total).max() > 0
    scripts = (slurm / "scripts").read_text()
    assert scripts.count("#SBATCH --cpus-per-task=8") == 2 and scripts.count("--nthreads 1 ") == 2
    assert scripts.count("export PSDR_THREADS=8") == 2


def test_what_kubernetes_gets(monkeypatch):
    """As far as one machine allows: the manifest holds what the page says, and is what the operator's schema wants."""
    operator = pytest.importorskip("dask_kubernetes.operator")
    yaml, jsonschema = pytest.importorskip("yaml"), pytest.importorskip("jsonschema")
    made: dict[str, Any] = {}

    class Cluster:
        def __init__(self, custom_cluster_spec: dict) -> None:
            made.update(custom_cluster_spec)

    monkeypatch.setattr(operator, "KubeCluster", Cluster)
    exec(compile(snippet("make_cluster_spec").split("with ")[0] + "KubeCluster(custom_cluster_spec=spec)", "x", "exec"))
    resource = "operator/deployment/helm/dask-kubernetes-operator/crds/daskcluster.yaml"
    wanted = yaml.safe_load((resources.files("dask_kubernetes") / resource).read_text(encoding="utf-8"))
    jsonschema.validate(made, wanted["spec"]["versions"][0]["schema"]["openAPIV3Schema"])
    (container,) = made["spec"]["worker"]["spec"]["containers"]
    assert container["args"][:4] == ["dask", "worker", "--nthreads", "1"]
    assert {"name": "PSDR_THREADS", "value": "8"} in container["env"]
    assert made["spec"]["scheduler"]["spec"]["containers"][0]["image"] == container["image"]
