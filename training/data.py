# SPDX-License-Identifier: Apache-2.0
"""Training pairs drawn at random from rendered views: which samples, which augmentations, and the loader of batches.

On a CPU the views stay memory-mapped, and a worker process draws ahead of training. On a GPU they are loaded once, and
the whole batch is augmented there, so that the GPU does not wait for the host.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from datagen.views import PASS_FEATURES, Array, Folder, View
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
from oiio_msspl.colour import LUMINANCE_WEIGHTS
from training.encoding import compress, exposure_of, luminance, pack, repair
from training.ops import box_downsample

#: A batch by name: ``lrhs`` (N, 3, h, w), ``hrls`` (N, 16, s*h, s*w), ``target`` (N, 3, s*h, s*w), all encoded, in
#: channels-last memory. Some networks read further channels of the first two.
Batch = dict[str, Tensor]

#: Adds the further input channels of a network to an encoded pair, (h, w, 3) and (s*h, s*w, 16).
Prepare = Callable[[Array, Array], tuple[Array, Array]]


# How pairs are sampled

#: Height and width of the HR patch for each scale, as in the paper.
PAPER_PATCH = {2: 96, 4: 192, 8: 256}


@dataclass(frozen=True)
class Sampling:
    """How training pairs are drawn: which renders they imitate, and the augmentations. Shares are probabilities."""

    hrls_spp: tuple[float, ...] = (0.22, 0.2, 0.12, 0.2, 0.05, 0.06, 0.05, 0.1)
    """Weights of 1, 2, 3, ... spp in the HRLS. Low spp is the difficult case, and the one that users have."""
    lrhs_passes: tuple[float, ...] = (0.65, 0.2, 0.05, 0.05, 0.05)
    """Weights of 1, 2, 3, ... ``lr`` passes in the LRHS."""
    clip: float = math.inf
    """Upper bound of radiance, as in the paper. The log encoding needs none."""
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


#: The paper's sampling, as far as its text describes it: crops only, all features, clipped, nearest-neighbour LRHS.
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


def spp_range(view: View, sampling: Sampling, scale: int) -> dict[str, list[int]]:
    """Lowest and highest spp of the pairs that :func:`draw` makes of a view, for the model's contract."""
    samples = scale**2 if sampling.nearest < 1 else 1
    return {
        "hrls": [1, min(len(sampling.hrls_spp), len(view.hr))],
        "lrhs": [max(2, int(view.lr_spp.min()) * samples), int(view.lr_spp.sum()) * samples],
    }


# One batch


