"""What is seen, as numbers beside its radiance: depth, position, normals, the number of the shape.

    "dd:depth, nn:sh_normal"        names and kinds, as of Mitsuba's `aov` integrator; channels dd.T, nn.X, nn.Y, nn.Z

An AOV A is a function of the first thing that a viewing ray meets, 0 where it meets nothing. Its image is ∫ f A, whose
derivative is ∫ f ∂A/∂θ, with the ray held fixed, plus a boundary integral over the edges that the sensor sees
directly, with the step of A in place of that of radiance: `interior.aovs`, `boundary.primary_aovs`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..errors import OptionError, UnsupportedError


@dataclass(frozen=True)
class Kind:
    """Suffixes of its channels, and its values at `(si, origin of the viewing ray)`."""

    suffixes: tuple[str, ...]
    values: Callable[[mi.SurfaceInteraction3f, mi.Point3f], list[mi.Float]]


KINDS = {
    "depth": Kind(("T",), lambda si, o: [dr.norm(si.p - o)]),
    "position": Kind(("X", "Y", "Z"), lambda si, o: list(si.p)),
    "sh_normal": Kind(("X", "Y", "Z"), lambda si, o: list(si.sh_frame.n)),
    "geo_normal": Kind(("X", "Y", "Z"), lambda si, o: list(si.n)),
    "shape_index": Kind(("I",), lambda si, o: [mi.Float(dr.reinterpret_array(mi.UInt32, si.shape))]),
}

#: Kinds of Mitsuba's that are not there, and why.
REFUSED = {
    "uv": "steps along seams, which are no edges here unless a texture shows them",
    "dp_du": "steps between any two faces of a mesh",
    "dp_dv": "steps between any two faces of a mesh",
    "duv_dx": "steps between any two faces of a mesh",
    "duv_dy": "steps between any two faces of a mesh",
    "prim_index": "steps between any two faces of a mesh",
    "boundary_test": "is made to be wrong at edges",
    "albedo": "is a matter of materials: differentiate an image under even light",
}

#: Cosine between a face and its vertex normals, above which it is flat for `geo_normal`.
FLAT = 1 - 1e-4


@dataclass(frozen=True)
class Aovs:
    """A list of AOVs that has been asked for."""

    entries: tuple[tuple[str, str], ...]  # (name, kind)

    @staticmethod
    def parse(text: str) -> Aovs:
        """Raises `OptionError` for what is no list of AOVs, `UnsupportedError` for those without a derivative."""
        entries = []
        for item in filter(None, re.split(r"[\s,]+", text)):
            name, _, kind = item.partition(":")
            if kind in REFUSED:
                raise UnsupportedError(
                    f"aovs = {text!r}: {kind} {REFUSED[kind]}; take Mitsuba's `aov` around `path` for its image"
                )
            if not name or kind not in KINDS:
                raise OptionError(f"aovs = {text!r}: expected name:kind, with a kind out of {', '.join(KINDS)}")
            entries.append((name, kind))
        if len({name for name, _ in entries}) < len(entries):
            raise OptionError(f"aovs = {text!r}: give each its own name")
        return Aovs(tuple(entries))

    @property
    def text(self) -> str:
        """As Mitsuba's `aov` wants it."""
        return ",".join(f"{name}:{kind}" for name, kind in self.entries)

    @property
    def channels(self) -> list[str]:
        return [f"{name}.{suffix}" for name, kind in self.entries for suffix in KINDS[kind].suffixes]

    def values(self, si: mi.SurfaceInteraction3f, origin: mi.Point3f) -> list[mi.Float]:
        """By channel, attached where `si` is."""
        found = [value for _, kind in self.entries for value in KINDS[kind].values(si, origin)]
        valid = si.is_valid()
        return [dr.select(valid, value, 0) for value in found]

    def require_edges(self, scene: mi.Scene) -> None:
        """Raise `UnsupportedError` where an AOV steps along what is no edge here."""
        if all(kind != "geo_normal" for _, kind in self.entries):
            return
        for shape in scene.shapes():
            if isinstance(shape, mi.Mesh) and shape.has_vertex_normals() and not _flat(shape):
                raise UnsupportedError(
                    f"aovs: geo_normal steps between any two faces of the smooth mesh '{shape.id()}'; use sh_normal, "
                    "or load the mesh with face_normals"
                )


def _flat(mesh: mi.Mesh) -> bool:
    """Do all vertex normals agree with their faces?"""
    with dr.suspend_grad():
        corners = mesh.face_indices(dr.arange(mi.UInt32, mesh.face_count()))
        a, b, c = (mesh.vertex_position(corner) for corner in corners)
        n = dr.normalize(dr.cross(b - a, c - a))
        cosines = [dr.abs(dr.dot(n, mesh.vertex_normal(corner))) for corner in corners]
        return bool(dr.all([dr.all(~(cosine < FLAT)) for cosine in cosines])[0])
