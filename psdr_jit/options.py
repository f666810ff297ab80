"""Frozen, validated options of the integrators; every field is an XML property of the same name."""

from __future__ import annotations

from dataclasses import dataclass, fields

from .errors import OptionError

#: `max_depth = -1` in a scene file: unlimited. Mitsuba's own encoding.
UNLIMITED = 0xFFFFFFFF


@dataclass(frozen=True)
class Options:
    """How far to trace and how many samples to spend.

    `None` for a budget means "not set": the runtime `spp`, or else the sampler's count, decides.
    """

    max_depth: int = -1  # path segments, -1: unlimited
    rr_depth: int = 5  # segments before Russian roulette may end a path
    hide_emitters: bool = False  # directly visible emitters are transparent
    sppc: int | None = None  # samples per pixel, interior (continuous) term
    sppp: int | None = None  # samples per pixel, primary boundary
    sppi: int | None = None  # samples per pixel, default of each secondary boundary term
    sppd: int | None = None  # samples per pixel, direct boundary term; overrides sppi
    record_mib: int = 1024  # memory for recorded paths; larger wavefronts are split into passes

    def __post_init__(self):
        if self.max_depth < 0 and self.max_depth != -1:
            raise OptionError(f"max_depth = {self.max_depth}: use a depth >= 0, or -1 for unlimited")
        if self.rr_depth <= 0:
            raise OptionError(
                f"rr_depth = {self.rr_depth}: use a depth >= 1 (a large one switches roulette off)"
            )
        for name in ("sppc", "sppp", "sppi", "sppd"):
            value = getattr(self, name)
            if value is not None and value < 0:
                raise OptionError(f"{name} = {value}: use a count >= 0 (0 switches the term off)")
        if self.record_mib < 16:
            raise OptionError(f"record_mib = {self.record_mib}: at least 16 MiB are needed")

    @staticmethod
    def from_properties(props) -> Options:
        """Read every field from Mitsuba `Properties`; the loader then rejects whatever was not read."""
        return Options(**{f.name: props.get(f.name, f.default) for f in fields(Options)})

    @property
    def depth_limit(self) -> int:
        """`max_depth` with -1 replaced by Mitsuba's largest depth."""
        return UNLIMITED if self.max_depth == -1 else self.max_depth


def samples_per_pixel(term_spp: int | None, runtime_spp: int, sampler_spp: int) -> int:
    """Mitsuba's rule for projective integrators: 0 disables, then runtime, then the plugin's, then the sampler's."""
    if term_spp == 0:
        return 0
    if runtime_spp != 0:
        return runtime_spp
    return sampler_spp if term_spp is None else term_spp
