# SPDX-License-Identifier: Apache-2.0
"""Where images are stored."""

import errno
import mmap
import os
from pathlib import Path

import numpy as np
import pytest

from oiio_msspl import MssplError
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.image import arrays


def test_unloaded_images_keep_their_pixels(monkeypatch):
    monkeypatch.setattr(arrays, "MOST_PIXELS", 10)
    image = np.random.default_rng(0).random((64, 64, 3), np.float32)
    on_disk = arrays.kept(image)
    assert on_disk is not image and arrays.file_of(on_disk) is not None
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


def test_an_image_in_a_file_keeps_its_pixels_where_memory_can_not_be_given_back(monkeypatch):
    """As on Windows, whose memory maps take no advice."""
    monkeypatch.delattr(mmap, "MADV_DONTNEED", raising=False)
    image = arrays.blank((20, 30, 3), on_disk=True)
    image[:] = 7
    arrays.unload(image)
    assert (image == 7).all()
