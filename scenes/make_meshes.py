"""Makes the larger meshes and grids of these scenes: `python -m scenes.make_meshes`, in the folder above, does.

The curve along which parts of one mesh cut into each other is an edge that psdr_jit does not find. Hence no two
parts touch: each keeps a gap to all before it, or is left out. All lengths are scene units.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

MESHES = Path(__file__).parent / "meshes"
SEED = 7
GAP = 4e-3  # between parts; Mitsuba offsets rays by about 2e-4 at this distance from the origin
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Part:
    """A closed piece of a mesh, outward faces, and the chain of tapering capsules (M ends) that it stays within."""

    positions: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    axis: np.ndarray  # (M, 3)
    radii: np.ndarray  # (M,)


@dataclass(frozen=True)
class Generation:
    """How branches of one generation look, and how many grow from each branch of the generation before."""

    children: int
    length: float  # relative to the parent
    radius: float  # relative to the parent where the branch starts
    lean: float  # angle to the parent [rad]
    sides: int
    rings: int
    leaves: int  # on each branch


TRUNK_LENGTH, TRUNK_RADIUS = 1.45, 0.065
GENERATIONS = (
    Generation(1, 1.0, 1.0, 0.0, 20, 24, 0),
    Generation(10, 0.62, 0.5, 1.0, 14, 18, 0),
    Generation(6, 0.55, 0.55, 0.95, 10, 10, 3),
    Generation(4, 0.6, 0.6, 0.9, 6, 7, 6),
    Generation(3, 0.6, 0.65, 0.85, 4, 5, 5),
)
TAPER = 0.3  # radius at the tip over that at the base
MIN_RADIUS = 2.5e-3
WANDER = 0.16  # a branch's change of direction from ring to ring, times the square root of their number
ATTEMPTS = 8  # places that are tried for a part
LEAF = 0.075  # length of an average one
LEAF_RIM = np.array([(0, 0), (0.25, 0.7), (0.5, 1), (0.8, 0.6), (1, 0), (0.8, -0.6), (0.5, -1), (0.25, -0.7)])
LEAF_WIDTH, LEAF_THICKNESS, LEAF_FOLD = 0.23, 0.05, 0.3  # half width, half thickness, rise of the rim: over length

OCCLUDERS = 400
SLAB = np.array([[-1.2, -0.65, -1.2], [1.2, 0.0, 1.2]])  # corners of the box that holds their centres
OCCLUDER_RADIUS = (0.045, 0.085)  # of the circumscribed sphere
TETRAHEDRON = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3)
TETRAHEDRON_FACES = np.array([(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)])
BOX = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
BOX_FACES = np.array([
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
])  # fmt: skip

TORUS_VALUES, TORUS_RADIUS, TORUS_THICKNESS = 12, 0.29, 0.13

ELLIPSOIDS = (
    (-0.6, 0.1, 0.2, -1.0, -1.7, -2.2, 0.8, 0.0, 0.6, 0.0),
    (0.5, -0.2, 0.0, -1.4, -1.9, -1.2, 0.5, 0.5, 0.5, 0.5),
)

PROFILE_POINTS, PROFILE_RADIUS, PROFILE_HEIGHT = 100, 0.8, 0.6
PROFILE_WAVES = ((2, 0.08, 0.4), (3, 0.10, 1.0), (5, 0.12, 0.0), (8, 0.03, 2.0))  # around: count, amplitude, phase
BALL_ROUNDS, BALL_RADIUS = 3, 0.75
KNOB_ROUNDS, KNOB_RADIUS, WAIST = 4, 0.75, 0.06
BULGES = (  # direction, height, width
    ((1, 0.6, 0.3), 0.35, 0.2), ((-0.7, 0.8, -0.4), 0.25, 0.15), ((0, -0.9, 0.6), 0.3, 0.25),
)  # fmt: skip

PANE_POINTS = 33  # along a side, from -1 to 1
SMILE = (  # x, z, depth and width of bumps that gather light: two eyes, and a mouth along an arc
    *((x, -0.35, 0.006, 0.14) for x in (-0.35, 0.35)),
    *((0.55 * np.cos(t), 0.55 * np.sin(t) - 0.05, 0.0035, 0.09) for t in np.linspace(0.15 * np.pi, 0.85 * np.pi, 9)),
)


class Space:
    """The parts accepted so far; tells whether another one has room."""

    def __init__(self) -> None:
        self.parts: list[Part] = []
        self._capsules = np.zeros((0, 2, 4))  # position and radius of either end
        self._balls = np.zeros((4, 0))  # around them: centre and radius
        self._used = 0

    def add(self, part: Part) -> bool:
        """Accept `part` unless it comes closer than `GAP` to another one."""
        ends = np.concatenate([part.axis, part.radii[:, None]], axis=1)
        own = np.stack([ends[:-1], ends[1:]], axis=1)
        if self._clearance(own) < GAP:
            return False
        n = len(own)
        while self._used + n > len(self._capsules):
            room = 1024 + len(self._capsules)
            self._capsules = np.concatenate([self._capsules, np.zeros((room, 2, 4))])
            self._balls = np.concatenate([self._balls, np.zeros((4, room))], axis=1)
        self._capsules[self._used : self._used + n] = own
        self._balls[:, self._used : self._used + n] = balls(own)
        self._used += n
        self.parts.append(part)
        return True

    def _clearance(self, own: np.ndarray) -> float:
        """Smallest distance between surfaces of capsules, `own` and those that are there."""
        x, y, z, reach = self._balls[:, : self._used]
        lower = (own[..., :3] - own[..., 3:]).min((0, 1)) - GAP
        upper = (own[..., :3] + own[..., 3:]).max((0, 1)) + GAP
        near = (np.abs(x - (lower[0] + upper[0]) / 2) < (upper[0] - lower[0]) / 2 + reach).nonzero()[0]
        for k, c in ((1, y), (2, z)):
            near = near[np.abs(c[near] - (lower[k] + upper[k]) / 2) < (upper[k] - lower[k]) / 2 + reach[near]]
        a, b = balls(own)[:, :, None], self._balls[:, None, near]
        i, j = np.nonzero(np.square(a[:3] - b[:3]).sum(0) < np.square(a[3] + b[3] + GAP))
        return min(capsule_distances(own[i], self._capsules[near[j]]), default=np.inf)

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        return joined(self.parts)


def capsule_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) distances between the surfaces of pairs of tapering capsules (N, 2, 4) [Ericson 2005, 5.1.9]."""
    u, v, w = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0], a[:, 0] - b[:, 0]
    uu, vv, uv, uw, vw = (np.einsum("ij,ij->i", x[:, :3], y[:, :3])
                          for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))  # fmt: skip
    s = np.clip((uv * vw - uw * vv) / np.maximum(uu * vv - uv**2, 1e-30), 0, 1)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    x, y = a[:, 0] + s[:, None] * u, b[:, 0] + t[:, None] * v
    return np.linalg.norm(x[:, :3] - y[:, :3], axis=1) - x[:, 3] - y[:, 3]


