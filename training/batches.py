# SPDX-License-Identifier: Apache-2.0
"""Random training pairs of rendered views, made on the device that trains.

On a CPU the views stay in their files, and a thread draws ahead of training. On a GPU they are loaded once, and every
step of the augmentation runs there on the whole batch, so that the device does not wait for the host.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.views import PASS_FEATURES, Folder, View
from oiio_msspl import schema, transforms
from training.data import Prepare, Sampling, random_orthogonal
from training.pyramid import logarithmic

#: What a batch is made of, by name: ``lrhs`` (N, 3, h, w), ``hrls`` (N, 16, s*h, s*w), ``target`` (N, 3, s*h, s*w); all
#: in network values, and channels-last in memory. For some networks, the first two have further channels.
Batch = dict[str, Tensor]


@dataclass(frozen=True)
class Pixels:
    """A view's arrays as tensors."""

    hr: Tensor
    lr: dict[int, Tensor]
    ref: Tensor
    lr_spp: np.ndarray

    @classmethod
    def of(cls, view: View, device: torch.device) -> Pixels:
        """On a CPU they share the file's mapped pages."""

        def on_device(array: np.ndarray) -> Tensor:
            return torch.from_numpy(array).to(device)

        lr = {scale: on_device(passes) for scale, passes in view.lr.items()}
        return cls(on_device(view.hr), lr, on_device(view.ref), view.lr_spp)

    def lrhs(self, passes: np.ndarray, scale: int, clip: float, *, nearest: bool) -> Tensor:
        """As :func:`datagen.views.mean_lrhs`, clipped before pixels are joined: (H/s, W/s, 3)."""
        stored = self.lr[scale if scale in self.lr else 1]
        weights = torch.from_numpy((self.lr_spp[passes] / self.lr_spp[passes].sum()).astype(np.float32))
        mean = torch.einsum(
            "p,phwc->hwc", weights.to(stored.device), repair(torch.stack([stored[p] for p in passes]))
        ).clamp_max(clip)
        if scale in self.lr:
            return mean
        return (nearest_downsample if nearest else box_downsample)(mean[None], scale)[0]


# Transforms, as oiio_msspl.transforms and oiio_msspl.tensors have them for one image


def repair(values: Tensor, *, signed: bool = False) -> Tensor:
    """Stored half floats as finite float32, non-negative unless ``signed``."""
    values = torch.nan_to_num(values.float(), nan=0.0, posinf=transforms.MAX_RADIANCE, neginf=-transforms.MAX_RADIANCE)
    return values if signed else values.clamp_min(0.0)


def luminance(rgb: Tensor) -> Tensor:
    """(..., 3) to (...)."""
    return rgb @ rgb.new_tensor(schema.LUMINANCE)


def exposure_of(lrhs: Tensor) -> Tensor:
    """As :func:`oiio_msspl.transforms.exposure_of`, for each image of a batch (N, h, w, 3): (N,)."""
    y = luminance(lrhs).flatten(1)
    y = torch.where(y > 0, y, torch.nan)
    y = torch.where(y >= transforms.TRACE * y.nanquantile(0.99, dim=1, keepdim=True), y, torch.nan)
    epsilon = 1e-4 * y.nanmedian(dim=1, keepdim=True).values
    return torch.nan_to_num(transforms.KEY / torch.exp(torch.log(y + epsilon).nanmean(dim=1)), nan=1.0)


def compress(radiance: Tensor, exposure: Tensor) -> Tensor:
    """As :func:`oiio_msspl.transforms.compress`, for (N, H, W, C) and an exposure each."""
    return logarithmic((radiance * exposure[:, None, None, None]).clamp(0.0, transforms.MAX_RADIANCE))


def pack(features: dict[str, Tensor], exposure: Tensor) -> Tensor:
    """All features of an HRLS (N, H, W, C) in the order of the schema, transformed: (N, H, W, 16)."""
    stack = []
    for name in schema.HRLS_FEATURES:
        values = features[name]
        if name in schema.RADIANCE_FEATURES:
            values = compress(values, exposure)
        elif name == schema.VARIANCE:
            values = compress(values.clamp_min(0.0).sqrt(), exposure)
        elif name == schema.ALBEDO:
            values = values.clamp(0.0, transforms.MAX_ALBEDO)
        else:
            values = values.clamp(-1.0, 1.0)
        stack.append(values)
    return torch.cat(stack, dim=-1)


