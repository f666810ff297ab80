"""Registers the plugins with Mitsuba, again after every variant switch. Nothing else lives here.

Mitsuba keeps Python plugins per variant and forgets them on `mi.set_variant`; its variant callback lets us
register them anew. On Mitsuba 3.10 the entry-point group `mitsuba` imports this module as well.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

from psdr_jit.errors import UnsupportedError
from psdr_jit.setup.llvm_guard import require_working_llvm, warn_without_backend

_INTEGRATORS, _BSDFS = ("psdr_path", "psdr_bdpt"), ("psdr_dielectric", "psdr_plastic")


def _refuse(props: mi.Properties) -> None:
    """What the plugins are in a variant without derivatives: an error that says so."""
    raise UnsupportedError(
        f"'{props.plugin_name()}' computes derivatives, which variant '{mi.variant()}' does not track; use "
        "llvm_ad_rgb"
    )


def _register(_old: str | None, variant: str | None) -> None:
    if variant is None:
        return
    if "_ad_" not in variant:
        for name in _INTEGRATORS:
            mi.register_integrator(name, _refuse)
        for name in _BSDFS:
            mi.register_bsdf(name, _refuse)
        return
    require_working_llvm(variant)
    base = importlib.import_module("mitsuba.ad.integrators.common")
    if not issubclass(base.ADIntegrator, mi.Integrator):
        importlib.reload(base)  # our base class still belongs to the variant it was first imported in
    for name in ("_render", *_INTEGRATORS, *_BSDFS):
        full = f"{__name__}.{name}"
        if full in sys.modules:
            importlib.reload(sys.modules[full])  # the base class belongs to the new variant
        else:
            importlib.import_module(full)


warn_without_backend()
mi.detail.add_variant_callback(_register)
_register(None, mi.variant())