def balls(capsules: np.ndarray) -> np.ndarray:
    """Balls (4, N) around capsules (N, 2, 4): centres and radii."""
    half = (capsules[:, 1, :3] - capsules[:, 0, :3]) / 2
    radii = np.linalg.norm(half, axis=1) + capsules[:, :, 3].max(1)
    return np.concatenate([(capsules[:, 0, :3] + half).T, radii[None]])


def joined(parts: list[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Positions and faces of one mesh of many parts."""
    first = np.cumsum([0] + [len(p.positions) for p in parts[:-1]])
    faces = [p.faces + offset for p, offset in zip(parts, first, strict=True)]
    return np.concatenate([p.positions for p in parts]), np.concatenate(faces)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def side(d: np.ndarray, azimuth: float) -> np.ndarray:
    """Unit vector perpendicular to `d`, at an angle that turns with `azimuth` [rad]."""
    u = unit(np.cross(d, np.eye(3)[np.argmin(np.abs(d))]))
    return np.cos(azimuth) * u + np.sin(azimuth) * np.cross(d, u)


def tube(axis: np.ndarray, radii: np.ndarray, sides: int) -> Part:
    """Rings around an axis (M, 3), closed by a cone at either end."""
    tangents = np.gradient(axis, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    u = side(tangents[0], 0.0)
    angle = 2 * np.pi * np.arange(sides)[:, None] / sides
    rings = []
    for x, t, r in zip(axis, tangents, radii, strict=True):
        u = unit(u - (u @ t) * t)  # carried along without a twist
        rings.append(x + r * (np.cos(angle) * u + np.sin(angle) * np.cross(t, u)))
    ends = [axis[0] - 0.7 * radii[0] * tangents[0], axis[-1] + radii[-1] * tangents[-1]]
    k = np.arange(sides)
    after, base, tip = (k + 1) % sides, len(axis) * sides, len(axis) * sides + 1
    faces = [np.stack([after, k, np.full(sides, base)], 1)]
    for row in sides * np.arange(len(axis) - 1):
        faces.append(row + np.stack([k, after, after + sides], 1))
        faces.append(row + np.stack([k, after + sides, k + sides], 1))
    last = sides * (len(axis) - 1)
    faces.append(np.stack([last + k, last + after, np.full(sides, tip)], 1))
    return Part(np.concatenate([*rings, ends]), np.concatenate(faces), axis, radii)


def leaf(base: np.ndarray, d: np.ndarray, facing: np.ndarray, length: float) -> Part:
    """Two fans over one folded rim: a closed lens that points along `d`, its upper face towards `facing`."""
    normal = unit(facing - (facing @ d) * d)
    frame = length * np.stack([d, np.cross(normal, d), normal])
    along, across = LEAF_RIM.T
    rim = np.stack([along, LEAF_WIDTH * across, LEAF_WIDTH * LEAF_FOLD * np.abs(across)], 1)
    centres = np.array([(0.5, 0, LEAF_THICKNESS), (0.5, 0, -LEAF_THICKNESS)])
    n = len(rim)
    k, after = np.arange(n), (np.arange(n) + 1) % n
    faces = np.concatenate([np.stack([after, k, np.full(n, n)], 1), np.stack([k, after, np.full(n, n + 1)], 1)])
    axis = base + np.array([0, 0.25, 0.5, 0.8, 1.0])[:, None] * length * d
    width = LEAF_WIDTH * length * np.array([0.1, 0.8, 1.05, 0.75, 0.1])
    return Part(base + np.concatenate([rim, centres]) @ frame, faces, axis, width)


def branch(rng, start: np.ndarray, d: np.ndarray, length: float, radius: float, g: Generation) -> Part:
    """A tapering tube that wanders and bends upwards."""
    steps = g.rings - 1
    axis = [start]
    for _ in range(steps):
        d = unit(d + WANDER / np.sqrt(steps) * rng.normal(size=3) + 0.25 / steps * UP)
        axis.append(axis[-1] + length / steps * d)
    radii = np.maximum(radius * np.linspace(1, TAPER, g.rings), MIN_RADIUS)
    return tube(np.array(axis), radii, g.sides)


def on(parent: Part, t: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Point, direction and radius of a branch at the fraction `t` of its rings."""
    k = t * (len(parent.axis) - 1)
    i = min(int(k), len(parent.axis) - 2)
    x = parent.axis[i] + (k - i) * (parent.axis[i + 1] - parent.axis[i])
    return x, unit(parent.axis[i + 1] - parent.axis[i]), float(parent.radii[i])


def grow_branches(rng, space: Space, parents: list[Part], g: Generation) -> list[Part]:
    """One more generation, each branch starting a gap away from the bark of its parent."""
    grown = []
    for parent in parents:
        size = np.linalg.norm(np.diff(parent.axis, axis=0), axis=1).sum()
        turn = 2 * np.pi * rng.random()
        for n in range(g.children):
            for _ in range(ATTEMPTS):
                t = 0.28 + 0.7 * (n + rng.random()) / g.children
                x, d, r = on(parent, t)
                out = side(d, turn + n * GOLDEN_ANGLE + 0.5 * rng.normal())
                radius = max(g.radius * r, MIN_RADIUS)
                start = x + (r + radius + 1.5 * GAP) * out
                heading = unit(np.cos(g.lean) * d + np.sin(g.lean) * out)
                length = g.length * size * (1.25 - 0.75 * t) * (0.85 + 0.3 * rng.random())
                part = branch(rng, start, heading, length, radius, g)
                if space.add(part):
                    grown.append(part)
                    break
    return grown


def grow_leaves(rng, space: Space, parents: list[Part], count: int) -> None:
    """Leaves around each branch, at a gap from it, most of them facing up."""
    for parent in parents:
        for n in range(count):
            for _ in range(ATTEMPTS):
                x, d, r = on(parent, 0.3 + 0.68 * (n + rng.random()) / count)
                out = side(d, 2 * np.pi * rng.random())
                heading = unit(0.5 * d + out + 0.3 * rng.normal(size=3))
                length = LEAF * (0.7 + 0.6 * rng.random())
                base = x + (r + 1.5 * GAP + 0.1 * LEAF_WIDTH * length) * out
                if space.add(leaf(base, heading, UP + 0.5 * rng.normal(size=3), length)):
                    break


def branching() -> tuple[np.ndarray, np.ndarray]:
    """A tree of six generations of branches, standing in the origin, and its leaves."""
    rng, space = np.random.default_rng(SEED), Space()
    trunk = branch(rng, 0.7 * TRUNK_RADIUS * UP, UP, TRUNK_LENGTH, TRUNK_RADIUS, GENERATIONS[0])
    space.add(trunk)
    tree = [[trunk]]
    for g in GENERATIONS[1:]:
        tree.append(grow_branches(rng, space, tree[-1], g))
    for branches, g in zip(tree, GENERATIONS, strict=True):
        grow_leaves(rng, space, branches, g.leaves)
    return space.mesh()


def random_rotation(rng) -> np.ndarray:
    """Uniformly distributed 3 x 3 rotation, from a unit quaternion."""
    w, x, y, z = unit(rng.normal(size=4))
    cross = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def occluders() -> tuple[np.ndarray, np.ndarray]:
    """Boxes and tetrahedra by turns, turned at random, within spheres that do not touch."""
    rng = np.random.default_rng(SEED)
    parts, centres, radii = [], np.zeros((0, 3)), np.zeros(0)
    while len(parts) < OCCLUDERS:
        x, r = rng.uniform(*SLAB), rng.uniform(*OCCLUDER_RADIUS)
        if np.any(np.linalg.norm(centres - x, axis=1) < radii + r + GAP):
            continue
        sides = unit(rng.uniform(0.4, 1, size=3))
        corners, faces = (TETRAHEDRON, TETRAHEDRON_FACES) if len(parts) % 2 else (BOX * sides, BOX_FACES)
        parts.append(Part(x + r * corners @ random_rotation(rng).T, faces, x[None], np.array([r])))
        centres, radii = np.vstack([centres, x]), np.append(radii, r)
    return joined(parts)


def extruded() -> tuple[np.ndarray, np.ndarray]:
    """A prism over a rounded star of `PROFILE_POINTS` corners, closed by fans around the middle."""
    n = PROFILE_POINTS
    k, after = np.arange(n), (np.arange(n) + 1) % n
    angle = 2 * np.pi * k / n
    radius = PROFILE_RADIUS * (1 + sum(a * np.cos(w * angle + p) for w, a, p in PROFILE_WAVES))
    rim = np.stack([radius * np.cos(angle), np.zeros(n), -radius * np.sin(angle)], 1)
    low, high = rim - [0, PROFILE_HEIGHT / 2, 0], rim + [0, PROFILE_HEIGHT / 2, 0]
    middle = np.array([[0, -PROFILE_HEIGHT / 2, 0], [0, PROFILE_HEIGHT / 2, 0]])
    faces = [
        np.stack([k, after, after + n], 1), np.stack([k, after + n, k + n], 1),
        np.stack([after, k, np.full(n, 2 * n)], 1), np.stack([k + n, after + n, np.full(n, 2 * n + 1)], 1),
    ]  # fmt: skip
    return np.concatenate([low, high, middle]), np.concatenate(faces)


def icosphere(rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """The unit icosahedron with every face cut into four, so many times."""
    g = (1 + np.sqrt(5)) / 2
    p = [unit(np.array(v, float)) for v in (
        (-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g), (0, -1, -g), (0, 1, -g),
        (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1))]  # fmt: skip
    faces = [
        (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
        (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7),
        (9, 8, 1),
    ]  # fmt: skip
    for _ in range(rounds):
        middles: dict[tuple[int, int], int] = {}

        def middle(a: int, b: int, middles: dict[tuple[int, int], int] = middles) -> int:
            key = (min(a, b), max(a, b))
            if key not in middles:
                p.append(unit(p[a] + p[b]))
                middles[key] = len(p) - 1
            return middles[key]

        cut = []
        for a, b, c in faces:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            cut += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = cut
    return np.array(p), np.array(faces)


def ball() -> tuple[np.ndarray, np.ndarray]:
    """What a reconstruction starts from."""
    positions, faces = icosphere(BALL_ROUNDS)
    return BALL_RADIUS * positions, faces


def knob() -> tuple[np.ndarray, np.ndarray]:
    """A round body with three bulges and a waist, of another triangulation than `ball`."""
    d, faces = icosphere(KNOB_ROUNDS)
    d = d @ random_rotation(np.random.default_rng(SEED)).T
    bulges = sum(h * np.exp(-(1 - d @ unit(np.array(c))) / w) for c, h, w in BULGES)
    return (KNOB_RADIUS * (1 - WAIST * np.exp(-((d[:, 1] / 0.3) ** 2)) + bulges))[:, None] * d, faces


def pane() -> tuple[np.ndarray, np.ndarray]:
    """The lower side of a pane: a square sheet across y, normals down."""
    x, z = np.meshgrid(*[np.linspace(-1, 1, PANE_POINTS)] * 2, indexing="ij")
    i = np.arange(x.size).reshape(x.shape)
    a, b, c, d = i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]
    faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    return np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3), faces


def smile() -> tuple[np.ndarray, np.ndarray]:
    """A pane with bumps, under which parallel light draws a face."""
    positions, faces = pane()
    x, _, z = positions.T
    positions[:, 1] = -sum(h * np.exp(-((x - cx) ** 2 + (z - cz) ** 2) / (2 * w * w)) for cx, cz, h, w in SMILE)
    return positions, faces


def write_ply(path: Path, positions: np.ndarray, faces: np.ndarray) -> None:
    """Binary PLY: float32 positions, and triangles of int32 indices."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(positions)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    table = np.zeros(len(faces), np.dtype([("corners", "u1"), ("index", "<i4", 3)]))
    table["corners"], table["index"] = 3, faces
    path.write_bytes(header.encode("ascii") + positions.astype("<f4").tobytes() + table.tobytes())


def torus_values() -> np.ndarray:
    """Signed distances to a torus in the unit cube, (z, y, x)."""
    z, y, x = np.meshgrid(*[np.linspace(-0.5, 0.5, TORUS_VALUES)] * 3, indexing="ij")
    return np.hypot(np.hypot(x, y) - TORUS_RADIUS, z) - TORUS_THICKNESS


def write_vol(path: Path, values: np.ndarray) -> None:
    """A grid of one channel in Mitsuba's format: size along x, y and z, channels, box, float32 values."""
    header = b"VOL\x03" + np.array([1, *values.shape[::-1], 1], "<i4").tobytes()
    path.write_bytes(header + np.array([0, 0, 0, 1, 1, 1], "<f4").tobytes() + values.astype("<f4").tobytes())


def write_ellipsoids(path: Path, rows: np.ndarray) -> None:
    """Centre, logarithms of the half axes, quaternion, as Mitsuba's `ellipsoids` reads them; (K, 10)."""
    names = [*"xyz", "nx", "ny", "nz", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode("ascii") + np.insert(rows, [3, 3, 3], 0, axis=1).astype("<f4").tobytes())


def main() -> None:
    makers = {"branching": branching, "occluders": occluders, "extruded": extruded, "ball": ball, "knob": knob,
              "pane": pane, "smile": smile}  # fmt: skip
    for name, make in makers.items():
        write_ply(MESHES / f"{name}.ply", *make())
    write_vol(MESHES / "torus.vol", torus_values())
    write_ellipsoids(MESHES / "ellipsoids.ply", np.array(ELLIPSOIDS))


if __name__ == "__main__":
    main()