def box_downsample(image: Tensor, scale: int) -> Tensor:
    """Mean over ``scale`` x ``scale`` pixels: (N, H, W, C) to (N, H/s, W/s, C)."""
    count, height, width, channels = image.shape
    return image.reshape(count, height // scale, scale, width // scale, scale, channels).mean(dim=(2, 4))


def nearest_downsample(image: Tensor, scale: int) -> Tensor:
    """One pixel of each ``scale`` x ``scale``, the paper's degradation."""
    return image[:, scale // 2 :: scale, scale // 2 :: scale]


# One batch


def draw(
    views: Sequence[Pixels],
    scale: int,
    patch: int,
    count: int,
    rng: np.random.Generator,
    sampling: Sampling,
    prepare: Prepare | None = None,
) -> Batch:
    """``count`` pairs of ``patch`` x ``patch`` HRLS pixels; spp, footprint, mirroring and turning are the batch's.

    What is prepared follows the renders' own channels.
    """
    # Renderings: how many samples, and which part of which view
    chosen = [views[i] for i in rng.choice(len(views), count)]
    nearest = rng.random() < sampling.nearest
    spp = chosen[0].lr_spp
    while True:
        n = 1 + int(rng.choice(len(sampling.hrls_spp), p=_normalised(sampling.hrls_spp)))
        k = 1 + int(rng.choice(len(sampling.lrhs_passes), p=_normalised(sampling.lrhs_passes)))
        # Rather the passes of few samples: of all samples, the LRHS should get the smaller part
        lr_passes = rng.choice(len(spp), k, replace=False, p=_normalised(tuple(1 / spp)))
        # High and low spp, as in the paper; or an LRHS of fewer, but for a larger pixel
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

    # Light and colour, in linear values; the variance must see the changed light
    renaming = np.stack(
        [np.eye(3)[rng.permutation(3) if rng.random() < sampling.permute else range(3)] for _ in chosen]
    )
    light = on_device(np.stack([_random_light(rng, sampling) for _ in chosen]) @ renaming)[:, None]
    for name in schema.RADIANCE_FEATURES:
        features[name] = features[name].clamp(0.0, sampling.clip)
    variance = luminance(features[schema.RGB] @ light[:, None]).var(dim=1) / n if n > 1 else None
    features = {name: values.mean(dim=1) for name, values in features.items()}
    for name in schema.RADIANCE_FEATURES:
        features[name] = features[name] @ light
    features[schema.ALBEDO] = features[schema.ALBEDO].clamp_min(0.0) @ on_device(renaming)[:, None]
    lrhs, target = lrhs @ light, target @ light
    features[schema.VARIANCE] = torch.zeros_like(target[..., :1]) if variance is None else variance[..., None]

    # Mirroring and turning. Normals may be in any space, so any rotation of them is right, as long as its handedness is
    # that of the image.
    mirrored, turns = rng.random() < 0.5, int(rng.integers(4))
    turn = on_device(np.stack([random_orthogonal(rng, -1 if mirrored else 1) for _ in chosen]))
    features[schema.NORMAL] = features[schema.NORMAL] @ turn[:, None]

    # Exposure as inference finds it, from the whole LRHS
    jitter = on_device(2.0 ** rng.uniform(-sampling.exposure_stops, sampling.exposure_stops, count))
    exposure = exposure_of(lrhs) * jitter
    hrls = pack(features, exposure)

    # Layers that a renderer did not write
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
    return np.concatenate([np.full(channels, values[name]) for name, channels in schema.HRLS_FEATURES.items()])


_DEFAULTS = _per_channel({schema.RGB: 0.0} | schema.DEFAULTS)


def _split(passes: Tensor) -> dict[str, Tensor]:
    """(..., 15) in the channel order of ``hr`` to named features."""
    parts = passes.split([schema.HRLS_FEATURES[name] for name in PASS_FEATURES], dim=-1)
    return dict(zip(PASS_FEATURES, parts, strict=True))


def _normalised(weights: tuple[float, ...]) -> np.ndarray:
    return np.asarray(weights) / np.sum(weights)


def _random_light(rng: np.random.Generator, sampling: Sampling) -> np.ndarray:
    """3x3 matrix L that changes the colour of the light: radiance' = radiance @ L."""
    if rng.random() < sampling.grey:
        return np.repeat(np.asarray(schema.LUMINANCE)[:, None], 3, axis=1)
    return np.diag(2.0 ** rng.uniform(-sampling.gain_stops, sampling.gain_stops, 3))


def _present(rng: np.random.Generator, sampling: Sampling, *, has_variance: bool) -> np.ndarray:
    """1 for each channel of the HRLS whose feature is there, 0 for the others."""
    absence = dict.fromkeys(schema.OPTIONAL_FEATURES, sampling.drop_each) | {schema.VARIANCE: sampling.drop_variance}
    present = {schema.RGB: 1.0} | {name: float(rng.random() >= share) for name, share in absence.items()}
    if rng.random() < sampling.drop_lobes:
        present[schema.DIFFUSE] = present[schema.SPECULAR] = 0.0
    if not has_variance:
        present[schema.VARIANCE] = 0.0
    if rng.random() < sampling.drop_all:
        present |= dict.fromkeys(schema.OPTIONAL_FEATURES, 0.0)
    return _per_channel(present)


class Batches:
    """Endless batches for training, on its device.

    Args:
        scales: of each batch, one of these.
        rescan_seconds: how often a CPU looks for new views; a GPU keeps those that it began with.
    """

    def __init__(
        self,
        folder: Folder,
        scales: tuple[int, ...],
        patch: int,
        batch: int,
        sampling: Sampling,
        seed: int,
        device: torch.device,
        prepare: Prepare | None = None,
        rescan_seconds: float = 120,
    ) -> None:
        self.folder, self.scales, self.patch, self.batch, self.sampling = folder, scales, patch, batch, sampling
        self.device, self.prepare = device, prepare
        self.waited = 0.0
        """Seconds that :meth:`next` has taken of the training loop."""
        self._rescan_seconds = rescan_seconds
        self._rng = np.random.default_rng(seed)
        self._views = self._load()
        self._queue: queue.Queue[Batch | BaseException] = queue.Queue(maxsize=4)
        self._ahead = device.type == "cpu"
        self._worker: threading.Thread | None = None
        self._ended = threading.Event()

    def close(self) -> None:
        """End the thread that draws ahead: amid its work, the interpreter could not end without an abort."""
        self._ended.set()
        while self._worker is not None and self._worker.is_alive():
            with contextlib.suppress(queue.Empty):
                self._queue.get_nowait()  # it may wait for room
            self._worker.join(timeout=0.1)

    def next(self) -> Batch:
        start = time.monotonic()
        if self._ahead and self._worker is None:  # not before: a run that only evaluates must not end amid its work
            self._worker = threading.Thread(target=self._work, daemon=True)
            self._worker.start()
        item = self._queue.get() if self._ahead else self._draw()
        self.waited += time.monotonic() - start
        if isinstance(item, BaseException):
            raise item
        return item

    def _load(self) -> list[Pixels]:
        return [Pixels.of(view, self.device) for view in self.folder.split("train")]

    @torch.no_grad()
    def _draw(self) -> Batch:
        scale = int(self._rng.choice(self.scales))
        return draw(self._views, scale, self.patch, self.batch, self._rng, self.sampling, self.prepare)

    def _work(self) -> None:
        try:
            while not self._ended.is_set():
                deadline = time.monotonic() + self._rescan_seconds
                while time.monotonic() < deadline and not self._ended.is_set():
                    self._queue.put(self._draw())
                self.folder.scan()
                self._views = self._load()
        except BaseException as error:  # whatever it was, training must end with it instead of waiting for ever
            self._queue.put(error)
