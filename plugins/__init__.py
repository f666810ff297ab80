"""Registers the integrator plugins with Mitsuba, again after every variant switch. Nothing else lives here.

Mitsuba keeps Python plugins per variant and forgets them on `mi.set_variant`; its variant callback lets us
register them anew. On Mitsuba 3.10 the entry-point group `mitsuba` imports this module as well.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

from psdr_jit.llvm_guard import require_working_llvm, warn_without_backend

_PLUGINS = ("psdr_path",)


def _register(_old: str | None, variant: str | None) -> None:
    if variant is None or "_ad_" not in variant:
        return  # no derivatives in this variant, hence nothing to register
    require_working_llvm(variant)
    base = importlib.import_module("mitsuba.ad.integrators.common")
    if not issubclass(base.ADIntegrator, mi.Integrator):
        importlib.reload(base)  # our base class still belongs to the variant it was first imported in
    for name in ("_render", *_PLUGINS):
        full = f"{__name__}.{name}"
        if full in sys.modules:
            importlib.reload(sys.modules[full])  # the base class belongs to the new variant
        else:
            importlib.import_module(full)


warn_without_backend()
mi.detail.add_variant_callback(_register)
_register(None, mi.variant())
