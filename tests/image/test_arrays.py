# SPDX-License-Identifier: Apache-2.0
"""Operations on images."""

import errno
import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from oiio_msspl import MssplError
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.image import arrays
from oiio_msspl.image.arrays import box_downsample, filled


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_means_are_exact_and_finite_up_to_the_largest_value(dtype):
    """Also where the sum of the pixels does not fit into their type."""
    image = np.full((8, 8, 3), np.finfo(dtype).max, dtype)
    image[4:] = 0.1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        means = box_downsample(image, 4)
    assert means.dtype == np.float32
    np.testing.assert_allclose(means[1], np.float32(dtype(0.1)), rtol=1e-6)
    # Sums of floats are limited
    expected = np.float32(65504) if dtype is np.float16 else np.finfo(np.float32).max / 16
    np.testing.assert_allclose(means[0], expected, rtol=1e-6)


@pytest.mark.parametrize("size", [(64, 64), (37, 51), (5, 29)])
def test_missing_pixels_are_filled_from_those_around(size):
    ramp = np.linspace(1, 2, size[1], dtype=np.float32)[None, :, None] * np.ones((*size, 3), np.float32)
    missing = np.zeros(size, bool)
    missing[size[0] // 3 : size[0] // 3 + 12, size[1] // 3 : size[1] // 3 + 5] = True
    image = np.where(missing[..., None], np.float32(0), ramp)
    result = filled(image, missing)
    np.testing.assert_array_equal(result[~missing], ramp[~missing])
    assert np.abs(result - ramp)[missing].max() < 0.2


def test_without_any_known_pixel_nothing_is_filled():
    image = np.zeros((5, 7, 3), np.float32)
    assert filled(image, np.ones((5, 7), bool)) is image
    assert filled(image, np.zeros((5, 7), bool)) is image


def test_unloaded_images_keep_their_pixels(monkeypatch):
    monkeypatch.setattr(arrays, "MOST_PIXELS", 10)
    image = np.random.default_rng(0).random((64, 64, 3), np.float32)
    on_disk = arrays.kept(image)
    assert on_disk is not image and isinstance(on_disk, np.memmap)
    for _ in range(2):
        arrays.unload(on_disk)
        np.testing.assert_array_equal(on_disk, image)
    arrays.unload(image)  # in memory: nothing happens
    np.testing.assert_array_equal(on_disk, image)


@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.parametrize("on_disk", [False, True])
def test_images_that_wait_keep_their_layout_in_memory(interleaved, on_disk):
    image = arrays.blank((20, 30, 3), interleaved=interleaved)
    assert np.ascontiguousarray(image).strides == image.strides if interleaved else image[..., 1].flags.c_contiguous
    kept = arrays.kept(image, on_disk=on_disk)
    assert kept.strides == image.strides
    assert arrays.kept(kept, on_disk=True) is kept or not on_disk  # it is in a file already


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_an_error_and_does_not_end_the_process(monkeypatch, code):
    def full(*arguments):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    monkeypatch.setattr(arrays, "MOST_PIXELS", 10)
    with pytest.raises(MssplError, match=r"no room for \d+ MB of temporary files .* TMPDIR") as raised:
        arrays.blank((100, 100, 3))
    assert raised.value.exit_code == 1
    pixels = ReplacedChannels()
    with pytest.raises(MssplError, match="no room"):
        pixels.add([Channel(Path("a.exr"), 0, 0, "R", "float")], 100, 100)


@pytest.mark.parametrize("there", [True, False])
def test_images_are_black_on_disks_that_can_not_take_room_in_advance(monkeypatch, there):
    def unknown(*arguments):
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    if there:
        monkeypatch.setattr(os, "posix_fallocate", unknown, raising=False)
    else:
        monkeypatch.delattr(os, "posix_fallocate", raising=False)
    monkeypatch.setattr(arrays, "MOST_PIXELS", 10)
    image = arrays.blank((20, 30, 3))
    assert image.shape == (20, 30, 3) and not image.any()
    image[19, 29] = 1
    assert image.sum() == 3
