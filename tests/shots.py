# SPDX-License-Identifier: Apache-2.0
"""Small shots that the tests of several folders make for themselves."""

import re

import numpy as np

from oiio_msspl.exr.preview import write_preview
from oiio_msspl.exr.render import Window
from tests.conftest import downsample, noisy, picture, read_bits, rgb, write_exr

HEIGHT, WIDTH = 32, 48


def layers(seed, spp=1):
    """Channels of an HRLS."""
    clean = picture(HEIGHT, WIDTH)
    albedo = rgb((clean > 0.3).astype(np.float16), "albedo.")
    return rgb(noisy(clean, spp, seed).astype(np.float16)) | albedo | {"Z": clean[..., 0]}


def low_layers(seed, scale=4):
    return rgb(noisy(downsample(picture(HEIGHT, WIDTH), scale), 16, seed).astype(np.float16))


def make_shot(folder, count, lr="lr", hr="hr", first=1001):
    """Write pairs at x4, named lr/lr.####.exr and hr/beauty.####.exr, and return ``folder``."""
    for name in (lr, hr):
        (folder / name).mkdir(parents=True)
    for frame in range(first, first + count):
        write_exr(folder / lr / f"lr.{frame}.exr", low_layers(frame))
        write_exr(folder / hr / f"beauty.{frame}.exr", layers(frame))
    return folder


def write_png(path, *, overwrite=False):
    """A preview of ours, black."""
    window = Window(0, 0, 2, 2)
    write_preview(path, np.zeros((2, 2, 3), np.float32), window, window, overwrite=overwrite)


def contents(folder):
    """{name: bytes}, without the date that OpenImageIO gives a file whose source has none."""
    files = (path for path in folder.iterdir() if path.is_file())
    return {path.name: re.sub(rb"\d{4}(:\d\d){2} \d\d(:\d\d){2}", b"", path.read_bytes()) for path in files}


def pixels(folder):
    """{name: stored values} of the EXRs of a folder, for results whose inputs have other paths."""
    return {
        path.name: [(part, {name: x.tobytes() for name, x in channels.items()}) for part, channels in read_bits(path)]
        for path in folder.glob("*.exr")
    }
