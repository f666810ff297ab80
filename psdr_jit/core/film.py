"""From samples to images and back: the only file that talks to films and image blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedError
from ..options import require_count, require_runtime
from .ad import backpropagate

#: By number of channels.
PIXEL_FORMATS = {1: "luminance", 2: "luminance_alpha", 3: "rgb", 4: "rgba"}

#: Quadrature nodes per pixel for the integral of a reconstruction filter.
FILTER_NODES = 256


def require_film(film: mi.Film) -> None:
    """Films that re-weight samples themselves (`specfilm`) have no boundary splat here."""
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        raise UnsupportedError(f"film '{film.class_name()}' converts samples itself; use an `hdrfilm`")


def require_samples(sensor: mi.Sensor, spp: int) -> None:
    """Raise `OptionError` if a render of this many samples per pixel is more than a render can take; 0: its own."""
    require_count("spp", spp)
    film = sensor.film().crop_size()
    samples = (spp or sensor.sampler().sample_count()) * int(film[0]) * int(film[1])
    if not mi.variant().startswith("scalar"):  # those go pixel by pixel
        require_runtime(0, samples)


def clear(film: mi.Film) -> None:
    film.prepare([])


def _put(block: mi.ImageBlock, film: mi.Film, pos, value, alpha, weight, wavelengths, active) -> None:
    if mi.is_spectral:
        rgb = mi.spectrum_to_srgb(value, wavelengths)
    elif mi.is_monochromatic:
        rgb = mi.Color3f(value.x)
    else:
        rgb = value
    channels = [rgb.x, rgb.y, rgb.z]
    if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
        channels.append(alpha)
    block.put(pos, channels + [weight], active)


@dataclass(frozen=True)
class FilmPoints:
    """Where samples are on the film, and what each of them counts."""

    p: mi.Point2f  # [px]
    weight: mi.Float
    coalesce: bool  # are neighbouring lanes in the same pixel, mostly?


def develop_samples(
    film: mi.Film, at: FilmPoints, value: mi.Spectrum, wavelengths, alpha: mi.Float | float = 0.0
) -> mi.TensorXf:
    """Weighted mean of per-sample values as Mitsuba's renderers form it; attached where `value` is.

    `alpha`: of the samples; of a derivative 0, as it is constant along the interior term.
    """
    clear(film)
    block = film.create_block()
    block.set_coalesce(block.coalesce() and at.coalesce)
    _put(block, film, at.p, value * at.weight, at.weight * alpha, at.weight, wavelengths, mi.Bool(True))
    film.put_block(block)
    return film.develop()


def sample_adjoint(film: mi.Film, at: FilmPoints, grad_in: mi.TensorXf, wavelengths) -> mi.Spectrum:
    """Adjoint of `develop_samples`: derivative of ⟨grad_in, image⟩ with respect to each sample's value."""
    return _adjoint(film, dr.width(at.p), grad_in, lambda value: develop_samples(film, at, value, wavelengths))


def _adjoint(
    film: mi.Film, count: int, grad_in: mi.TensorXf, develop: Callable[[mi.Spectrum], mi.TensorXf]
) -> mi.Spectrum:
    """Derivative of ⟨grad_in, develop(value)⟩ with respect to each of `count` values."""
    with dr.resume_grad():
        value = dr.zeros(mi.Spectrum, count)
        dr.enable_grad(value)
        backpropagate(develop(value), grad_in)
        adjoint = dr.grad(value)
    clear(film)
    dr.eval(adjoint)  # in one kernel: a gather from it would launch one for each channel
    return adjoint


def sampled_window(film: mi.Film) -> tuple[np.ndarray, np.ndarray]:
    """Film region that receives camera samples, `(lower, upper)` corners [px], as in `ADIntegrator.sample_rays`."""
    border = film.rfilter().border_size() if film.sample_border() else 0
    lower = np.array(film.crop_offset(), dtype=float) - border
    return lower, lower + np.array(film.crop_size(), dtype=float) + 2 * border


def _filter_mass(
    rfilter: mi.ReconstructionFilter, first: int, count: int, window: tuple[float, float]
) -> np.ndarray:
    """∫ f(x − x_i) dx over `window` for each of `count` pixel centres x_i along one axis (midpoint rule)."""
    reach = int(np.ceil(rfilter.radius()))
    nodes = (np.arange(2 * reach * FILTER_NODES) + 0.5) / FILTER_NODES - reach
    f = np.array(rfilter.eval(mi.Float(nodes)))
    x = first + 0.5 + np.arange(count)[:, None] + nodes[None, :]
    return (f * ((x > window[0]) & (x < window[1]))).sum(axis=1) / FILTER_NODES


#: What `_pixel_mass` has returned, by everything that it depends on.
_MASSES: dict[tuple, mi.TensorXf] = {}


def _pixel_mass(film: mi.Film) -> mi.TensorXf:
    """∫ f over the sampled window around each pixel, (H, W, 1): the limit of Mitsuba's weight division."""
    lower, upper = sampled_window(film)
    offset, size = film.crop_offset(), film.crop_size()
    key = (mi.variant(), str(film.rfilter()), *offset, *size, *lower, *upper)
    if key not in _MASSES:
        x, y = (_filter_mass(film.rfilter(), offset[a], size[a], (lower[a], upper[a])) for a in (0, 1))
        _MASSES[key] = mi.TensorXf((y[:, None] * x[None, :])[:, :, None].astype(np.float32))
    return _MASSES[key]


