# SPDX-License-Identifier: Apache-2.0
"""Fuses a frame or a shot from arrays, and chooses the model itself."""

from __future__ import annotations

import functools
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.render import Render
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.fuse import FusedFrame, fuse
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.arrays import Array, planes_of
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.plan import AUTO, TemporalOptions
from oiio_msspl.jobs.settings import family_for_noise
from oiio_msspl.jobs.shot import fuse_shot
from oiio_msspl.model.catalogue import DEFAULT_QUALITY, QUALITIES, load_model

#: The channels of some layers in temporary files. Others have R, G and B behind their name.
_CHANNELS = {"rgb": ("R", "G", "B"), "alpha": ("A",), "motion": ("motion.x", "motion.y")}
#: How :class:`ArrayFrame` stores motion vectors.
_MOTION = "layer=motion,to=next,x=right,y=down,unit=pixels,scale=1,offset=0"

_load_once = functools.cache(load_model)


def fuse_arrays(
    hr: Array,
    lr: Array | None = None,
    *,
    albedo: Array | None = None,
    normal: Array | None = None,
    alpha: Array | None = None,
    variance: Array | None = None,
    quality: str = DEFAULT_QUALITY,
    device: str = "cpu",
    threads: int = 0,
) -> FusedFrame:
    """Remove the noise of a render, or of two renders of the same frame together.

    The model is one for renders of these sizes, and for their noise.

    Args:
        hr: (height, width, 3), scene linear.
        lr: a second render with noise of its own: low-resolution with more samples per pixel, (height / s, width / s,
            3) with s = 2, 4 or 8, or one of the same size. None if there is one render.
        albedo, normal: of ``hr``, (height, width, 3); normals from -1 to 1.
        alpha: of ``hr``, (height, width, 1). It is fused if there is one render, and else kept.
        variance: of the pixels' means of ``hr``, (height, width, 3). It keeps detail of one render that no other layer
            shows.
        quality: ``fast``, ``balanced`` or ``best``.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`, such as ``cpu`` or ``cuda``.
        threads: CPU threads; 0 for one on each core.

    Returns:
        The fused frame: ``rgb`` (height, width, 3), and warnings.

    Raises:
        ValueError: an array has another shape than it must have, or no floats.
        InputError: the arrays do not fit together, there is no such quality, or the device can't be used.
    """
    if quality not in QUALITIES:
        raise InputError(f"quality {quality!r}: use one of {', '.join(QUALITIES)}")
    aovs = {name: image for name, image in (("albedo", albedo), ("normal", normal)) if image is not None}
    more = {name: image for name, image in (("alpha", alpha), ("variance", variance)) if image is not None}
    high = Render.from_arrays("hr", rgb=hr, **aovs, **more)
    low = high if lr is None else Render.from_arrays("lr", rgb=lr)
    alignment = align(low, high)
    family = QUALITIES[quality if aovs else min(quality, DEFAULT_QUALITY, key=list(QUALITIES).index)]
    family, _ = family_for_noise(family, low, high, alignment)
    return fuse(low, high, _load_once(alignment.scale, family, device, threads))


@dataclass(frozen=True)
class ArrayFrame:
    """A frame of a shot, rendered, as arrays of floats. All but ``lr`` and ``lr_passes`` are of ``hr``."""

    hr: Array
    """(height, width, 3), scene linear."""
    lr: Array | None = None
    """A second render with noise of its own, as for :func:`fuse_arrays`."""
    albedo: Array | None = None
    """(height, width, 3)."""
    normal: Array | None = None
    """(height, width, 3), from -1 to 1."""
    alpha: Array | None = None
    """(height, width, 1)."""
    variance: Array | None = None
    """(height, width, 3), of the pixels' means."""
    motion: Array | None = None
    """(height, width, 2): from a pixel to the place of its surface in the next frame, in pixels, as (x, y) with y
    downwards. NaN where it is not known."""
    passes: Mapping[str, Array] = field(default_factory=dict)
    """Layers (height, width, 3) that sum to ``hr``, by name."""
    lr_passes: Mapping[str, Array] = field(default_factory=dict)
    """The same layers of ``lr``. Those that it lacks keep more noise."""


@dataclass(frozen=True)
class FusedArrays:
    """A frame of a shot, fused, as float32 arrays."""

    rgb: Array
    """(height, width, 3), scene linear."""
    alpha: Array | None
    """(height, width, 1)."""
    passes: dict[str, Array]
    """(height, width, 3) each. They sum to ``rgb``."""
    warnings: list[Finding]


