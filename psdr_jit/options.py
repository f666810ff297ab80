"""Frozen, validated options of the integrators; every field is an XML property of the same name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from numbers import Integral

from .errors import OptionError, did_you_mean

#: `max_depth = -1` in a scene file: unlimited. Mitsuba's own encoding.
UNLIMITED = 0xFFFFFFFF

#: What path vertices do while θ changes [Zhang et al. 2020]: slide along their rays, or stay on their material points;
#: or stay there, but behind a vertex with another surface close by.
SPATIAL, MATERIAL, MIXED = "spatial", "material", "mixed"

#: The same where places on the film follow what is seen there, and what vertices do in each.
FILM, FILM_MATERIAL, FILM_MIXED = "film", "film-material", "film-mixed"
FOLLOWING = {FILM: SPATIAL, FILM_MATERIAL: MATERIAL, FILM_MIXED: MIXED}

FORMS = (SPATIAL, MATERIAL, MIXED, *FOLLOWING)


def of_vertices(form: str) -> str:
    """What path vertices do in a form, wherever places on the film are: SPATIAL, MATERIAL or MIXED."""
    return FOLLOWING.get(form, form)


#: Leave out what does not contribute, or compute everything, for comparison.
PLANS = ("lean", "full")

#: Forward mode may rely on the direction that is set on the parameters: what has velocity 0 is left out as well.
DIRECTIONS = ("any", "known")

#: Light subpaths: none; where the plan finds a use for them; the same, but what they find is left to them alone, for
#: comparison.
LIGHT_PATHS = ("off", "auto", "only")

#: Guides of samples on edges: where the noise that is known says that they pay; wherever one can be made; none.
GUIDES = ("auto", "on", "off")

#: The options that hold a term's samples per pixel, and which of them follows another one where it is not set.
BUDGETS = ("sppc", "sppp", "spps", "sppi", "sppd")
FOLLOWS = {"sppd": "sppi", "spps": "sppp"}


@dataclass(frozen=True)
class Options:
    """How far to trace and how many samples to spend.

    Budgets count paths per pixel: an edge sample of the primary and indirect terms takes two, one for each side.
    `None` for a budget means "not set": the runtime `spp`, or else the sampler's count, decides. While none is set,
    these count for the terms on average, see `driver.pilot`.
    """

    max_depth: int = -1  # path segments, -1: unlimited
    rr_depth: int = 5  # segments before Russian roulette may end a path
    hide_emitters: bool = False  # directly visible emitters are transparent
    sppc: int | None = None  # samples per pixel, interior (continuous) term
    sppp: int | None = None  # samples per pixel, primary boundary
    spps: int | None = None  # lines per pixel, boundary seen through mirrors and glass; overrides sppp
    sppi: int | None = None  # samples per pixel, default of each secondary boundary term
    sppd: int | None = None  # samples per pixel, direct boundary term; overrides sppi
    record_mib: int = 512  # memory for recorded paths; larger wavefronts are split into passes
    form: str = "auto"  # one of FORMS, or "auto": whichever suits the scene
    plan: str = "lean"  # one of PLANS, or a plan that was made before, as JSON
    direction: str = "any"  # one of DIRECTIONS
    guide: str = "auto"  # one of GUIDES
    aovs: str = ""  # further channels of the image, "name:kind, ...", see `paths.aovs`
    more_budgets: tuple[tuple[str, int | None], ...] = ()  # of terms that bring a budget of their own, by name
    light_paths: str = "off"  # one of LIGHT_PATHS; a property of the integrators that can trace them

    def __post_init__(self):
        for name, default in _properties():
            self._require_type(name, getattr(self, name), default)
        if self.max_depth < 0 and self.max_depth != -1:
            raise OptionError(f"max_depth = {self.max_depth}: use a depth >= 0, or -1 for unlimited")
        if self.rr_depth <= 0:
            raise OptionError(
                f"rr_depth = {self.rr_depth}: use a depth >= 1 (a large one switches roulette off)"
            )
        for name, value in self._budgets.items():
            self._require_type(name, value, None)
            if value is not None and value < 0:
                raise OptionError(f"{name} = {value}: use a count >= 0 (0 switches the term off)")
        for name, words in (("form", ("auto", *FORMS)), ("plan", PLANS), ("direction", DIRECTIONS), ("guide", GUIDES),
                            ("light_paths", LIGHT_PATHS)):  # fmt: skip
            if getattr(self, name) not in words and not (name == "plan" and self.plan_is_given):
                raise OptionError(f"{name} = {getattr(self, name)!r}: use {', '.join(words[:-1])} or {words[-1]}")
        if self.record_mib < 16:
            raise OptionError(f"record_mib = {self.record_mib}: at least 16 MiB are needed")

    @staticmethod
    def _require_type(name: str, value, default) -> None:
        """Mitsuba hands over what the scene file says, whatever its type: <string>, <float>, <boolean>."""
        if isinstance(default, bool):
            if not isinstance(value, bool):
                raise OptionError(
                    f"{name} = {value!r} is of type {type(value).__name__}: use true or false "
                    f'(<boolean name="{name}" .../> in a scene file)'
                )
        elif isinstance(default, str):
            if not isinstance(value, str):
                raise OptionError(
                    f"{name} = {value!r} is of type {type(value).__name__}: use a word "
                    f'(<string name="{name}" .../> in a scene file)'
                )
        elif value is not None or default is not None:
            require_count(name, value, f' (<integer name="{name}" .../> in a scene file)')

    @staticmethod
    def from_properties(props, budgets: Iterable[str] = (), bidirectional: bool = False) -> Options:
        """Read every field from Mitsuba `Properties`, and `budgets` that are none; the loader rejects what is left.

        `bidirectional`: of an integrator that can trace light subpaths, which it then does where the plan says so.
        """
        more = tuple((name, props.get(name, None)) for name in dict.fromkeys(budgets) if name not in BUDGETS)
        own = {"light_paths": props.get("light_paths", "auto")} if bidirectional else {}
        return Options(**{name: props.get(name, default) for name, default in _properties()}, more_budgets=more, **own)

    @property
    def _budgets(self) -> dict[str, int | None]:
        return {name: getattr(self, name) for name in BUDGETS} | dict(self.more_budgets)

    def budget(self, name: str) -> int | None:
        """Samples per pixel under the property `name`, or under the one that it follows if it is not set."""
        value = self._budgets[name]
        return self._budgets[FOLLOWS[name]] if value is None and name in FOLLOWS else value

    @property
    def plan_is_given(self) -> bool:
        """Is `plan` the text of a plan, `Plan.to_json`, rather than a way to make one?"""
        return self.plan.lstrip().startswith("{")

    @property
    def budgets_set(self) -> bool:
        """Does any term have a budget of its own?"""
        return any(value is not None for value in self._budgets.values())

    @property
    def depth_limit(self) -> int:
        """`max_depth` with -1 replaced by Mitsuba's largest depth."""
        return UNLIMITED if self.max_depth == -1 else self.max_depth


