# SPDX-License-Identifier: Apache-2.0
"""Training samples from rendered views.

A view is an uncompressed ``.npz`` with

* ``hr``: float16 (P, H, W, 15), P independent 1-spp passes of rgb, albedo, normal, diffuse, specular, three channels
  each;
* ``lr``: float16 (Q, H, W, 3), colour alone, also at full resolution and independent of ``hr``; ``lr_spp``: int (Q,);
  or, where the pixel filter is wider than a pixel, for each scale s ``lr_x<s>``: float16 (Q, H/s, W/s, 3), rendered at
  1/s of the resolution with s^2 times ``lr_spp``, so that the filter is that of its own larger pixels;
* ``ref``: float16 (H, W, 3), the reference colour;
* ``meta``: a JSON string with ``split``: ``train``, ``validation`` or ``test``; and ``seed``, which tells scenes apart.

Because passes are kept apart, one view yields many different pairs: an HRLS of n spp is the mean of any n passes, and
an LRHS of scale s is the box average over s x s pixels of any ``lr`` passes, which is a render of s^2 times their spp
at 1/s of the resolution, or the mean of any ``lr_x<s>`` passes.
"""

from __future__ import annotations

import json
import logging
import math
import mmap
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl import schema, tensors, transforms
from training import views

Array = NDArray[np.float32]
log = logging.getLogger(__name__)

#: Height and width of the HR patch for each scale, as in the paper.
PAPER_PATCH = {2: 96, 4: 192, 8: 256}

#: Features that a renderer writes, in the channel order of ``hr``: all but the variance, which comes from the passes.
PASS_FEATURES = tuple(name for name in schema.HRLS_FEATURES if name != schema.VARIANCE)


@dataclass(frozen=True)
class Sampling:
    """How training pairs are drawn: the renderings they imitate and the augmentations. Shares are probabilities."""

    hrls_spp: tuple[float, ...] = (0.22, 0.2, 0.12, 0.2, 0.05, 0.06, 0.05, 0.1)
    """Weight of 1, 2, 3, ... spp in the HRLS; low ones are the hard and the useful case."""
    lrhs_passes: tuple[float, ...] = (0.65, 0.2, 0.05, 0.05, 0.05)
    """Weight of 1, 2, 3, ... ``lr`` passes in the LRHS."""
    clip: float = math.inf
    """Radiance is clipped here, before anything else. The log curve can do without."""
    nearest: float = 0.15
    """Share with the paper's nearest-neighbour LRHS instead of the box average that a renderer's pixel filter makes."""
    exposure_stops: float = 0.5
    """Exposure jitter, plus or minus: inference may estimate the exposure from another crop or frame."""
    gain_stops: float = 0.5
    """Colour of the light: a gain per channel, plus or minus. Applied to radiance alone: albedo is no light."""
    permute: float = 0.5
    """Share with shuffled colour channels, albedo included: the same scene with its wavelengths renamed."""
    grey: float = 0.05
    """Share with r = g = b in all radiance; the model also serves single-channel layers."""
    drop_each: float = 0.1
    """Share in which an optional feature is absent, for each on its own."""
    drop_lobes: float = 0.5
    """Share without diffuse and specular: many renderers have neither."""
    drop_variance: float = 0.7
    """Hardly any renderer writes it."""
    drop_all: float = 0.05


#: ``Sampling`` as close to the paper's as its text tells: crops alone, every layer, clipped, nearest-neighbour LRHS.
PAPER_SAMPLING = Sampling(
    hrls_spp=(1.0,) * 8,
    clip=100.0,
    nearest=1.0,
    exposure_stops=0.0,
    gain_stops=0.0,
    permute=0.0,
    grey=0.0,
    drop_each=0.0,
    drop_lobes=0.0,
    drop_variance=0.0,
    drop_all=0.0,
)


# Views


def map_npz(path: Path) -> dict[str, NDArray]:
    """Arrays of an uncompressed ``.npz`` as views of the mapped file: nothing is read until it is indexed.

    Raises:
        ValueError, zipfile.BadZipFile: the file is incomplete, or compressed.
    """
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)  # writable in memory, as PyTorch wants it
        arrays = {}
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{path}: {member.filename} is compressed; write it with numpy.savez")
            # The local header repeats name and extra field with lengths of its own, in its last two shorts.
            name_length, extra_length = struct.unpack_from("<HH", mapped, member.header_offset + 26)
            file.seek(member.header_offset + 30 + name_length + extra_length)
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran, dtype = header(file)
            arrays[member.filename.removesuffix(".npy")] = np.ndarray(
                shape, dtype, buffer=mapped, offset=file.tell(), order="F" if fortran else "C"
            )
    return arrays


def clean_reference(path: Path) -> Path:
    """Where :mod:`training.references` puts the denoised reference of a view's file."""
    return path.with_suffix(".ref.npy")


class View:
    """One rendered view; its arrays stay on disk."""

    def __init__(self, path: Path) -> None:
        arrays = map_npz(path)
        meta = json.loads(str(arrays["meta"]))
        self.path = path
        self.meta: dict[str, Any] = meta
        self.split: str = meta["split"]
        self.scene: str = str(meta["seed"])
        self.source: str = f"{meta.get('renderer', 'unknown renderer')}, generator {meta.get('generator', '?')}"
        """What rendered it, for the provenance of what is trained on it."""
        self.hr, self.ref = arrays["hr"], arrays["ref"]
        self.lr: dict[int, NDArray] = {
            scale: arrays[key] for scale in (1, *schema.SCALES) if (key := views.lr_key(scale)) in arrays
        }
        """Passes of the LRHS by scale: those at full resolution, or those of every other."""
        if clean_reference(path).exists():
            self.ref = np.load(clean_reference(path), mmap_mode="c")
        self.lr_spp = np.asarray(arrays["lr_spp"], dtype=np.int64)
        channels = sum(schema.HRLS_FEATURES[name] for name in PASS_FEATURES)
        shapes = {scale: passes.shape for scale, passes in self.lr.items()}
        if (
            self.hr.ndim != 4
            or self.hr.shape[-1] != channels
            or not (1 in shapes or shapes.keys() >= set(schema.SCALES))
            or any(shape[0] != len(self.lr_spp) for shape in shapes.values())
        ):
            raise ValueError(f"{path}: hr is {self.hr.shape}, lr {shapes}, lr_spp {self.lr_spp.shape}")


