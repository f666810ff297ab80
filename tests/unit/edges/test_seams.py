"""Charts of faces: what lies between seams, and how it is halved where both sides of a seam hang together."""

from __future__ import annotations

import numpy as np
import pytest

from psdr_jit.edges.seams import face_charts
from psdr_jit.edges.topology import build_edge_topology


def tube(around: int, along: int):
    """An open tube of `around` · `along` squares in two halves each: positions and faces."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around), np.arange(along + 1), indexing="ij"))
    turn = 2 * np.pi * i / around
    points = np.stack([np.cos(turn), np.sin(turn), j / along], 1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around), np.arange(along), indexing="ij"))

    def at(di, dj):
        return (i + di) % around * (along + 1) + j + dj

    faces = np.stack([np.stack([at(0, 0), at(1, 0), at(1, 1)], 1), np.stack([at(0, 0), at(1, 1), at(0, 1)], 1)], 1)
    return points, faces.reshape(-1, 3)


def charted(points, faces, chosen):
    """`(topology, seams, charts)`, with the edges as seams whose end points `chosen` accepts."""
    topology = build_edge_topology(points, faces)
    seam = chosen(points[topology.v0], points[topology.v1]) & ~topology.border
    return topology, seam, face_charts(topology, seam, len(faces))


def false_borders(topology, seam, label) -> int:
    """Edges between different charts that are no seams."""
    inner = ~topology.border & ~seam
    return int(np.count_nonzero(label[topology.f0[inner]] != label[topology.f1[inner]]))


def assert_parted(topology, seam, label):
    assert seam.any() and (label[topology.f0[seam]] != label[topology.f1[seam]]).all()


def test_two_rings_around_a_tube_part_it_into_three():
    topology, seam, label = charted(*tube(12, 6), lambda p, q: (p[:, 2] == q[:, 2]) & np.isin(p[:, 2], (1 / 3, 2 / 3)))
    assert_parted(topology, seam, label)
    assert len(np.unique(label)) == 3 and false_borders(topology, seam, label) == 0


@pytest.mark.parametrize("around, along", [(12, 6), (40, 8), (8, 60)])
def test_a_seam_along_a_tube_halves_it(around, along):
    """Both of its sides hang together around the tube."""
    at_zero = lambda p, q: (p[:, 1] == 0) & (q[:, 1] == 0) & (p[:, 0] > 0)  # noqa: E731
    topology, seam, label = charted(*tube(around, along), at_zero)
    assert seam.sum() == along
    assert_parted(topology, seam, label)
    assert false_borders(topology, seam, label) < len(topology) / 4


def test_random_seams_are_parted_whatever_they_are():
    points, faces = tube(20, 20)
    rng = np.random.default_rng(3)
    for share in (0.001, 0.01, 0.1, 0.5, 1.0):
        topology, seam, label = charted(points, faces, lambda p, q, share=share: rng.random(len(p)) < share)
        if seam.any():
            assert_parted(topology, seam, label)
    assert len(np.unique(label)) == len(faces)  # every edge is a seam
