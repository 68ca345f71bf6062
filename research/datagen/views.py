# SPDX-License-Identifier: Apache-2.0
"""Rendered views: the file format that every generator writes and training reads.

A view is one camera of one scene, an uncompressed ``.npz`` file named ``<renderer>-<seed>-<view>.npz`` with

* ``hr``: float16 (P, H, W, 15), P independent 1-spp passes of colour, albedo, normal, diffuse and specular, three
  channels each;
* ``lr``: float16 (Q, H, W, 3), colour at full resolution, independent of ``hr``;
* or, if the pixel filter is wider than a pixel, ``lr_x2``, ``lr_x4`` and ``lr_x8`` instead: float16 (Q, H/s, W/s, 3),
  colour rendered at 1/s of the resolution with s^2 times ``lr_spp``, so that the filter spans the larger pixels;
* ``lr_spp``: int (Q,), the samples per pixel of each ``lr`` pass;
* ``ref``: float16 (H, W, 3), the reference colour, independent of ``hr`` and ``lr``;
* ``meta``: a JSON string: seed, view, split, generator version, kind of scene, renderer, assets, exposure.

Colour = diffuse + specular + rest, split by the first scattering event. The rest is transmission, directly visible
emission and the background.

The passes are kept apart, so one view yields many different training pairs. An HRLS of n spp is the mean of any n
``hr`` passes. An LRHS of scale s is the box average over s x s pixels of any ``lr`` passes, which equals a render with
s^2 times their spp at 1/s of the resolution; or it is the mean of any ``lr_x<s>`` passes.

This module needs NumPy and :mod:`oiio_msspl` only, so every renderer's own environment can import it.
"""

from __future__ import annotations

import json
import logging
import mmap
import struct
import zipfile
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import HRLS_FEATURES, NORMAL, VARIANCE
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.image.arrays import repair
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.contract import SCALES
from research.datagen.quality import log_mean

Array = NDArray[np.float32]
log = logging.getLogger(__name__)

#: Height and width of a view in pixels.
SIZE = 256
#: 1-spp passes in ``hr``, and samples per pixel of the passes in ``lr``.
HR_PASSES, LR_SPP = 8, (1, 1, 2, 4, 8)
#: End of the names of views that keep single samples, and cells of their reference per pixel, along each side.
SAMPLES_SUFFIX, REF_CELLS = ".samples.npz", 2
#: Cameras with which a view is rendered, at most, until its reference is clean enough.
RENDERS = 2

#: Features that a renderer writes, in the channel order of ``hr``. The variance is computed from the passes.
PASS_FEATURES = tuple(name for name in HRLS_FEATURES if name != VARIANCE)


# Names


#: The split of views that were rendered without a reference, see ``--ref-spp 0`` of
#: :mod:`research.datagen.mitsuba.render_samples`.
NO_REFERENCE = "no-reference"


def split_of(seed: int) -> str:
    """Return the split of a scene. Whole scenes are held out, never single views of one."""
    return {0: "validation", 1: "test"}.get(seed % 20, "train")


def missing(out: Path, renderer: str, seed: int, count: int, suffix: str = ".npz") -> dict[int, Path]:
    """Return those of a scene's first ``count`` views that have no file yet: by view, the file.

    ``suffix`` is ``SAMPLES_SUFFIX`` if they keep single samples.
    """
    files = {view: out / f"{renderer}-{seed:06d}-{view}{suffix}" for view in range(count)}
    return {view: file for view, file in files.items() if not file.exists()}


def lr_key(scale: int) -> str:
    """Return the name of the array with the LRHS passes at 1/scale of the resolution."""
    return "lr" if scale == 1 else f"lr_x{scale}"


def denoised_reference(path: Path) -> Path:
    """Return the file in which :mod:`research.datagen.references` stores the denoised reference of a view's file."""
    return path.with_suffix(".ref.npy")


# Writing


def pack(
    hr: np.ndarray, lr: dict[int, np.ndarray], ref: np.ndarray, rng: np.random.Generator, meta: dict[str, Any]
) -> dict[str, np.ndarray]:
    """All arrays of a view's file, at a random exposure within three decades.

    Args:
        hr: (P, H, W, 15), scene-linear.
        lr: by scale, (Q, H/s, W/s, 3): scale 1 alone, or all other scales.
        ref: (H, W, 3).
        meta: entries of ``meta``; the exposure is added.
    """
    y = luminance(ref)
    target = 10 ** rng.uniform(-1.5, 1.3)
    scale = target / log_mean(ref)
    hr = hr.copy()
    hr[..., :3] *= scale
    hr[..., 9:] *= scale
    exposure = {
        "scale": scale, "log_mean": target, "mean": float(y.mean() * scale),
        "p1": float(np.percentile(y, 1) * scale), "p99": float(np.percentile(y, 99) * scale),
    }  # fmt: skip
    return {
        "hr": _half(hr),
        **{lr_key(smaller): _half(passes * scale) for smaller, passes in lr.items()},
        "lr_spp": np.array(LR_SPP, np.int32),
        "ref": _half(ref * scale),
        "meta": np.array(json.dumps({**meta, "exposure": exposure})),
    }


def _half(x: np.ndarray) -> np.ndarray:
    return np.clip(x, -65504, 65504).astype(np.float16)


def save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a view's file; the file appears under its name only when it is complete."""
    with replacing(path, overwrite=True) as temporary:
        np.savez(temporary, **arrays)  # type: ignore[arg-type]


def write(files: dict[int, Path], renders: Callable[[int], Iterator[dict[str, np.ndarray] | None]]) -> int:
    """Render views and write their files; return how many were written.

    Args:
        files: by view.
        renders: render a view with one camera after another: all arrays of its file, or None if they are of no use.
    """
    written = 0
    for view, file in files.items():
        arrays = next((arrays for arrays in islice(renders(view), RENDERS) if arrays is not None), None)
        if arrays is not None:
            save(file, arrays)
            written += 1
    return written


