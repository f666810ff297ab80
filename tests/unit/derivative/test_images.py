"""Image files: what goes in comes out, and failures leave nothing behind."""

from __future__ import annotations

import os

import numpy as np
import pytest

from psdr_jit.core import files
from psdr_jit.derivative import images
from psdr_jit.errors import OptionError, StorageError


@pytest.fixture
def noise():
    return np.random.default_rng(1).normal(size=(6, 9, 3))


def test_exr_layers_round_trip(tmp_path, noise):
    path = images.write_exr(tmp_path / "a.exr", {"primal": noise, "total": 2 * noise}, {"spp": "7"})
    channels = images.read_exr(path)
    assert set(channels) == {"R", "G", "B", *(f"{n}.{c}" for n in ("primal", "total") for c in "RGB")}
    assert np.array_equal(channels["G"], noise[..., 1].astype(np.float32))
    assert np.array_equal(channels["total.B"], (2 * noise[..., 2]).astype(np.float32))
    assert os.listdir(tmp_path) == ["a.exr"]


def test_exr_is_read_by_mitsuba(tmp_path, noise):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    path = images.write_exr(tmp_path / "a.exr", {"primal": noise, "total": noise})
    layers = dict(mi.Bitmap(str(path)).split())
    assert np.allclose(np.array(layers["total"]), noise, atol=1e-6)


def test_one_channel_image(tmp_path):
    images.write_exr(tmp_path / "y.exr", {"primal": np.ones((4, 5))})
    assert set(images.read_exr(tmp_path / "y.exr")) == {"Y", "primal.Y"}


@pytest.mark.parametrize("colours", ["Y", "YA", "RGB", "RGBA"])
def test_aovs_do_not_pass_for_alpha(tmp_path, noise, colours):
    image = np.concatenate([noise, noise], axis=-1)[..., : len(colours) + 2]
    path = images.write_exr(tmp_path / "a.exr", {"total": image}, aovs=["dd.T", "ss.I"])
    found = images.read_exr(path)
    assert set(found) == {prefix + name for prefix in ("", "total.") for name in (*colours, "dd.T", "ss.I")}
    assert np.array_equal(found["total.dd.T"], image[..., -2].astype(np.float32))


@pytest.mark.parametrize("own", ["Y", "YA", "RGB", "RGBA"])
def test_aovs_and_alpha_are_no_shade_of_grey(own):
    """Depth is tens of times as large as radiance: averaged in, it would be all that there is to see."""
    radiance, depth = np.full((2, 2, 1), 0.25), np.full((2, 2, 2), 40.0)
    image = np.concatenate([radiance] * len(own.rstrip("A")) + [depth[..., :1]] * own.count("A") + [depth], axis=-1)
    seen = images.colours(image, ["dd.T", "ss.I"])
    assert seen.shape[-1] == len(own)
    assert np.all(images.grey(seen) == 0.25)
    assert np.ptp(images.srgb(seen), axis=-1).max() == 0
    assert images.colours(depth, ["dd.T", "ss.I"]).shape == depth.shape, "there is nothing else to see"


def test_layers_of_different_size_are_rejected(tmp_path, noise):
    with pytest.raises(OptionError, match="one size"):
        images.write_exr(tmp_path / "a.exr", {"primal": noise, "total": noise[:3]})
    assert not os.listdir(tmp_path)


def test_png(tmp_path, noise):
    path = images.write_derivative_png(tmp_path / "d.png", noise, "title")
    assert path.read_bytes()[:4] == b"\x89PNG"
    images.write_panels(tmp_path / "p.png", [("primal", "a", abs(noise)), ("derivative", "b", 0 * noise)])
    assert sorted(os.listdir(tmp_path)) == ["d.png", "p.png"]


def test_colour_scale_ignores_single_fireflies(noise):
    noise[0, 0, 0] = 1e6
    assert images.robust_limit([noise]) < 5
    assert images.robust_limit([np.zeros((2, 2))]) == 1
    assert images.robust_limit([np.array([np.nan, 2.0])]) == 2


@pytest.mark.parametrize("name, words", [("missing/a.exr", "does not exist"), (".", "is a folder")])
def test_unwritable_path_is_named(tmp_path, name, words):
    with pytest.raises(OptionError, match=words) as caught:
        images.check_writable(tmp_path / name)
    assert str(tmp_path) in str(caught.value)
    assert not os.listdir(tmp_path)


def test_failure_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "a.png"
    path.write_text("old")

    def fail(temporary):
        with open(temporary, "w") as file:
            file.write("half")
        raise error

    for error, expected in ((RuntimeError("a defect"), RuntimeError), (OSError(28, "No space left"), StorageError),
                            (RuntimeError("Mitsuba: No space left on device"), StorageError)):  # fmt: skip
        with pytest.raises(expected):
            files.replace(path, fail)
        assert path.read_text() == "old"
        assert os.listdir(tmp_path) == ["a.png"]
