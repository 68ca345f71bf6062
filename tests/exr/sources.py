# SPDX-License-Identifier: Apache-2.0
"""Renders with layers of all kinds, and the file that is written from each."""

import numpy as np
import OpenEXR

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.contents import FileContents
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.exr.writer import write_fused
from tests.conftest import picture, read_bits, rgb, write_exr

H, W = 70, 40


def everything(seed=0):
    """Layers of all types with every bit pattern that survives: NaN payloads, infinities, denormals, big integers."""
    rng = np.random.default_rng(seed)
    beauty = picture(H, W).astype(np.float16)
    ids = rng.integers(0, 2**32, (H, W), dtype=np.uint32)
    return rgb(beauty) | {
        "A": np.ones((H, W), np.float16),
        "Z": rng.integers(0, 2**32, (H, W), dtype=np.uint32).view(np.float32),
        "crypto00.R": rng.integers(0, 2**32, (H, W), dtype=np.uint32).view(np.float32),
        "crypto00.G": rng.random((H, W), dtype=np.float32),
        "id.X": ids,
        "mask.matte": rng.integers(0, 2**16, (H, W), dtype=np.uint16).view(np.float16),
        "albedo.R": beauty[..., 0].astype(np.float32),
        "albedo.G": beauty[..., 1],
        "albedo.B": beauty[..., 2],
    }


def written(tmp_path, parts, options=None, **attributes):
    """Write a fused frame over a file; returns the fused colour, and what OpenEXR reads back."""
    hr = map_render(open_exr(write_exr(tmp_path / "hr.exr", parts, **attributes)))
    size = hr.data_window.height, hr.data_window.width
    fused = np.full((*size, 3), 0.1, np.float32) + np.arange(3, dtype=np.float32)
    alpha = np.full((*size, 1), 0.25, np.float32) if hr.alpha else None
    write_beside(hr, options, fused, alpha, {"msspl/model": "test"}, overwrite=True)
    return fused, tmp_path / "out.exr", read_bits(tmp_path / "out.exr")


def write_beside(hr, options=None, image=None, alpha=None, attributes=(), overwrite=False, **more):
    """Write a fused frame, white unless ``image`` is given, as out.exr beside its HRLS; returns what is said of it."""
    image = np.ones((hr.data_window.height, hr.data_window.width, 3), np.float32) if image is None else image
    out, options = hr.file.path.with_name("out.exr"), options or WriteOptions()
    contents = FileContents(hr.file, hr.beauty_channels, options, image, alpha, attributes=dict(attributes), **more)
    return write_fused(out, contents, overwrite=overwrite)


def behind_a_deep_part(path, channels, deep=("A", "Z")):
    """Write a file whose first part has ``deep`` channels, and whose second one has flat ``channels``. Both have names
    that name no layer."""
    height, width = next(iter(channels.values())).shape
    samples = np.empty((height, width), dtype=object)
    for index in np.ndindex(height, width):
        samples[index] = np.ones(2, np.float32)
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    first = OpenEXR.Part(header, {name: samples.copy() for name in deep}, "default")
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with OpenEXR.File([first, OpenEXR.Part({"type": OpenEXR.scanlineimage}, planes, "rgba")]) as file:
        file.write(str(path))
    return path


def flat(parts):
    """{(layer, channel's last name): plane} whatever part it lies in."""
    result = {}
    for name, channels in parts:
        for channel, plane in channels.items():
            layer, _, component = channel.rpartition(".")
            result[(layer or name, component)] = plane
    return result


def plain(seed):
    return np.random.default_rng(seed).random((H, W), dtype=np.float32)


def karma():
    """Parts that carry the layer in their name alone."""
    return [
        ("C", rgb(picture(H, W)) | {"A": plain(0)}, (0, 0)),
        ("albedo", rgb(picture(H, W) * 2), (0, 0)),
        ("crypto00", {c: plain(i) for i, c in enumerate("RGBA")}, (0, 0)),
        ("depth", {"Z": plain(9)}, (0, 0)),
    ]


def stereo():
    """Two views in one part, as OpenEXR's multiView convention names them."""
    return rgb(picture(H, W)) | {
        "A": plain(0),
        **{f"left.{c}": plain(i + 1) for i, c in enumerate("RGBA")},
        "diffuse.right.R": plain(6),
        "diffuse.left.R": plain(7),
        "left.Z": plain(8),
    }


def doubles():
    """Channels that mean the same to us: foo.r and foo.red beside foo.R."""
    return rgb(picture(H, W)) | {"foo.R": plain(1), "foo.r": plain(2), "foo.red": plain(3)}


def beside():
    """A part of half, float and uint channels beside that of the beauty."""
    rest = {name: plane for name, plane in everything().items() if name not in "RGBA"}
    return [("rgba", rgb(picture(H, W)), (0, 0)), ("rest", rest, (0, 0))]


SOURCES = {name: (make(), {}) for name, make in (("everything", everything), ("karma", karma), ("doubles", doubles))}
SOURCES |= {"stereo": (stereo(), {"multiView": ["right", "left"]}), "beside": (beside(), {})}
