"""The `psdr_plastic` BSDF plugin: smooth plastic with a differentiable index of refraction."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ._ior import opaque, read_eta

#: Numbers of the lobes.
SPECULAR, DIFFUSE = 0, 1


class DifferentiablePlastic(mi.BSDF):
    r"""
    .. _bsdf-psdr_plastic:

    Smooth plastic with a differentiable index of refraction (:monosp:`psdr_plastic`)
    ---------------------------------------------------------------------------------

    .. pluginparameters::

     * - diffuse_reflectance
       - |spectrum| or |texture|
       - Albedo of the base (Default: 0.5)
     * - specular_reflectance
       - |spectrum| or |texture|
       - Factor on what the coat reflects (Default: 1)
     * - int_ior, ext_ior
       - |float| or |string|
       - Index of refraction inside and outside, or the name of a material (Default: polypropylene / air)
     * - nonlinear
       - |bool|
       - Do reflections inside of the coat shift the colour of the base? (Default: no)
     * - eta
       - |float|
       - Relative index of refraction, inside to outside
       - |exposed|, |differentiable|

    Mitsuba's `plastic`: same parameters, same samples, same image. With F the Fresnel term, F̄ its mean over directions
    inside of the coat and a the albedo,

        f cosθ_o = a / (1 − F̄) · (1 − F(θ_i)) (1 − F(θ_o)) / η² · cosθ_o/π,        (a F̄ instead of F̄ if nonlinear)

    beside a reflection with the factor F(θ_i). All of it is attached to η; which lobe is sampled is not.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.eta = read_eta(props, "polypropylene")
        self.diffuse = props.get_texture("diffuse_reflectance", 0.5)
        self.specular = props.get_texture("specular_reflectance", 1.0) if "specular_reflectance" in props else None
        self.nonlinear = props.get("nonlinear", False)
        front = mi.BSDFFlags.FrontSide
        self.m_components = [mi.BSDFFlags.DeltaReflection | front, mi.BSDFFlags.DiffuseReflection | front]
        self.m_flags = self.m_components[SPECULAR] | self.m_components[DIFFUSE]
        self._derive()

    def _derive(self):
        """What follows from the parameters."""
        opaque(self.eta)
        self.inside = mi.fresnel_diffuse_reflectance(dr.rcp(self.eta))  # F̄, attached
        bright = 1.0 if self.specular is None else dr.detach(mi.Float(self.specular.mean()))
        self.specular_share = bright / (dr.detach(mi.Float(self.diffuse.mean())) + bright)
        dr.make_opaque(self.inside, self.specular_share)

    def traverse(self, callback):
        callback.put("eta", self.eta, mi.ParamFlags.Differentiable)
        callback.put("diffuse_reflectance", self.diffuse, mi.ParamFlags.Differentiable)
        if self.specular is not None:
            callback.put("specular_reflectance", self.specular, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys):
        self._derive()

    def _fresnel(self, w: mi.Vector3f) -> mi.Float:
        return mi.fresnel(mi.Frame3f.cos_theta(w), self.eta)[0]

    def _specular_probability(self, ctx, F: mi.Float) -> mi.Float:
        """Of the reflection at a place with Fresnel term F, detached."""
        if not ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, DIFFUSE):
            return mi.Float(1)
        if not ctx.is_enabled(mi.BSDFFlags.DeltaReflection, SPECULAR):
            return mi.Float(0)
        F = dr.detach(F)
        specular, diffuse = F * self.specular_share, (1 - F) * (1 - self.specular_share)
        return specular / (specular + diffuse)

    def _base(self, si, F_i: mi.Float, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """f cosθ_o / (cosθ_o/π), attached."""
        albedo = self.diffuse.eval(si, active)
        albedo /= 1 - (albedo * self.inside if self.nonlinear else self.inside)
        return albedo * dr.rcp(dr.square(self.eta)) * (1 - F_i) * (1 - self._fresnel(wo))

    def sample(self, ctx, si, sample1, sample2, active):
        bs = dr.zeros(mi.BSDFSample3f)
        scatters = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, DIFFUSE)
        if not (scatters or ctx.is_enabled(mi.BSDFFlags.DeltaReflection, SPECULAR)):
            return bs, mi.Spectrum(0)

        active = active & (mi.Frame3f.cos_theta(si.wi) > 0)
        F_i = self._fresnel(si.wi)
        p = self._specular_probability(ctx, F_i)
        reflected = active & (sample1 < p)
        scattered = active & ~reflected

        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        pdf = (1 - p) * mi.warp.square_to_cosine_hemisphere_pdf(wo)
        bs.wo = dr.select(reflected, mi.reflect(si.wi), wo)
        bs.pdf = dr.select(reflected, p, pdf) & active
        bs.eta = mi.Float(1)
        bs.sampled_component = dr.select(reflected, mi.UInt32(SPECULAR), DIFFUSE)
        bs.sampled_type = dr.select(
            reflected, mi.UInt32(int(mi.BSDFFlags.DeltaReflection)), int(mi.BSDFFlags.DiffuseReflection)
        )
        specular = mi.Spectrum(F_i / dr.select(reflected, p, 1))
        if self.specular is not None:
            specular *= self.specular.eval(si, reflected)
        diffuse = self._base(si, F_i, wo, scattered) / dr.select(scattered, 1 - p, 1)
        return bs, dr.select(reflected, specular, diffuse) & active

    def eval_pdf(self, ctx, si, wo, active):
        if not ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, DIFFUSE):
            return mi.Spectrum(0), mi.Float(0)
        active = active & (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        F_i, density = self._fresnel(si.wi), mi.warp.square_to_cosine_hemisphere_pdf(wo)
        value = self._base(si, F_i, wo, active) * density
        return value & active, (1 - self._specular_probability(ctx, F_i)) * density & active

    def eval(self, ctx, si, wo, active):
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx, si, wo, active):
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_diffuse_reflectance(self, si, active):
        return self.diffuse.eval(si, active)

    def class_name(self):
        """Mitsuba knows Python plugins as `BSDF`; messages want to know more."""
        return "DifferentiablePlastic"

    def to_string(self):
        tint = "" if self.specular is None else f"  specular_reflectance = {self.specular},\n"
        return (
            f"{self.class_name()}[\n  diffuse_reflectance = {self.diffuse},\n{tint}"
            f"  nonlinear = {self.nonlinear},\n  eta = {self.eta}\n]"
        )


mi.register_bsdf("psdr_plastic", DifferentiablePlastic)
