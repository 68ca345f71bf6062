# SPDX-License-Identifier: Apache-2.0
"""Decoded rows are shared by neighbouring windows, within a number of bytes."""

import numpy as np
import OpenEXR
import pytest

from oiio_msspl.exr import reader
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.exr.render import Window
from oiio_msspl.exr.strips import ROWS_PER_STRIP, strip_rows
from oiio_msspl.image.arrays import file_of
from tests.conftest import picture, rgb, same_bits, write_exr

HEIGHT, WIDTH = 300, 40


@pytest.fixture
def decoded(monkeypatch):
    """The rows of every strip that is decoded, in order."""
    rows = []
    decode = ExrFile._decode

    def recording(file, part, y0, y1, *others):
        rows.append((y0, y1))
        return decode(file, part, y0, y1, *others)

    monkeypatch.setattr(ExrFile, "_decode", recording)
    return rows


def windows(overlap=10):
    """Three rows of four windows, from left to right and from top to bottom, that overlap."""
    whole = Window(0, 0, WIDTH, HEIGHT)
    for y in range(0, HEIGHT, 100):
        for x in range(0, WIDTH, 10):
            yield Window(x - overlap, y - overlap, x + 10 + overlap, y + 100 + overlap).intersect(whole)


def mixed():
    """Half and float channels, whose order in the file is not that of their types."""
    values = picture(HEIGHT, WIDTH)
    return rgb(values.astype(np.float16)) | {"Z": values[..., 0]} | rgb(values.astype(np.float16) * 2, "albedo.")


def tiled(path):
    """The channels of ``mixed`` in tiles of 16 x 16 pixels."""
    tile = OpenEXR.TileDescription()
    tile.xSize = tile.ySize = 16
    header = {"type": OpenEXR.tiledimage, "tiles": tile, "compression": OpenEXR.ZIP_COMPRESSION}
    with OpenEXR.File(header, {name: np.ascontiguousarray(plane) for name, plane in mixed().items()}) as file:
        file.write(str(path))
    return path


def strip_bytes(rows):
    """Bytes of so many rows of R, G and B in half."""
    return rows * WIDTH * 3 * 2


def bytes_kept(file):
    return sum(strip.nbytes for strip in file._cache.values())


@pytest.mark.parametrize("storage", ["zip", "dwab", "tiles"])
@pytest.mark.parametrize("max_bytes", [0, strip_bytes(70), 10**6])
def test_windows_have_the_same_pixels_whatever_is_kept(tmp_path, storage, max_bytes):
    path = tmp_path / "a.exr"
    if storage == "tiles":
        tiled(path)
    else:
        write_exr(path, mixed(), compression=getattr(OpenEXR, f"{storage.upper()}_COMPRESSION"))
    file = open_exr(path)
    part = file.parts[0]
    names = {c.name: c for c in part.channels}
    wanted = [names[n] for n in ("albedo.B", "R", "Z", "G")]
    whole = file.read(wanted, part.data_window)
    with file.cache_strips(max_bytes):
        for window in windows():
            np.testing.assert_array_equal(file.read(wanted, window), whole[window.slices(part.data_window)])


