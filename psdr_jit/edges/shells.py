"""Which side of a mesh is outside? Closed, consistently wound components have one; open surfaces do not."""

from __future__ import annotations

import numpy as np

from .topology import EdgeTopology, connected_components


def edge_shells(topology: EdgeTopology, positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(E,) float32: is the surface at each edge a closed shell with its normals outward (+1), inward (−1), or open (0)?

    A mesh may hold several components; each is judged alone, by its signed volume. Open means: it has a border,
    or neighbouring faces are wound against each other.
    """
    pairs = ~topology.border
    label = face_components(topology, len(faces))
    a, b, c = (np.asarray(positions, float)[faces[:, k]] - np.mean(positions, axis=0) for k in range(3))
    volume = np.bincount(label, weights=np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=len(faces))
    against = pairs & ((topology.corner1[:, 1] + 1) % 3 != topology.corner1[:, 0])
    open_component = np.zeros(len(faces), bool)
    open_component[label[topology.f0[topology.border | against]]] = True
    of_edge = label[topology.f0]
    return np.where(open_component[of_edge], 0, np.sign(volume[of_edge])).astype(np.float32)


def face_components(topology: EdgeTopology, faces: int) -> np.ndarray:
    """(F,) smallest face of the connected surface that each face belongs to."""
    f0, f1 = (f[~topology.border].astype(np.int64) for f in (topology.f0, topology.f1))
    return connected_components(faces, f0, f1)