class Folder:
    """All views of a folder, found again by :meth:`scan` while a renderer still adds to it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._views: dict[Path, View] = {}
        self.scan()

    def scan(self) -> None:
        """Pick up new views; hidden files are still being written. One that can't be read is tried again next time."""
        for path in sorted(self.root.glob("[!.]*.npz")):
            if path not in self._views:
                try:
                    self._views[path] = View(path)
                except (ValueError, KeyError, OSError, struct.error, zipfile.BadZipFile) as error:
                    log.warning("skipped %s: %s", path.name, error)

    def split(self, name: str) -> list[View]:
        """Views of one split, by name."""
        return [view for _, view in sorted(self._views.items()) if view.split == name]


# One pair


def random_orthogonal(rng: np.random.Generator, determinant: int) -> Array:
    """Uniformly random 3x3 rotation (determinant 1) or rotation with a mirroring (-1)."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q *= np.sign(np.diag(r))  # makes the decomposition unique, thereby q uniform
    if np.linalg.det(q) * determinant < 0:
        q[:, 0] *= -1
    return q.astype(np.float32)


def split_features(passes: Array) -> dict[str, Array]:
    """(..., 15) in the channel order of ``hr`` to named features."""
    features, start = {}, 0
    for name in PASS_FEATURES:
        features[name] = passes[..., start : start + schema.HRLS_FEATURES[name]]
        start += schema.HRLS_FEATURES[name]
    return features


def read(values: NDArray, *, signed: bool = False) -> Array:
    """Stored half floats as finite float32; radiance and albedo non-negative."""
    return transforms.repair(values.astype(np.float32), signed=signed)[0]


def mean_lrhs(view: View, passes: NDArray[np.int64] | list[int], scale: int, *, nearest: bool = False) -> Array:
    """An LRHS of the whole view, (H // s, W // s, 3): the mean of some ``lr`` passes, each weighted by its spp.

    ``nearest`` takes one pixel of s x s, as the paper does, where the passes have full resolution.
    """
    weights = view.lr_spp[passes] / view.lr_spp[passes].sum()
    stored = view.lr[scale if scale in view.lr else 1]
    mean = np.einsum("p,phwc->hwc", weights.astype(np.float32), read(stored[passes]))
    if scale in view.lr:
        return mean
    if nearest:
        return mean[scale // 2 :: scale, scale // 2 :: scale]
    height, width = (n // scale * scale for n in mean.shape[:2])
    return transforms.box_downsample(mean[:height, :width], scale)


def read_hrls(view: View, passes: NDArray[np.int64] | list[int], rows: slice, columns: slice) -> Array:
    """Some ``hr`` passes of a crop: (n, H, W, 15)."""
    values = read(np.stack([view.hr[p, rows, columns] for p in passes]), signed=True)
    for name, part in split_features(values).items():
        if name != schema.NORMAL:
            np.maximum(part, 0.0, out=part)
    return values


def spp_range(view: View, sampling: Sampling, scale: int) -> dict[str, list[int]]:
    """Lowest and highest spp of the pairs that :func:`draw` makes of a view, for the model's contract."""
    samples = scale**2 if sampling.nearest < 1 else 1
    return {
        "hrls": [1, min(len(sampling.hrls_spp), len(view.hr))],
        "lrhs": [max(2, int(view.lr_spp.min()) * samples), int(view.lr_spp.sum()) * samples],
    }


#: What adds to a pair, (h, w, 3) and (s*h, s*w, 16), the further channels that some networks read.
Prepare = Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Evaluation:
    """A fixed pair for validation: the paper's (s^2 - 1), one sample per HR pixel in LRHS and HRLS each."""

    lrhs: Array
    """Transformed (h, w, 3), and what :func:`training.networks.preparation` adds."""
    hrls: Array
    """Transformed (s*h, s*w, 16), every layer but the variance, which one sample does not have; and likewise."""
    reference: Array
    """Linear (s*h, s*w, 3)."""
    exposure: float

    @classmethod
    def centre(cls, view: View, scale: int, patch: int, prepare: Prepare | None = None) -> Evaluation:
        """The middle ``patch`` x ``patch`` pixels of a view."""
        height, width, _ = view.ref.shape
        top, left = (height - patch) // 2 // scale * scale, (width - patch) // 2 // scale * scale
        rows, columns = slice(top, top + patch), slice(left, left + patch)
        lrhs = mean_lrhs(view, [0], scale)
        exposure = transforms.exposure_of(lrhs)
        hrls = tensors.pack(split_features(read_hrls(view, [0], rows, columns)[0]), schema.HRLS_FEATURES, exposure)
        lrhs = lrhs[top // scale : (top + patch) // scale, left // scale : (left + patch) // scale]
        lrhs = transforms.compress(lrhs, exposure)
        if prepare is not None:
            lrhs, hrls = prepare(lrhs, hrls)
        return cls(
            lrhs=lrhs,
            hrls=hrls,
            reference=read(view.ref[rows, columns]),
            exposure=exposure,
        )
