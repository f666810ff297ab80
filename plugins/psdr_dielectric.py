"""The `psdr_dielectric` BSDF plugin: smooth glass with a differentiable index of refraction."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ._ior import attached_choice, opaque, read_eta

#: Numbers of the lobes.
REFLECTION, TRANSMISSION = 0, 1

TINTS = ("specular_reflectance", "specular_transmittance")


class DifferentiableDielectric(mi.BSDF):
    r"""
    .. _bsdf-psdr_dielectric:

    Smooth dielectric with a differentiable index of refraction (:monosp:`psdr_dielectric`)
    ---------------------------------------------------------------------------------------

    .. pluginparameters::

     * - int_ior, ext_ior
       - |float| or |string|
       - Index of refraction inside and outside, or the name of a material (Default: bk7 / air)
     * - specular_reflectance, specular_transmittance
       - |spectrum| or |texture|
       - Factors on what is reflected and on what passes (Default: 1)
     * - eta
       - |float|
       - Relative index of refraction, inside to outside
       - |exposed|, |differentiable|, |discontinuous|

    Mitsuba's `dielectric`: same parameters, same samples, same image. Its directions follow η, and each lobe carries
    the derivative of its Fresnel term.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.eta = read_eta(props, "bk7")
        self.tints = {name: props.get_texture(name, 1.0) for name in TINTS if name in props}
        both_sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
        through = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.NonSymmetric
        self.m_components = [mi.BSDFFlags.DeltaReflection | both_sides, through | both_sides]
        self.m_flags = self.m_components[REFLECTION] | self.m_components[TRANSMISSION]

    def traverse(self, callback):
        callback.put("eta", self.eta, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)
        for name, tint in self.tints.items():
            callback.put(name, tint, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys):
        opaque(self.eta)

    def sample(self, ctx, si, sample1, sample2, active):
        reflects = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, REFLECTION)
        passes = ctx.is_enabled(mi.BSDFFlags.DeltaTransmission, TRANSMISSION)
        bs = dr.zeros(mi.BSDFSample3f)
        if not (reflects or passes):
            return bs, mi.Spectrum(0)

        F, cos_t, η_it, η_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.eta)
        if reflects and passes:
            reflected = active & (sample1 <= F)
            bs.pdf = dr.detach(dr.select(reflected, F, 1 - F))
            weight = mi.Spectrum(dr.select(reflected, attached_choice(F), attached_choice(1 - F)))
        else:
            reflected = active & mi.Bool(reflects)
            bs.pdf = mi.Float(1)
            weight = mi.Spectrum(F if reflects else 1 - F)
        passed = active & ~reflected

        bs.wo = dr.select(reflected, mi.reflect(si.wi), mi.refract(si.wi, cos_t, η_ti))
        bs.eta = dr.select(reflected, 1, η_it)
        bs.sampled_component = dr.select(reflected, mi.UInt32(REFLECTION), TRANSMISSION)
        bs.sampled_type = dr.select(
            reflected, mi.UInt32(int(mi.BSDFFlags.DeltaReflection)), int(mi.BSDFFlags.DeltaTransmission)
        )
        for name, lanes in zip(TINTS, (reflected, passed), strict=True):
            if name in self.tints:
                weight *= dr.select(lanes, self.tints[name].eval(si, lanes), 1)
        if ctx.mode == mi.TransportMode.Radiance:  # which is spread over another solid angle
            weight *= dr.select(passed, dr.square(η_ti), 1)
        return bs, weight & active

    def eval(self, ctx, si, wo, active):
        return mi.Spectrum(0)

    def pdf(self, ctx, si, wo, active):
        return mi.Float(0)

    def eval_pdf(self, ctx, si, wo, active):
        return mi.Spectrum(0), mi.Float(0)

    def class_name(self):
        """Mitsuba knows Python plugins as `BSDF`; messages want to know more."""
        return "DifferentiableDielectric"

    def to_string(self):
        tints = "".join(f"  {name} = {tint},\n" for name, tint in self.tints.items())
        return f"{self.class_name()}[\n{tints}  eta = {self.eta}\n]"


mi.register_bsdf("psdr_dielectric", DifferentiableDielectric)
