"""What is known of the noise of pixels, and that a term's samples go where it is."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from helpers import adjoint_identity

from psdr_jit.derivative.perturbation import perturb
from psdr_jit.driver.film_noise import FORGET, FilmNoise, coarse
from psdr_jit.scene import io as scene_io

SHAPE = (4, 6)


def test_images_of_more_samples_tell_more():
    few, more = np.full(SHAPE, 8.0), np.full(SHAPE, 1.0)
    noise = FilmNoise.of({1: few, 4: more}, 3)
    assert np.allclose(noise.variance, (2 * 8 + 8 * 4) / 10) and noise.samples == 10


def test_one_pixel_does_not_take_what_others_need():
    """A rare contribution that one half of the pilot has met; where both have, there is noise indeed."""
    outline = np.zeros((32, 32))
    outline[4:14, 4:14] = 1.0
    met = outline.copy()
    met[25, 25] = 1e6
    for few, more, believed in ((outline, met, False), (met, met, True)):
        density = FilmNoise.of({1: few, 4: more / 4}, 3).density.relative
        assert (density[25, 25] > 10 * density[8, 8]) == believed
        assert (density[8, 8] > 3) != believed


def test_what_is_seen_with_a_density_is_put_back_to_one_sample():
    """The same variances of single samples again: nothing is learned but how sure they are."""
    truth = np.arange(1.0, 25.0).reshape(SHAPE) ** 2
    noise = FilmNoise(truth, 10)
    again = noise.seen(truth / (16 * noise.density.expected), 16, 3)
    assert np.allclose(again.variance, truth) and again.samples > noise.samples


def test_large_films_are_kept_in_blocks():
    image = np.add.outer(np.arange(600.0), np.zeros(100))
    kept = coarse(image)
    assert kept.shape == (200, 34) and np.allclose(kept[:, 0], 3 * np.arange(200) + 1)
    assert coarse(image[:250]).shape == (250, 100)
    assert coarse(image[:257]).shape == (129, 50)


def test_old_observations_fade():
    noise = FilmNoise(np.ones(SHAPE), 1e9)
    seen = noise.seen(np.full(SHAPE, 5.0) / (4 * noise.density.expected), 4, 1)
    assert np.allclose(seen.variance, 1 + 4 * FORGET)


def test_samples_follow_the_noise_and_both_modes_agree(llvm):
    """Forward and backward mode draw the same samples, wherever the pilot sends them."""
    scene = scene_io.load_scene(scene_io.shipped_scene("reflected_light.xml"), res=12)
    integrator = mi.load_dict({"type": "psdr_path", "max_depth": 2})
    forward, backward, w, Jv = adjoint_identity(scene, "mirror.to_world", integrator, spp=8)
    assert Jv > 0 and abs(forward - backward) < 1e-5 * w * Jv


@pytest.mark.slow
def test_there_is_less_noise_than_with_even_samples(llvm):
    """The same budgets, evenly spread."""
    scene = scene_io.load_scene(scene_io.shipped_scene("glass.xml"), res=32)
    motion = perturb(scene, "body.to_world", (1, 0, 0))
    lean = mi.load_dict({"type": "psdr_path", "max_depth": 4})

    def images(integrator) -> np.ndarray:
        found = []
        for seed in range(16):
            motion.attach()
            found.append(np.array(integrator.render_forward(scene, motion.params, seed=seed, spp=16)))
        return np.array(found[4:])

    spread = images(lean)
    plan = replace(lean.plan, terms=tuple(replace(t, film=None, lines=None) for t in lean.plan.terms))
    even = images(mi.load_dict({"type": "psdr_path", "max_depth": 4, "plan": plan.to_json()}))
    motion.restore()
    assert spread.var(0).mean() < 0.5 * even.var(0).mean()
    error = np.sqrt(sum(v.mean((1, 2, 3)).var() / len(v) for v in (even, spread)))
    assert abs(spread.mean() - even.mean()) < 4 * error
