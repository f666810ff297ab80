"""What both BSDFs with a differentiable index of refraction share: reading it, and the probability of a lobe.

Mitsuba's own `dielectric` and `plastic` keep the relative index η as a plain number, which nothing can be attached to.
Here it is a Dr.Jit value, under the same name.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from psdr_jit.errors import ParameterError, UnsupportedError

#: What the defaults are, of either plugin [Mitsuba 3.9.1, `include/mitsuba/render/ior.h`].
DEFAULTS = {"air": 1.000277, "bk7": 1.5046, "polypropylene": 1.49}


def read_eta(props: mi.Properties, int_ior: str) -> mi.Float:
    """η = int_ior / ext_ior of a plugin, each a number or the name of a material; inside: `int_ior` by default.

    Mitsuba knows the names: of others than the defaults it is asked for a `dielectric` with the same two. What loads
    something else while Mitsuba loads the parts of a scene file side by side now and then makes it fail.
    """
    if mi.is_polarized:
        raise UnsupportedError(
            f"'{props.plugin_name()}' does not carry polarised light; use Mitsuba's own "
            f"'{props.plugin_name().removeprefix('psdr_')}', or variant '{mi.variant().replace('_polarized', '')}'"
        )
    given = {"int_ior": props.get("int_ior", int_ior), "ext_ior": props.get("ext_ior", "air")}
    for name, value in given.items():
        if isinstance(value, str):
            given[name] = DEFAULTS.get(value, value)
            continue
        if not value > 0:
            raise ParameterError(f"{name} = {value}: an index of refraction is positive")
        given[name] = float(value)
    if any(isinstance(value, str) for value in given.values()):
        return opaque(mi.Float(mi.traverse(mi.load_dict({"type": "dielectric", **given}))["eta"]))
    return opaque(mi.Float(np.float32(given["int_ior"]) / np.float32(given["ext_ior"])))


def opaque(value: mi.Float) -> mi.Float:
    """The same variable, stored in memory: other values of it use the same kernels."""
    dr.make_opaque(value)
    return value


def attached_choice(probability: mi.Float) -> mi.Float:
    """The weight p / detach(p) of a lobe chosen with probability p: 1, with the lobe's relative derivative.

    Where p is 0 the lobe is never chosen, and its derivative is left out.
    """
    p = dr.detach(probability)
    return dr.replace_grad(mi.Float(1), probability / dr.select(p > 0, p, 1))
