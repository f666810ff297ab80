"""Work on many machines: Dask `distributed` hands it out, this room says what a worker needs and what may go wrong.

    pip install '.[cluster]'    # in a clone; the same versions everywhere; others are refused by name

Processes of one machine need nothing else: `psdr gradient ... --workers 2`, `psdr optimize ... --workers 2`, or

    with psdr_jit.cluster.engine.local(2) as client:        # under `if __name__ == "__main__":`
        source = psdr_jit.SceneFile("scenes/cbox.xml", {"res": 64})
        psdr_jit.gradient(scene, "small-box.vertex_positions", (1, 0, 0), client=client, source=source)

where `scene` was loaded from that file with these defaults; what was changed in it since is sent along. So do
`check_gradient` and `optimize`. Any other client of Dask will do: README.md in this folder tells how to start them on
several machines, with TLS, by SLURM and by Kubernetes. Workers read the scene file under the same path, or get it with
`--send`, `SceneFile(..., send=True)`.

A worker that dies is replaced, its unit of work is done by another one, and the result is the same: sums are taken in a
fixed order. A scheduler that dies, versions that differ, files that are missing are typed errors that name the machine.
"""
