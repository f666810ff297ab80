"""What light samples of smooth-shaded lights are multiplied with, where normals are all but at right angles to them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from psdr_jit.paths.smooth_lights import shared_by_sample


def test_a_weight_of_1_divides_by_no_0(llvm):
    """One sample in 10^8 of a glowing ball on a rough floor was infinite."""
    ρ = mi.Float(3e-6, 1e-4, 0.5, 1)
    assert np.allclose(shared_by_sample(ρ, ρ, mi.Float(1)), 1, rtol=1e-5)
