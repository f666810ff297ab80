"""The `psdr_bdpt` integrator plugin."""

from __future__ import annotations

from psdr_jit.core.threads import alone
from psdr_jit.driver.primal import bidirectional_image

from ._render import TermIntegrator, register


class BidirectionalIntegrator(TermIntegrator):
    r"""
    .. _integrator-psdr_bdpt:

    Path-space differentiable path tracer with light subpaths (:monosp:`psdr_bdpt`)
    -------------------------------------------------------------------------------

    .. pluginparameters::

     * - light_paths
       - |string|
       - `auto`: light subpaths are aimed at surfaces that may focus light and connected to the sensor, where the plan
         finds such surfaces, and lights that camera paths find worse by way of them (of mirrors and smooth glass, small
         ones; of rough ones, skies with a sun); `off`: none; `only`: what light subpaths find is left to them alone,
         for comparison
         (Default: auto)

    All other parameters are those of `psdr_path`. Images and derivatives are the same in expectation; light that small
    sources send through glass, or by way of mirrors, has less noise. Each camera sample comes with two light subpaths,
    or four where something moves. Light of points and spots through smooth glass and by way of smooth mirrors, which
    camera paths never find, is in the image as well; its derivative needs a smooth reconstruction filter. Its steps
    belong to the budget `spps`.
    """

    bidirectional = True

    def primal(self, scene, sensor, seed, spp, develop=True, evaluate=True):
        if develop:
            with alone():
                image = bidirectional_image(self.call(scene, sensor, seed, spp))
            if image is not None:
                return image
        return super().primal(scene, sensor, seed, spp, develop, evaluate)


register("psdr_bdpt", BidirectionalIntegrator)
