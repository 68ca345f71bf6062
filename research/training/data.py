# SPDX-License-Identifier: Apache-2.0
"""Training pairs drawn at random from rendered views: which samples, which augmentations, and the loader of batches.

On a CPU the views stay memory-mapped, and a worker process draws ahead of training. On a GPU they are loaded once, and
the whole batch is augmented there, so that the GPU does not wait for the host.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from oiio_msspl.aovs.features import (
    ALBEDO,
    DEFAULTS,
    DIFFUSE,
    HRLS_FEATURES,
    NORMAL,
    OPTIONAL_FEATURES,
    RADIANCE_FEATURES,
    RGB,
    SPECULAR,
    VARIANCE,
)
from oiio_msspl.image.colour import LUMINANCE_WEIGHTS
from research.datagen.samples import MANTISSA, STEP
from research.datagen.views import NO_REFERENCE, PASS_FEATURES, REF_CELLS, Array, Folder, SampleView, View
from research.training.encoding import compress, exposure_of, luminance, pack, repair
from research.training.ops import box_downsample
from research.training.splat import apply, draw_filter, filter_reference

#: A batch by name: ``lrhs`` (N, 3, h, w), ``hrls`` (N, 16, s*h, s*w), ``target`` (N, 3, s*h, s*w), all encoded, in
#: channels-last memory. Some networks read further channels of the LRHS.
Batch = dict[str, Tensor]

#: Adds the further input channels of a network to an encoded LRHS (1, 3, h, w), given the HRLS (1, 16, s*h, s*w).
Prepare = Callable[[Tensor, Tensor], Tensor]


CPU = torch.device("cpu")

# How pairs are sampled


@dataclass(frozen=True)
class Sampling:
    """How training pairs are drawn: which renders they imitate, and the augmentations. Shares are probabilities."""

    hrls_spp: tuple[float, ...] = (0.22, 0.2, 0.12, 0.2, 0.05, 0.06, 0.05, 0.1)
    """Weights of 1, 2, 3, ... spp in the HRLS. Low spp is the difficult case, and the one that users have."""
    lrhs_passes: tuple[float, ...] = (0.65, 0.2, 0.05, 0.05, 0.05)
    """Weights of 1, 2, 3, ... ``lr`` passes in the LRHS."""
    nearest: float = 0.15
    """Share with the paper's nearest-neighbour LRHS instead of a box-filtered one."""
    exposure_stops: float = 0.5
    """Exposure jitter, plus or minus: inference may estimate the exposure from another crop or frame."""
    gain_stops: float = 0.5
    """Random gain per channel of radiance, plus or minus; the albedo stays."""
    permute: float = 0.5
    """Share with permuted colour channels of radiance and albedo."""
    grey: float = 0.05
    """Share with r = g = b in all radiance, because models also fuse single-channel layers."""
    drop_each: float = 0.1
    """Share in which an optional feature is missing, independently for each feature."""
    drop_lobes: float = 0.5
    """Share without diffuse and specular, which many renders lack."""
    drop_variance: float = 0.7
    """Share without the variance, which few renderers write."""
    drop_all: float = 0.05
    """Share with colour only."""
    spread_noise: bool | None = None
    """Of views with single samples: only pixel filters that spread noise, only others, or all (None)."""
    uneven: float = 0.0
    """Share of the pairs of views with single samples in which parts of both renders have all stored samples, as the
    averaged frames of a shot have."""


def spp_range(views: Sequence[View | SampleView], scale: int) -> dict[str, list[int]]:
    """Return the lowest and highest spp of the pairs that :func:`draw` makes of views, for the model's contract."""
    return {
        "hrls": [1, max(min(len(Sampling.hrls_spp), len(view.hr)) for view in views)],
        "lrhs": [
            scale**2 * min(int(view.lr_spp.min()) for view in views),
            scale**2 * max(int(view.lr_spp.sum()) for view in views),
        ],
    }


# One batch


#: Rows and columns of a crop, in HRLS pixels.
Area = tuple[slice, slice]


@dataclass(frozen=True)
class Rendered:
    """A pair that was drawn from a view: linear, without negative radiance."""

    features: dict[str, Tensor]
    """(patch, patch, channels) by name, of the HRLS"""
    variance: Tensor | None
    """(patch, patch), of the luminance of the HRLS; None if it has one sample a pixel, or single samples"""
    lrhs: Tensor
    """(H/s, W/s, 3), of the whole view"""
    target: Tensor
    """(patch, patch, 3)"""