def fuse_array_shot(
    frames: Iterable[ArrayFrame],
    *,
    temporal: str | int = AUTO,
    quality: str = DEFAULT_QUALITY,
    device: str = "cpu",
    threads: int = 0,
) -> Iterator[FusedArrays]:
    """Fuse the frames of a shot, each with its neighbours, and their passes.

    The frames are one after the other in time, and all have the same arrays. They wait in temporary files, so memory
    holds few of them. A single frame is a shot, too.

    Args:
        frames: in their order.
        temporal: as for :func:`oiio_msspl.fuse_shot`.
        quality, device, threads: as for :func:`fuse_arrays`.

    Yields:
        The frames in their order, when all are fused.

    Raises:
        ValueError: an array has another shape than it must have, or no floats.
        InputError: the arrays of a frame do not fit together, or an option is wrong. ``hr.0002.exr`` is ``hr`` of the
            second frame.
        MssplError: the network failed, or the disk has no room.
    """
    with tempfile.TemporaryDirectory(prefix="msspl-") as name:
        folder = Path(name)
        names: list[str] = []
        number, with_lr, moves = 0, False, False
        for number, frame in enumerate(frames, 1):
            names, with_lr = list(frame.passes), frame.lr is not None
            aovs = {name: getattr(frame, name) for name in ("albedo", "normal", "alpha", "variance")}
            motion = {} if frame.motion is None else {"motion": np.asarray(frame.motion)}
            moves |= any(np.any(vectors) for vectors in motion.values())
            _write(folder / f"hr/hr.{number:04d}.exr", frame.hr, aovs, {**frame.passes, **motion})
            if frame.lr is not None:
                _write(folder / f"lr/lr.{number:04d}.exr", frame.lr, {}, frame.lr_passes)
        if not number:
            return
        report = fuse_shot(
            folder / "lr" if with_lr else None,
            folder / "hr",
            folder / "out",
            inputs=InputOptions(sums=(f"passes={'+'.join(names)}",) if names else ()),
            write=WriteOptions(pixel_type="float"),
            temporal=TemporalOptions(temporal, _MOTION if moves else None),
            model=quality,
            device=device,
            threads=threads,
        )
        for result in report.results.values():
            if result.exit_code:
                raise (InputError if result.exit_code == 2 else MssplError)(result.message)
        for result in report.results.values():
            yield _read(result.output, names, result.warnings)


def _write(path: Path, rgb: Array, aovs: Mapping[str, Array | None], layers: Mapping[str, Array]) -> None:
    """Write a render of a shot with more layers, without compression."""
    import OpenEXR

    features = {name: image for name, image in aovs.items() if image is not None}
    render = Render.from_arrays(path.name, rgb=rgb, **features)
    planes: dict[str, Array] = {}
    for name, image in (render.layers | {key: np.asarray(value) for key, value in layers.items()}).items():
        if name in layers and (name in render.layers or re.fullmatch(r"[\w-]+", name) is None):
            raise InputError(f"{path.name}: pass {name!r}: give it a name of its own, of letters, digits, _ and -")
        channels = _channels_of(name)
        expected = (*rgb.shape[:2], len(channels))
        if image.shape != expected:
            raise InputError(f"{path.name}: {name} has the shape {image.shape}, and not {expected}")
        planes |= zip(channels, planes_of(image).astype(np.float32, copy=False), strict=True)
    path.parent.mkdir(exist_ok=True)
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with OpenEXR.File(header, planes) as file:
            file.write(str(path))
    except Exception as error:
        raise MssplError(f"{path}: can't be written ({error}); is the disk full?") from error


def _read(path: str, passes: Sequence[str], warnings: list[Finding]) -> FusedArrays:
    """Read a fused frame."""
    file = open_exr(path)
    stored = {channel.name: channel for part in file.parts for channel in part.channels}
    names = ("rgb", *(["alpha"] if "A" in stored else []), *passes)
    images = {name: file.read([stored[key] for key in _channels_of(name)], file.display_window) for name in names}
    return FusedArrays(images.pop("rgb"), images.pop("alpha", None), images, warnings)


def _channels_of(layer: str) -> Sequence[str]:
    """Return the names of a layer's channels in the files."""
    return _CHANNELS.get(layer) or [f"{layer}.{component}" for component in "RGB"]