def develop_boundary(film: mi.Film, pos, value, alpha, wavelengths, active) -> mi.TensorXf:
    """Image of boundary contributions: Σ f(pos − pixel) · value, over the filter mass of the pixel.

    The interior image converges to ∫ f L / ∫ f over the sampled window, so the boundary integral ∫ f ΔL v dl
    needs the same denominator; dividing by the *discrete* sum of filter weights (a "normalised" splat) is another
    estimator, and scaling by the border's area is wrong. Attached where `value`, `alpha` and `pos` are, to the latter
    if the filter has a slope.
    """
    lower, upper = sampled_window(film)
    inside = (pos.x >= lower[0]) & (pos.x < upper[0]) & (pos.y >= lower[1]) & (pos.y < upper[1])
    clear(film)
    block = film.create_block()
    block.set_coalesce(False)
    _put(block, film, pos, value, alpha, mi.Float(0), wavelengths, active & inside)
    film.put_block(block)
    image = film.develop()
    if film.rfilter().is_box_filter():
        return image
    return image / _pixel_mass(film)


def boundary_adjoint(film: mi.Film, p: mi.Point2f, grad_in: mi.TensorXf, wavelengths) -> mi.Spectrum:
    """Adjoint of `develop_boundary`: derivative of ⟨grad_in, image⟩ with respect to each value."""

    def develop(value: mi.Spectrum) -> mi.TensorXf:
        return develop_boundary(film, p, value, mi.Float(0), wavelengths, mi.Bool(True))

    return _adjoint(film, dr.width(p), grad_in, develop)


def develop_channels(film: mi.Film, names: list[str], at: FilmPoints, values: list[mi.Float]) -> mi.TensorXf:
    """`develop_samples` of other channels than radiance: (H, W, K), attached where `values` are."""
    return _channels(film, names, at.p, (values, at.weight), (at.weight, mi.Bool(True), at.coalesce))


def develop_boundary_channels(film: mi.Film, names: list[str], pos, values: list[mi.Float], active) -> mi.TensorXf:
    """`develop_boundary` of other channels than radiance: (H, W, K), attached where `values` are."""
    lower, upper = sampled_window(film)
    inside = (pos.x >= lower[0]) & (pos.x < upper[0]) & (pos.y >= lower[1]) & (pos.y < upper[1])
    image = _channels(film, names, pos, (values, mi.Float(1)), (mi.Float(0), active & inside, False))
    return image if film.rfilter().is_box_filter() else image / _pixel_mass(film)


def _channels(film: mi.Film, names: list[str], pos, weighted, how) -> mi.TensorXf:
    """The last channels of a film that has been prepared for `names` as well; it is then as before."""
    (values, factor), (weight, active, coalesce) = weighted, how
    film.prepare(names)
    block = film.create_block()
    block.set_coalesce(block.coalesce() and coalesce)
    zero = mi.Float(0)
    base = [zero] * (4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3)
    block.put(pos, [*base, weight, *(value * factor for value in values)], active)
    film.put_block(block)
    image = film.develop()
    clear(film)
    return image[:, :, image.shape[2] - len(names) : image.shape[2]]


def develop_splats(film: mi.Film, pos: mi.Point2f, value: mi.Spectrum, wavelengths, active: mi.Bool) -> mi.TensorXf:
    """Image of light that lands on the film at `pos` [px], in the window of camera samples or not.

    Σ f(pos − pixel) · value / ∫ f, attached where `pos` and `value` are. Of a box filter, `pos` has no derivative.
    """
    clear(film)
    block = film.create_block()
    block.set_coalesce(False)
    _put(block, film, pos, value, mi.Float(0), mi.Float(0), wavelengths, active)
    film.put_block(block)
    image = film.develop()
    rfilter = film.rfilter()
    if rfilter.is_box_filter():
        return image
    return image / float(_filter_mass(rfilter, 0, 1, (-np.inf, np.inf))[0] ** 2)


def filter_reach(film: mi.Film) -> float:
    """Distance from a pixel's centre to which its filter reaches, 0 for a box filter [px]."""
    return 0.0 if film.rfilter().is_box_filter() else float(film.rfilter().radius())


def black(film: mi.Film) -> mi.TensorXf:
    """An image of zeros in the film's format."""
    clear(film)
    return film.develop() * 0


def film_like(film: mi.Film, size: tuple[int, int], crop: tuple[tuple[int, int], tuple[int, int]] | None = None,
              sample_border: bool = False) -> mi.Film:  # fmt: skip
    """A film of another `size` (width, height) with the filter and the channels of `film`.

    `crop`: offset and size of its crop window, by default all of it.
    """
    (left, top), (width, height) = crop or ((0, 0), size)
    return mi.load_dict({
        "type": "hdrfilm", "width": size[0], "height": size[1], "crop_offset_x": left, "crop_offset_y": top,
        "crop_width": width, "crop_height": height, "rfilter": film.rfilter(), "sample_border": sample_border,
        "pixel_format": PIXEL_FORMATS[black(film).shape[2]], "component_format": "float32",
    })  # fmt: skip