# Reading


def map_npz(path: Path) -> dict[str, NDArray]:
    """Arrays of an uncompressed ``.npz``, memory-mapped: data are read when they are indexed.

    ``numpy.load`` maps ``.npy`` files only.

    Raises:
        ValueError, zipfile.BadZipFile: the file is incomplete or compressed.
    """
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)  # PyTorch wants writable arrays
        arrays = {}
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{path}: {member.filename} is compressed; write it with numpy.savez")
            # Data follow the local header, whose last two shorts are the lengths of its name and extra field.
            name_length, extra_length = struct.unpack_from("<HH", mapped, member.header_offset + 26)
            file.seek(member.header_offset + 30 + name_length + extra_length)
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran, dtype = header(file)
            arrays[member.filename.removesuffix(".npy")] = np.ndarray(
                shape, dtype, buffer=mapped, offset=file.tell(), order="F" if fortran else "C"
            )
    return arrays


class StoredView:
    """The file of a view; its arrays stay on disk.

    Raises:
        ValueError, KeyError, OSError, struct.error, zipfile.BadZipFile: the file is incomplete or no view.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.arrays = path, map_npz(path)
        self.meta: dict[str, Any] = json.loads(str(self.arrays["meta"]))
        self.split: str = self.meta["split"]
        self.scene: str = str(self.meta["seed"])
        self.source = f"{self.meta.get('renderer', 'unknown renderer')}, generator {self.meta.get('generator', '?')}"
        """Renderer and generator version, for the provenance of a model."""


class View(StoredView):
    """One rendered view with passes."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        arrays = self.arrays
        self.hr, self.ref = arrays["hr"], arrays["ref"]
        self.lr: dict[int, NDArray] = {scale: arrays[key] for scale in (1, *SCALES) if (key := lr_key(scale)) in arrays}
        """LRHS passes by scale: scale 1 alone, or all other scales."""
        if denoised_reference(path).exists():
            self.ref = np.load(denoised_reference(path), mmap_mode="c")
        self.lr_spp = np.asarray(arrays["lr_spp"], dtype=np.int64)
        channels = sum(HRLS_FEATURES[name] for name in PASS_FEATURES)
        shapes = {scale: passes.shape for scale, passes in self.lr.items()}
        if (
            self.hr.ndim != 4
            or self.hr.shape[-1] != channels
            or not (1 in shapes or shapes.keys() >= set(SCALES))
            or any(shape[0] != len(self.lr_spp) for shape in shapes.values())
        ):
            raise ValueError(f"{path}: hr is {self.hr.shape}, lr {shapes}, lr_spp {self.lr_spp.shape}")


class SampleView(StoredView):
    """One view with single samples, see :mod:`research.datagen.samples`."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        samples, height, width = self.arrays["color"].shape
        self.hr = self.arrays["color"]  # as of :class:`View`, one sample a pass
        self.lr_spp = np.ones(len(self.arrays["lr_color"]), np.int64)
        if self.arrays["ref"].shape != (REF_CELLS * height, REF_CELLS * width):
            raise ValueError(f"{path}: ref is {self.arrays['ref'].shape}, color {(samples, height, width)}")


class Folder:
    """The views of a folder, sorted by file name. Hidden files are still being written."""

    def __init__(self, root: Path) -> None:
        self._views: list[View | SampleView] = []
        for path in sorted(root.glob("[!.]*.npz")):
            try:
                self._views.append((SampleView if path.name.endswith(SAMPLES_SUFFIX) else View)(path))
            except (ValueError, KeyError, OSError, struct.error, zipfile.BadZipFile) as error:
                log.warning("skipped %s: %s", path.name, error)

    def split(self, name: str) -> list[View]:
        """Return the views of one split."""
        return [view for view in self._views if isinstance(view, View) and view.split == name]

    def sample_views(self, split: str) -> list[SampleView]:
        """Return the views of one split that keep single samples."""
        return [view for view in self._views if isinstance(view, SampleView) and view.split == split]


def split_features(passes: Array) -> dict[str, Array]:
    """Split passes (..., 15), in the channel order of ``hr``, into named features (..., 3)."""
    ends = np.cumsum([HRLS_FEATURES[name] for name in PASS_FEATURES])[:-1]
    return dict(zip(PASS_FEATURES, np.split(passes, ends, axis=-1), strict=True))


def as_float32(values: NDArray, *, signed: bool = False) -> Array:
    """Convert stored half floats to finite float32, non-negative unless ``signed``."""
    return repair(values.astype(np.float32), signed=signed)[0]


def mean_lrhs(view: View, passes: NDArray[np.int64] | list[int], scale: int) -> Array:
    """Average the LRHS of a whole view, (H // s, W // s, 3).

    Args:
        passes: indices of the ``lr`` passes to average, weighted by their spp.
    """
    weights = view.lr_spp[passes] / view.lr_spp[passes].sum()
    stored = view.lr[scale if scale in view.lr else 1]
    mean = np.einsum("p,phwc->hwc", weights.astype(np.float32), as_float32(stored[passes]))
    if scale in view.lr:
        return mean
    return box_downsample(mean, scale)


def read_hrls(view: View, passes: NDArray[np.int64] | list[int], rows: slice, columns: slice) -> Array:
    """Read a crop of some ``hr`` passes, (n, H, W, 15): finite, and non-negative except for normals."""
    values = as_float32(np.stack([view.hr[p, rows, columns] for p in passes]), signed=True)
    for name, part in split_features(values).items():
        if name != NORMAL:
            np.maximum(part, 0.0, out=part)
    return values
