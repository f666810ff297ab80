"""The `psdr_path` integrator plugin."""

from __future__ import annotations

import mitsuba as mi

from ._render import TermIntegrator


class PathSpaceIntegrator(TermIntegrator):
    r"""
    .. _integrator-psdr_path:

    Path-space differentiable path tracer (:monosp:`psdr_path`)
    -----------------------------------------------------------

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path depth, -1 for unlimited (Default: -1)
     * - rr_depth
       - |int|
       - Depth at which Russian roulette begins (Default: 5)
     * - hide_emitters
       - |bool|
       - Make directly visible emitters transparent (Default: no)
     * - sppc
       - |int|
       - Samples per pixel of the interior (continuous) term
     * - sppp
       - |int|
       - Samples per pixel of the primary boundary term: edges seen directly by the sensor
     * - sppi, sppd
       - |int|
       - Samples per pixel of the secondary boundary terms; `sppd` overrides `sppi` for the direct one
     * - record_mib
       - |int|
       - Memory for recorded paths in MiB; larger wavefronts run in several passes (Default: 1024)

    Samples are paths: an edge sample of the primary and of the indirect term takes two, one on either side of the edge.
    A budget of 0 switches its term off; otherwise the runtime `spp` overrides it, and where neither is given the
    sampler's count is used, as in `prb_projective`.
    """


mi.register_integrator("psdr_path", lambda props: PathSpaceIntegrator(props))