def _properties() -> list[tuple[str, object]]:
    """`(name, default)` of the fields that are properties of every integrator."""
    special = ("more_budgets", "light_paths")
    return [(field.name, field.default) for field in fields(Options) if field.name not in special]


def require_known(props) -> None:
    """Raise `OptionError` unless the integrator has read every one of its Mitsuba `Properties`."""
    known = [name for name, _ in _properties()] + ["light_paths"]
    unknown = [f"property '{name}'{did_you_mean(name, known)}" for name in props.unqueried()]
    if unknown:
        raise OptionError(f"{props.plugin_name()} has no {'; no '.join(unknown)}")


def require_count(name: str, value, hint: str = "") -> None:
    """Raise `OptionError` unless `value` is a whole number that Mitsuba can store."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise OptionError(f"{name} = {value!r} is of type {type(value).__name__}: use a whole number{hint}")
    if not -(2**31) <= value < 2**31:
        raise OptionError(f"{name} = {value}: use a number below 2^31")


def require_runtime(seed, samples: int) -> None:
    """Raise `OptionError` unless a render call can use these; `samples` is the largest count of any term."""
    if samples >= 2**32:
        raise OptionError(
            f"{samples:.3g} samples are more than 2^32, all that one render can take: use fewer per pixel and average "
            "several seeds"
        )
    if isinstance(seed, Integral) and not 0 <= seed < 2**32:
        raise OptionError(f"seed = {seed}: use a number from 0 to 2^32 - 1")


def samples_per_pixel(term_spp: int | None, runtime_spp: int, sampler_spp: int) -> int:
    """Mitsuba's rule for projective integrators: 0 disables, then runtime, then the plugin's, then the sampler's."""
    require_count("spp", runtime_spp)
    if runtime_spp < 0:
        raise OptionError(f"spp = {runtime_spp}: use a count >= 1 (0 leaves it to the integrator and the sampler)")
    if term_spp == 0:
        return 0
    if runtime_spp != 0:
        return runtime_spp
    return sampler_spp if term_spp is None else term_spp