def test_a_row_of_windows_decodes_each_row_once(tmp_path, decoded):
    """Twelve windows that overlap decode every strip once; without a cache, every window decodes its own
    rows."""
    file = open_exr(write_exr(tmp_path / "a.exr", rgb(picture(HEIGHT, WIDTH).astype(np.float16))))
    channels = file.parts[0].channels
    with file.cache_strips(10**6):
        for window in windows():
            file.read(channels, window)
    assert len(decoded) == len(set(decoded)) == -(-HEIGHT // ROWS_PER_STRIP)
    decoded.clear()
    for window in windows():
        file.read(channels, window)
    rows = [(window.y0, window.y1) for window in windows()]
    assert sum(y1 - y0 for y0, y1 in decoded) == sum(y1 - y0 for y0, y1 in rows)


def test_no_more_is_kept_than_was_allowed(tmp_path, decoded):
    """Room for one strip of three: that one is decoded once, the others for each window."""
    file = open_exr(write_exr(tmp_path / "a.exr", rgb(picture(150, WIDTH).astype(np.float16))))
    limit = strip_bytes(ROWS_PER_STRIP)
    with file.cache_strips(limit):
        for x in range(0, WIDTH, 10):
            file.read(file.parts[0].channels, Window(x, 0, x + 10, 150))
            assert bytes_kept(file) == limit
    assert decoded.count((0, 64)) == 1
    assert decoded.count((64, 128)) == 4


def test_half_stays_half_until_it_is_read_though_a_float_channel_lies_between(tmp_path):
    file = open_exr(write_exr(tmp_path / "a.exr", mixed()))
    names = {c.name: c for c in file.parts[0].channels}
    wanted = [names[n] for n in ("R", "albedo.B")]
    assert abs(names["R"].index - names["albedo.B"].index) > 1
    with file.cache_strips(10**6):
        pixels = file.read(wanted, Window(0, 0, 5, 64))
        assert pixels.dtype == np.float32
        assert bytes_kept(file) == ROWS_PER_STRIP * WIDTH * 2 * 2


def test_rows_are_forgotten_when_others_are_read_and_when_the_block_ends(tmp_path):
    file = open_exr(write_exr(tmp_path / "a.exr", rgb(picture(HEIGHT, WIDTH).astype(np.float16))))
    channels = file.parts[0].channels
    with file.cache_strips(10**6):
        file.read(channels, Window(0, 0, 5, 128))
        assert bytes_kept(file) == strip_bytes(128)
        file.read(channels, Window(0, 128, 5, 192))
        assert bytes_kept(file) == strip_bytes(64)
    assert bytes_kept(file) == 0
    file.read(channels, Window(0, 0, 5, 5))
    assert bytes_kept(file) == 0


def test_layers_in_other_files_share_the_cache(tmp_path, decoded):
    """One file an AOV: all files together stay within the limit, and each row of each is decoded once."""
    files = [
        open_exr(write_exr(tmp_path / name, rgb(picture(64, WIDTH).astype(np.float16)))) for name in ("a.exr", "b.exr")
    ]
    files[0].siblings[files[1].path] = files[1]
    wanted = [*files[0].parts[0].channels, *files[1].parts[0].channels]
    with files[0].cache_strips(10**6):
        for x in range(0, WIDTH, 10):
            files[0].read(wanted, Window(x, 0, x + 10, 64))
        assert bytes_kept(files[0]) == 2 * strip_bytes(64)
    assert decoded == [(0, 64), (0, 64)]


def test_strips_begin_on_chunks_of_the_part():
    """Data windows begin anywhere, also above 0; strips count from their first row and cover what is asked for."""
    assert list(strip_rows(-31, 37, -100, 64, 50)) == [(-36, 28), (28, 50)]
    assert list(strip_rows(0, 10, 0, 64, 10)) == [(0, 10)]


@pytest.mark.parametrize(("compression", "rows"), [("ZIPS", 64), ("ZIP", 64), ("PIZ", 64), ("DWAB", 256)])
def test_a_strip_holds_whole_chunks(tmp_path, compression, rows):
    """DWAB compresses 256 rows together: shorter strips would decode each chunk several times."""
    code = getattr(OpenEXR, f"{compression}_COMPRESSION")
    file = open_exr(write_exr(tmp_path / "a.exr", rgb(picture(300, 8)), compression=code))
    assert file.parts[0].strip_height == rows


@pytest.mark.parametrize("on_disk", [False, True])
def test_whole_channels_are_decoded_once_and_copied_bit_for_bit(tmp_path, decoded, on_disk):
    """Half, float and uint channels alternate in one part; NaN keep their payload."""
    random = np.random.default_rng(0)
    bits = {name: random.integers(0, 1 << 16, (70, 9), dtype=np.uint16).view(np.float16) for name in ("a.x", "c.x")}
    bits |= {"b.x": random.integers(0, 1 << 32, (70, 9), dtype=np.uint32).view(np.float32)}
    bits |= {"d.x": random.integers(0, 1 << 32, (70, 9), dtype=np.uint32)}
    file = open_exr(write_exr(tmp_path / "mixed.exr", bits))
    (part,) = file.parts
    for channel, plane in file.native_planes(part, part.channels, on_disk=on_disk).items():
        assert same_bits(plane, bits[channel.name])
        assert (file_of(plane) is not None) == on_disk
    assert len(decoded) == 2 * 3  # two strips, three pixel types


def test_strips_of_many_channels_have_fewer_rows(tmp_path, monkeypatch):
    file = open_exr(write_exr(tmp_path / "a.exr", rgb(picture(300, 8)), compression=OpenEXR.ZIP_COMPRESSION))
    row = file.parts[0].nbytes // 300
    for largest, rows in ((1, 16), (40 * row, 32), (1000 * row, 64)):
        monkeypatch.setattr(reader, "LARGEST_STRIP", largest)
        assert file.parts[0].strip_height == rows