def _draw_spp(spp: np.ndarray, sampling: Sampling, nearest: bool, rng: np.random.Generator) -> tuple[int, np.ndarray]:
    """Draw the samples per pixel of the HRLS, and the passes of the LRHS, whose spp are given."""
    while True:
        n = 1 + int(rng.choice(len(sampling.hrls_spp), p=_normalised(sampling.hrls_spp)))
        k = 1 + int(rng.choice(len(sampling.lrhs_passes), p=_normalised(sampling.lrhs_passes)))
        # Passes of few samples are more likely, because the LRHS should get the smaller part of all samples
        passes = rng.choice(len(spp), min(k, len(spp)), replace=False, p=_normalised(tuple(1 / spp)))
        # A nearest-neighbour LRHS needs more spp than the HRLS, as in the paper
        if not nearest or spp[passes].sum() > n:
            return n, passes


class ViewTensors:
    """The arrays of a view as tensors, see :mod:`research.datagen.views`. On a CPU they share the file's memory."""

    def __init__(self, view: View, device: torch.device) -> None:
        self.device, self.lr_spp = device, view.lr_spp
        self.hr, self.ref = (torch.from_numpy(array).to(device) for array in (view.hr, view.ref))
        self.lr = torch.from_numpy(view.lr[1]).to(device)
        self.size: tuple[int, int] = view.ref.shape[:2]
        """Height and width in HRLS pixels."""

    def lrhs(self, passes: np.ndarray, scale: int, *, nearest: bool) -> Tensor:
        """Average passes, as :func:`research.datagen.views.mean_lrhs`: (H/s, W/s, 3).

        ``nearest`` takes one pixel of s x s instead of their mean, as the paper does.
        """
        weights = torch.from_numpy((self.lr_spp[passes] / self.lr_spp[passes].sum()).astype(np.float32))
        images = repair(torch.stack([self.lr[p] for p in passes]))
        mean = torch.einsum("p,phwc->hwc", weights.to(self.device), images)
        if nearest:
            return mean[scale // 2 :: scale, scale // 2 :: scale]
        return box_downsample(mean.permute(2, 0, 1)[None], scale)[0].permute(1, 2, 0)

    def draw(self, scale: int, area: Area, light: Tensor, sampling: Sampling, rng: np.random.Generator) -> Rendered:
        """Draw the samples of a pair; its radiance is multiplied by ``light``, (3, 3)."""
        nearest = rng.random() < sampling.nearest
        n, lr_passes = _draw_spp(self.lr_spp, sampling, nearest, rng)
        lrhs = self.lrhs(lr_passes, scale, nearest=nearest)
        passes = [self.hr[p, *area] for p in rng.permutation(len(self.hr))[:n]]
        features = _split(repair(torch.stack(passes), signed=True))
        for name in RADIANCE_FEATURES:
            features[name] = features[name].clamp_min(0.0)
        variance = luminance(features[RGB] @ light).var(dim=0) / n if n > 1 else None
        features = {name: values.mean(dim=0) for name, values in features.items()}
        for name in RADIANCE_FEATURES:
            features[name] = features[name] @ light
        return Rendered(features, variance, lrhs @ light, repair(self.ref[area]) @ light)


class SampleTensors:
    """The arrays of a view with single samples as tensors, see :mod:`research.datagen.samples`.

    On a CPU they share the file's memory.
    """

    def __init__(self, view: SampleView, device: torch.device) -> None:
        arrays = {name: array for name, array in view.arrays.items() if name != "meta"}
        signed = {name: a.view(np.int32) if a.dtype == np.uint32 else a for name, a in arrays.items()}
        self.device = device
        self.arrays = {name: torch.from_numpy(array).to(device) for name, array in signed.items()}
        self.size: tuple[int, int] = view.hr.shape[1:]
        """Height and width in HRLS pixels."""
        self.clean_reference: Tensor | None = None
        """(1, 3, R*H, R*W), in place of the stored reference."""

    def noisy_reference(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """Read colour, albedo and normal, (1, 3, R*H, R*W), of a reference that is to be denoised; else None."""
        if "ref_albedo" not in self.arrays:
            return None
        albedo, normal = (self.arrays[f"ref_{name}"].float().movedim(-1, 0)[None] for name in (ALBEDO, NORMAL))
        return decode_radiance(self.arrays["ref"][None]), albedo / 255, normal / 127

    def read(self, name: str, samples: Tensor, rows: slice, columns: slice) -> Tensor:
        """Read some samples of an array in a crop: (k, C, h, w); places are (k, h, w, 2)."""
        stored = self.arrays[name][samples, rows, columns]
        layer = name.removeprefix("lr_")
        if layer == "place":
            return (stored.float() + 0.5) / 256
        if layer == ALBEDO:
            return stored.float().movedim(-1, 1) / 255
        if layer == NORMAL:
            return stored.float().movedim(-1, 1) / 127
        return decode_radiance(stored)

    def draw(self, scale: int, area: Area, light: Tensor, sampling: Sampling, rng: np.random.Generator) -> Rendered:
        """Draw a filter and the samples of a pair; its radiance is multiplied by ``light``, (3, 3).

        Both renders and the reference have the same filter, the LRHS in its own pixels.
        """
        pixel_filter = draw_filter(rng, spread_noise=sampling.spread_noise)
        lr_count = len(self.arrays["lr_color"])
        n, lr_samples = _draw_spp(np.ones(lr_count), sampling, False, rng)
        device = light.device
        order = torch.from_numpy(rng.permutation(len(self.arrays["color"]))).to(device)
        generator = torch.Generator(device).manual_seed(int(rng.integers(2**63)))

        # The crop with as much around it as the filter reaches
        height, width = self.size
        wide = [
            slice(max(side.start - pixel_filter.reach, 0), min(side.stop + pixel_filter.reach, size))
            for side, size in zip(area, (height, width), strict=True)
        ]
        crop = (slice(side.start - w.start, side.stop - w.start) for side, w in zip(area, wide, strict=True))
        inner = (slice(None), *crop)
        names = {RGB: "color"} | {name: name for name in PASS_FEATURES if name != RGB}

        def hrls(count: int) -> Tensor:
            drawn = order[: pixel_filter.samples_for(count)]
            layers = {name: self.read(stored, drawn, *wide) for name, stored in names.items()}
            for name in RADIANCE_FEATURES:
                layers[name] = _lit(layers[name], light)
            place = self.read("place", drawn, *wide)
            return apply(pixel_filter, place, torch.cat(list(layers.values()), dim=1), 1, count, generator)[inner]

        whole = (slice(0, height // scale * scale), slice(0, width // scale * scale))

        def lrhs(samples: np.ndarray) -> Tensor:
            chosen = torch.from_numpy(samples).to(device)
            color = _lit(self.read("lr_color", chosen, *whole), light)
            return apply(pixel_filter, self.read("lr_place", chosen, *whole), color, scale, None, generator)

        features, low = hrls(n), lrhs(lr_samples)
        if sampling.uneven and rng.random() < sampling.uneven:
            more = _random_parts(height, width, rng).to(device)
            features = torch.where(more[area], hrls(len(order)), features)
            coarse = more[::scale, ::scale][: low.shape[-2], : low.shape[-1]]
            low = torch.where(coarse, lrhs(np.arange(lr_count)), low)
        layers = _split(features.movedim(0, -1))
        for name in RADIANCE_FEATURES:
            layers[name] = layers[name].clamp_min(0.0)

        cells = [slice(w.start * REF_CELLS, w.stop * REF_CELLS) for w in wide]
        if self.clean_reference is None:
            ref = decode_radiance(self.arrays["ref"][None, *cells])
        else:
            ref = self.clean_reference[:, :, *cells]
        target = filter_reference(pixel_filter, _lit(ref, light)[0], REF_CELLS)[inner].movedim(0, -1)
        return Rendered(layers, None, low.movedim(0, -1).clamp_min(0.0), target.clamp_min(0.0))


def _random_parts(height: int, width: int, rng: np.random.Generator, cell: int = 8) -> Tensor:
    """Draw a part of an image, (H, W) of bool: where smooth noise is above a random one of its values.

    Its edges lie on a grid of ``cell`` pixels, so that it is equal in an LRHS of every scale.
    """
    noise = torch.from_numpy(rng.standard_normal((1, 1, 6, 6)).astype(np.float32))
    cells = F.interpolate(noise, (-(-height // cell), -(-width // cell)), mode="bilinear")[0, 0]
    chosen = cells > cells.flatten()[int(rng.integers(cells.numel()))]
    return chosen.repeat_interleave(cell, 0).repeat_interleave(cell, 1)[:height, :width]


def decode_radiance(stored: Tensor) -> Tensor:
    """Decode :func:`research.datagen.samples.encode`: (k, h, w) to (k, 3, h, w)."""
    mantissas = torch.stack([stored >> shift & MANTISSA for shift in (0, 9, 18)], dim=1).float()
    return mantissas * torch.exp2((stored >> 27 & 31).float() + math.log2(STEP))[:, None]


def _lit(radiance: Tensor, light: Tensor) -> Tensor:
    """Multiply radiance (k, 3, h, w) by a light (3, 3)."""
    return torch.einsum("kihw,ij->kjhw", radiance, light)


def draw(
    views: Sequence[ViewTensors | SampleTensors], scale: int, patch: int, count: int, rng: np.random.Generator,
    sampling: Sampling, prepare: Prepare | None = None,
) -> Batch:  # fmt: skip
    """Draw a batch of ``count`` pairs of ``patch`` x ``patch`` HRLS pixels.

    Views, crops, spp, pixel filter, light, exposure and missing features differ within a batch. Mirroring and rotation
    are those of the batch. ``prepare`` appends further channels to the LRHS.
    """
    # Views and crops
    chosen = [views[i] for i in rng.choice(len(views), count)]
    areas: list[Area] = []
    for view in chosen:
        top, left = (scale * int(rng.integers((size - patch) // scale + 1)) for size in view.size)
        areas.append((slice(top, top + patch), slice(left, left + patch)))
    device = chosen[0].device

    def on_device(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(array, dtype=np.float32)).to(device, non_blocking=True)

    # Colour of the light, in linear radiance. The variance is computed afterwards, so that it has the same colour.
    permutation = np.stack(
        [np.eye(3)[rng.permutation(3) if rng.random() < sampling.permute else range(3)] for _ in chosen]
    )
    light = on_device(np.stack([_random_light(rng, sampling) for _ in chosen]) @ permutation)
    renders = [
        view.draw(scale, area, of_view, sampling, rng) for view, area, of_view in zip(chosen, areas, light, strict=True)
    ]
    features = {name: torch.stack([pair.features[name] for pair in renders]) for name in PASS_FEATURES}
    features[ALBEDO] = features[ALBEDO].clamp_min(0.0) @ on_device(permutation)[:, None]
    target = torch.stack([pair.target for pair in renders])
    black = torch.zeros_like(target[0, ..., 0])
    features[VARIANCE] = torch.stack([black if pair.variance is None else pair.variance for pair in renders])[..., None]

    # Mirroring and rotation by quarter turns. Normals may be in any space, so each view gets a random rotation of them;
    # it mirrors if the image is mirrored.
    mirrored, turns = rng.random() < 0.5, int(rng.integers(4))
    turn = on_device(np.stack([random_orthogonal(rng, -1 if mirrored else 1) for _ in chosen]))
    features[NORMAL] = features[NORMAL] @ turn[:, None]

    # Exposure, estimated from the whole LRHS as at inference
    jitter = on_device(2.0 ** rng.uniform(-sampling.exposure_stops, sampling.exposure_stops, count))
    exposure = torch.cat([exposure_of(pair.lrhs[None]) for pair in renders]) * jitter
    hrls = pack(features, exposure)

    # Missing features get their defaults
    present = on_device(np.stack([_present(rng, sampling, has_variance=pair.variance is not None) for pair in renders]))
    hrls = torch.lerp(on_device(_DEFAULTS), hrls, present[:, None, None])

    low_areas = [tuple(slice(side.start // scale, side.stop // scale) for side in area) for area in areas]
    crops = [pair.lrhs[area] for pair, area in zip(renders, low_areas, strict=True)]
    lrhs = compress(torch.stack(crops), exposure)
    if prepare is not None:
        pairs = zip(lrhs.movedim(-1, 1).split(1), hrls.movedim(-1, 1).split(1), strict=True)
        lrhs = torch.cat([prepare(*pair) for pair in pairs]).movedim(1, -1)
    pair = {"lrhs": lrhs, "hrls": hrls, "target": compress(target, exposure)}
    return {
        name: torch.rot90(image.flip(2) if mirrored else image, turns, (1, 2)).contiguous().permute(0, 3, 1, 2)
        for name, image in pair.items()
    }


def turned(pair: Batch, rng: np.random.Generator) -> Batch:
    """Mirror and transpose the images (N, c, H, W) of a batch at random.

    If images are mirrored, so are the normals in ``hrls``, channels 6 to 8 in [-1, 1]. They may be in any space, so it
    does not matter along which axis.
    """
    flips = [axis for axis in (2, 3) if rng.random() < 0.5]
    swaps = rng.random() < 0.5
    result = {name: image.flip(flips).transpose(2, 3) if swaps else image.flip(flips) for name, image in pair.items()}
    if (len(flips) + swaps) % 2:
        result["hrls"][:, 6] = -result["hrls"][:, 6]
    return {name: image.contiguous(memory_format=torch.channels_last) for name, image in result.items()}


def _per_channel(values: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.full(channels, values[name]) for name, channels in HRLS_FEATURES.items()])


_DEFAULTS = _per_channel({RGB: 0.0} | DEFAULTS)


def _split(passes: Tensor) -> dict[str, Tensor]:
    """Split passes (..., 15), in the channel order of ``hr``, into named features."""
    parts = passes.split([HRLS_FEATURES[name] for name in PASS_FEATURES], dim=-1)
    return dict(zip(PASS_FEATURES, parts, strict=True))


def _normalised(weights: tuple[float, ...]) -> np.ndarray:
    return np.asarray(weights) / np.sum(weights)


def _random_light(rng: np.random.Generator, sampling: Sampling) -> np.ndarray:
    """Draw a 3x3 matrix L that changes the colour of the light: radiance @ L."""
    if rng.random() < sampling.grey:
        return np.repeat(np.asarray(LUMINANCE_WEIGHTS)[:, None], 3, axis=1)
    return np.diag(2.0 ** rng.uniform(-sampling.gain_stops, sampling.gain_stops, 3))


def _present(rng: np.random.Generator, sampling: Sampling, *, has_variance: bool) -> np.ndarray:
    """Draw 1 for each HRLS channel whose feature is present, 0 for the others."""
    absence = dict.fromkeys(OPTIONAL_FEATURES, sampling.drop_each) | {VARIANCE: sampling.drop_variance}
    present = {RGB: 1.0} | {name: float(rng.random() >= share) for name, share in absence.items()}
    if rng.random() < sampling.drop_lobes:
        present[DIFFUSE] = present[SPECULAR] = 0.0
    if not has_variance:
        present[VARIANCE] = 0.0
    if rng.random() < sampling.drop_all:
        present |= dict.fromkeys(OPTIONAL_FEATURES, 0.0)
    return _per_channel(present)


def random_orthogonal(rng: np.random.Generator, determinant: int) -> Array:
    """Draw a uniformly random 3x3 rotation (determinant 1) or rotation with a reflection (-1)."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q *= np.sign(np.diag(r))  # makes the decomposition unique, and so q uniform
    if np.linalg.det(q) * determinant < 0:
        q[:, 0] *= -1
    return q.astype(np.float32)


# All batches


@dataclass(frozen=True, eq=False)
class Batches(IterableDataset):
    """Endless random batches of the views that a folder has when they begin, the same for each seed."""

    folder: Path
    scales: Sequence[int]
    """Of each batch, one of these at random."""
    patch: int
    """Width and height of a patch in HRLS pixels."""
    batch: int
    """Pairs per batch."""
    prepare: Prepare | None = None
    sampling: Sampling = Sampling()
    split: str = "train"
    without_reference: bool = False
    """Also of views that have no reference; their targets are not to be read."""
    seed: int = 0
    device: torch.device = CPU

    def __iter__(self) -> Iterator[Batch]:
        """Yield batches without end."""
        rng, folder = np.random.default_rng(self.seed), Folder(self.folder)
        tensors = view_tensors(folder, self.split, self.device)
        if self.without_reference:
            tensors += view_tensors(folder, NO_REFERENCE, self.device)
        while True:
            with torch.no_grad():
                scale = int(rng.choice(self.scales))
                pairs = draw(tensors, scale, self.patch, self.batch, rng, self.sampling, self.prepare)
            yield pairs

    def loader(self) -> DataLoader:
        """Load batches: on a CPU four ahead of training, in a process of their own."""
        if self.device.type != "cpu":
            return DataLoader(self, batch_size=None)
        # A fork would copy locked locks of other threads
        workers: dict[str, Any] = {"num_workers": 1, "prefetch_factor": 4, "multiprocessing_context": "spawn"}
        return DataLoader(self, batch_size=None, worker_init_fn=_ignore_interrupts, **workers)


def _ignore_interrupts(_: int) -> None:
    """Let training end the worker after its last checkpoint, because Ctrl-C reaches all processes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def view_tensors(folder: Folder, split: str, device: torch.device) -> list[ViewTensors | SampleTensors]:
    """Open the views of a split as tensors on a device, those with single samples too."""
    passes = [ViewTensors(view, device) for view in folder.split(split)]
    return [*passes, *(SampleTensors(view, device) for view in folder.sample_views(split))]


def to_tensor(image: Array, device: torch.device) -> Tensor:
    """Convert (N, H, W, C) to (N, C, H, W) in channels-last memory, without a copy on the CPU."""
    return torch.from_numpy(np.ascontiguousarray(image)).permute(0, 3, 1, 2).to(device, non_blocking=True)
