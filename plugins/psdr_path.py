"""The `psdr_path` integrator plugin."""

from __future__ import annotations

from ._render import TermIntegrator, register


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
     * - spps
       - |int|
       - Lines per pixel of the boundary seen in mirrors and behind glass (Default: as `sppp`)
     * - sppi, sppd
       - |int|
       - Samples per pixel of the secondary boundary terms; `sppd` overrides `sppi` for the direct one
     * - record_mib
       - |int|
       - Memory for recorded paths in MiB; larger wavefronts run in several passes (Default: 512)
     * - form
       - |string|
       - What path vertices do while a parameter changes: `spatial` (slide along their rays), `material` (stay on their
         surfaces), `mixed` (stay there, but beside corners and contacts), `film`, `film-material` and `film-mixed`
         (the same, and places on the film follow what is seen) or `auto`, whichever suits the scene (Default: auto)
     * - plan
       - |string|
       - `lean` leaves out what is certainly 0, `full` computes everything, for comparison; or the text of a plan that
         was made before (`Plan.to_json`), which is then executed as it is (Default: lean)
     * - guide
       - |string|
       - `auto`: which edges and which directions are sampled is learned from a pilot and earlier calls where that pays;
         `on`: wherever it can be; `off`: not at all. Not with budgets (Default: auto)
     * - aovs
       - |string|
       - Further channels of image and derivative, as `dd:depth, nn:sh_normal`: `depth`, `position`, `sh_normal`,
         `geo_normal`, `shape_index` (Default: none)
     * - direction
       - |string|
       - `known`, in forward mode only, leaves out what has velocity 0 as well (Default: any)

    Samples are paths: an edge sample of the primary and of the indirect term takes two, one on either side of the edge.
    With no budget set, the terms share the cost of `spp` paths each by their measured noise. With any set, as in
    `prb_projective`: 0 switches a term off, the runtime `spp` overrides the others, and where neither is given the
    sampler's count is used. The plan of the latest derivative is the attribute `plan`.
    """


register("psdr_path", PathSpaceIntegrator)