@dataclass(frozen=True)
class ViewTensors:
    """The arrays of a view as tensors, see :mod:`datagen.views`."""

    hr: Tensor
    lr: dict[int, Tensor]
    ref: Tensor
    lr_spp: np.ndarray

    @classmethod
    def of(cls, view: View, device: torch.device) -> ViewTensors:
        """On a CPU the tensors share the file's mapped memory."""

        def on_device(array: np.ndarray) -> Tensor:
            return torch.from_numpy(array).to(device)

        lr = {scale: on_device(passes) for scale, passes in view.lr.items()}
        return cls(on_device(view.hr), lr, on_device(view.ref), view.lr_spp)

    def lrhs(self, passes: np.ndarray, scale: int, clip: float, *, nearest: bool) -> Tensor:
        """As :func:`datagen.views.mean_lrhs`, clipped before pixels are averaged: (H/s, W/s, 3)."""
        stored = self.lr[scale if scale in self.lr else 1]
        weights = torch.from_numpy((self.lr_spp[passes] / self.lr_spp[passes].sum()).astype(np.float32))
        mean = torch.einsum(
            "p,phwc->hwc", weights.to(stored.device), repair(torch.stack([stored[p] for p in passes]))
        ).clamp_max(clip)
        if scale in self.lr:
            return mean
        if nearest:
            return mean[scale // 2 :: scale, scale // 2 :: scale]
        return box_downsample(mean.permute(2, 0, 1)[None], scale)[0].permute(1, 2, 0)


def draw(
    views: Sequence[ViewTensors],
    scale: int,
    patch: int,
    count: int,
    rng: np.random.Generator,
    sampling: Sampling,
    prepare: Prepare | None = None,
) -> Batch:
    """Draw a batch of ``count`` pairs of ``patch`` x ``patch`` HRLS pixels.

    Views, crops, light, exposure and missing features differ within a batch. Spp, pixel filter, mirroring and rotation
    are those of the batch. ``prepare`` appends further channels to the renders' own.
    """
    # Views, samples and crops
    chosen = [views[i] for i in rng.choice(len(views), count)]
    nearest = rng.random() < sampling.nearest
    spp = chosen[0].lr_spp
    while True:
        n = 1 + int(rng.choice(len(sampling.hrls_spp), p=_normalised(sampling.hrls_spp)))
        k = 1 + int(rng.choice(len(sampling.lrhs_passes), p=_normalised(sampling.lrhs_passes)))
        # Passes of few samples are more likely, because the LRHS should get the smaller part of all samples
        lr_passes = rng.choice(len(spp), k, replace=False, p=_normalised(tuple(1 / spp)))
        # A nearest-neighbour LRHS needs more spp than the HRLS, as in the paper
        if not nearest or spp[lr_passes].sum() > n:
            break
    height, width = chosen[0].ref.shape[:2]
    tops = scale * rng.integers((height - patch) // scale + 1, size=count)
    lefts = scale * rng.integers((width - patch) // scale + 1, size=count)
    areas = [(slice(top, top + patch), slice(left, left + patch)) for top, left in zip(tops, lefts, strict=True)]

    device = chosen[0].ref.device

    def on_device(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(array, dtype=np.float32)).to(device, non_blocking=True)

    lrhs = torch.stack([view.lrhs(lr_passes, scale, sampling.clip, nearest=nearest) for view in chosen])
    passes = [
        [view.hr[p, *area] for p in rng.permutation(len(view.hr))[:n]] for view, area in zip(chosen, areas, strict=True)
    ]
    features = _split(repair(torch.stack([torch.stack(of_view) for of_view in passes]), signed=True))
    target = repair(torch.stack([view.ref[area] for view, area in zip(chosen, areas, strict=True)]))
    target = target.clamp_max(sampling.clip)

    # Colour of the light, in linear radiance; the variance is computed afterwards, so that it has the same colour
    permutation = np.stack(
        [np.eye(3)[rng.permutation(3) if rng.random() < sampling.permute else range(3)] for _ in chosen]
    )
    light = on_device(np.stack([_random_light(rng, sampling) for _ in chosen]) @ permutation)[:, None]
    for name in RADIANCE_FEATURES:
        features[name] = features[name].clamp(0.0, sampling.clip)
    variance = luminance(features[RGB] @ light[:, None]).var(dim=1) / n if n > 1 else None
    features = {name: values.mean(dim=1) for name, values in features.items()}
    for name in RADIANCE_FEATURES:
        features[name] = features[name] @ light
    features[ALBEDO] = features[ALBEDO].clamp_min(0.0) @ on_device(permutation)[:, None]
    lrhs, target = lrhs @ light, target @ light
    features[VARIANCE] = torch.zeros_like(target[..., :1]) if variance is None else variance[..., None]

    # Mirroring and rotation by quarter turns. Normals may be in any space, so each view gets a random rotation of them;
    # it mirrors if the image is mirrored.
    mirrored, turns = rng.random() < 0.5, int(rng.integers(4))
    turn = on_device(np.stack([random_orthogonal(rng, -1 if mirrored else 1) for _ in chosen]))
    features[NORMAL] = features[NORMAL] @ turn[:, None]

    # Exposure, estimated from the whole LRHS as at inference
    jitter = on_device(2.0 ** rng.uniform(-sampling.exposure_stops, sampling.exposure_stops, count))
    exposure = exposure_of(lrhs) * jitter
    hrls = pack(features, exposure)

    # Missing features get their defaults
    present = on_device(np.stack([_present(rng, sampling, has_variance=variance is not None) for _ in chosen]))
    hrls = torch.lerp(on_device(_DEFAULTS), hrls, present[:, None, None])

    low_areas = [tuple(slice(side.start // scale, side.stop // scale) for side in area) for area in areas]
    lrhs = compress(torch.stack([image[area] for image, area in zip(lrhs, low_areas, strict=True)]), exposure)
    if prepare is not None:
        prepared = [prepare(*images) for images in zip(lrhs.cpu().numpy(), hrls.cpu().numpy(), strict=True)]
        lrhs, hrls = (on_device(np.stack(images)) for images in zip(*prepared, strict=True))
    pair = {"lrhs": lrhs, "hrls": hrls, "target": compress(target, exposure)}
    return {
        name: torch.rot90(image.flip(2) if mirrored else image, turns, (1, 2)).contiguous().permute(0, 3, 1, 2)
        for name, image in pair.items()
    }


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
    """A 3x3 matrix L that changes the colour of the light: radiance @ L."""
    if rng.random() < sampling.grey:
        return np.repeat(np.asarray(LUMINANCE_WEIGHTS)[:, None], 3, axis=1)
    return np.diag(2.0 ** rng.uniform(-sampling.gain_stops, sampling.gain_stops, 3))


def _present(rng: np.random.Generator, sampling: Sampling, *, has_variance: bool) -> np.ndarray:
    """1 for each HRLS channel whose feature is present, 0 for the others."""
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
    """Uniformly random 3x3 rotation (determinant 1) or rotation with a reflection (-1)."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q *= np.sign(np.diag(r))  # makes the decomposition unique, and so q uniform
    if np.linalg.det(q) * determinant < 0:
        q[:, 0] *= -1
    return q.astype(np.float32)


# All batches


class Batches(IterableDataset):
    """Endless random batches of a folder's training views.

    Args:
        scales: of each batch, one of these at random.
        patch: width and height of a patch in HRLS pixels.
        batch: pairs per batch.
        prepare: returns the function that adds a network's further channels; called in the process that draws.
        rescan_seconds: how often to look for new views on a CPU. A GPU keeps the views that it has loaded.
    """

    def __init__(
        self,
        folder: Path,
        scales: tuple[int, ...],
        patch: int,
        batch: int,
        sampling: Sampling,
        seed: int,
        device: torch.device,
        prepare: Callable[[], Prepare | None] | None = None,
        rescan_seconds: float = 120,
    ) -> None:
        self.folder, self.scales, self.patch, self.batch, self.sampling = folder, scales, patch, batch, sampling
        self.seed, self.device, self.prepare, self.rescan_seconds = seed, device, prepare, rescan_seconds

    @torch.no_grad()
    def __iter__(self) -> Iterator[Batch]:
        folder, prepare = Folder(self.folder), self.prepare and self.prepare()
        rng = np.random.default_rng(self.seed)
        while True:
            views = view_tensors(folder, "train", self.device)
            deadline = time.monotonic() + self.rescan_seconds
            while self.device.type != "cpu" or time.monotonic() < deadline:
                scale = int(rng.choice(self.scales))
                yield draw(views, scale, self.patch, self.batch, rng, self.sampling, prepare)
            folder.scan()

    def loader(self) -> DataLoader:
        """Load batches: on a CPU four ahead of training, in a process of their own."""
        if self.device.type != "cpu":
            return DataLoader(self, batch_size=None)
        return DataLoader(
            self,
            batch_size=None,
            num_workers=1,
            prefetch_factor=4,
            multiprocessing_context="spawn",  # a fork would copy locked locks of other threads
            worker_init_fn=_ignore_interrupts,
        )


def _ignore_interrupts(_: int) -> None:
    """Ctrl-C reaches all processes; training ends the worker after its last checkpoint."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def view_tensors(folder: Folder, split: str, device: torch.device) -> list[ViewTensors]:
    """The views of a split as tensors on a device."""
    return [ViewTensors.of(view, device) for view in folder.split(split)]


def fixed_batches(
    views: Path,
    split: str,
    scales: Sequence[int],
    patch: int,
    batch: int,
    prepare: Prepare | None = None,
    rng: np.random.Generator | None = None,
) -> Iterator[Batch]:
    """Endless batches on the CPU that are the same in every call, for calibration, pruning and the like."""
    rng = rng or np.random.default_rng(0)
    tensors = view_tensors(Folder(views), split, torch.device("cpu"))
    while True:
        with torch.no_grad():
            pairs = draw(tensors, int(rng.choice(scales)), patch, batch, rng, Sampling(), prepare)
        yield pairs


def to_tensor(image: Array, device: torch.device) -> Tensor:
    """(N, H, W, C) to (N, C, H, W) in channels-last memory, without a copy on the CPU."""
    return torch.from_numpy(np.ascontiguousarray(image)).permute(0, 3, 1, 2).to(device, non_blocking=True)
