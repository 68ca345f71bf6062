# SPDX-License-Identifier: Apache-2.0
"""The method: an LRHS and an HRLS in, the fused frame out."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, LRHS_FEATURES, NORMAL, RADIANCE_FEATURES, RGB
from oiio_msspl.arrays import Array, box_downsample
from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import ReadableRender, Window
from oiio_msspl.fusion.alignment import Alignment, align
from oiio_msspl.fusion.pair_checks import check_pair
from oiio_msspl.fusion.tile_features import read_features
from oiio_msspl.fusion.tiling import LARGEST, aligned_grid, plan_tiles
from oiio_msspl.model.encoding import decode_radiance, encode_feature, encode_features, encode_radiance, find_exposure
from oiio_msspl.model.session import Session
from oiio_msspl.parallel import for_row_blocks, limit_threads

#: Memory that a run may use by default.
MAX_MEMORY = 3 << 30
#: A pixel of one render is at most so many times as bright as the brightest of the 3 x 3 LRHS pixels around it in the
#: other one: what is beyond is a firefly. Noise apart the bound is s^2 for the HRLS, whose mean over s x s pixels the
#: LRHS is, and 1 for the LRHS.
BRIGHTEST = 64.0
#: A tile whose renders differ nowhere by more, in network values at the LRHS's resolution, has no noise to take out:
#: half a step of an 8-bit picture.
CONVERGED = 1 / 512
#: Interpreter, libraries, weights and buffers that do not grow with the frame.
FIXED_MEMORY = 350 << 20


@dataclass
class FusedFrame:
    """The result over the HRLS's data window."""

    rgb: Array
    """Scene linear, (height, width, 3), finite and >= 0."""
    alpha: Array | None
    """(height, width, 1), clipped to [0, 1], or None if the HRLS has none."""
    error: Array | None
    """(height, width, 1): how far the result is expected to be from the frame of many samples, scene linear, mean of
    the channels; None unless asked for."""
    pairing: Alignment
    exposure: float
    """What the scene was scaled by for the network."""
    repaired: dict[str, int]
    """Values that were NaN, infinite or (but for normals) negative, by layer, ``lrhs.`` or ``hrls.`` in front."""
    warnings: list[str] = field(default_factory=list)
    tiles: int = 1
    seconds: float = 0.0
    """In the network alone."""


def fuse(
    lr: ReadableRender,
    hr: ReadableRender,
    session: Session,
    *,
    error: bool = False,
    max_memory: int = MAX_MEMORY,
    progress: Callable[[int, int], None] | None = None,
) -> FusedFrame:
    """Fuse a low-resolution, high-spp render with a high-resolution, low-spp render of the same frame.

    Args:
        lr, hr: files with their layers mapped (:func:`oiio_msspl.aovs.matching.map_render`) or renders in memory.
        session: a model for the pair's scale.
        error: also predict the result's error.
        max_memory: bytes that the whole process should stay below.
        progress: called with (tiles done, tiles in all).

    Raises:
        InputError: the pair does not fit, or the model is for another scale or does not predict its error.
    """
    pairing = align(lr, hr)
    contract = session.contract
    if error:
        session.require_error()
    if contract.scale != pairing.scale:
        raise InputError(f"model {contract.name} is for x{contract.scale}, but this pair is x{pairing.scale}")
    read = [*contract.features, "alpha"]
    scale, grid = pairing.scale, aligned_grid(pairing.grid, contract.alignment)

    with limit_threads(session.threads):
        lr_repaired: dict[str, int] = {}
        low = _read_low(lr, pairing, grid, lr_repaired, [RGB, *session.low_aovs, "alpha"])
        frame = low[RGB][pairing.grid.slices(grid)]
        exposure = find_exposure(frame)
        warnings = check_pair(frame, hr, pairing, lr.name)
        hr_data = pairing.hr_data
        rgb = np.zeros((hr_data.height, hr_data.width, 3), dtype=np.float32)
        alpha: Array | None = None
        errors = np.zeros((hr_data.height, hr_data.width, 1), dtype=np.float32) if error else None
        hr_repaired: dict[str, int] = {}
        # What is held of the frame: the result (colour, alpha, error) and the LRHS.
        frame_bytes = rgb.nbytes * (5 if error else 4) // 3 + sum(values.nbytes for values in low.values())
        largest = _largest_tile(session, frame_bytes, max_memory)
        plan = list(plan_tiles(grid, largest, contract.overlap, contract.alignment))
        dark = np.all(low[RGB] == 0, axis=-1, keepdims=True)
        far_dark = _far(dark) if dark.any() else dark
        seconds = session.seconds
        for done, tile in enumerate(plan):
            area, core = _scaled(tile.area, scale), _scaled(tile.core, scale)
            target, inside = core.intersect(hr_data), tile.area.slices(grid)
            part = {name: values[inside] for name, values in low.items()}
            layers = read_features(hr, area, hr_data, counts=hr_repaired, counted=core, features=read)
            # Where neither render has any light, not even around, none is invented: a transparent film stays empty. A
            # surface may be so dark that hardly a sample finds light; there, that takes more to believe.
            empty: NDArray[np.bool_] | None = None
            if dark[inside].any():
                empty = _settled(dark[inside], np.all(layers[RGB] == 0, axis=-1, keepdims=True), scale)
                empty &= _bare(layers) | _enlarged(far_dark[inside], scale)
            if empty is None or not empty.all():
                lights, features = _without_fireflies(part[RGB], layers, scale)
                lrhs = encode_features(lights, LRHS_FEATURES, exposure, len(contract.lrhs))
                hrls = encode_features(features, contract.features, exposure, len(contract.hrls))
                seen = tile.area.intersect(pairing.grid).slices(tile.area)  # what lies beyond is made up
                # A few rows show it where there is noise
                if all(_converged(lrhs, features[RGB], exposure, seen, step) for step in (32, 1)):
                    results: tuple[Array, Array | None] = hrls[..., :3], np.zeros_like(hrls[..., :1])
                else:
                    results = session.run(lrhs, hrls, low_aovs=_low_aovs(part, session), error=error)
                values, deviation = results
                colour = rgb[target.slices(hr_data)]
                decode_radiance(values[target.slices(area)], exposure, colour)
                if empty is not None:
                    colour *= ~empty[target.slices(area)]
                if errors is not None and deviation is not None:
                    linear = _linear_error(values, deviation, exposure)
                    if empty is not None:
                        linear *= ~empty
                    errors[target.slices(hr_data)] = linear[target.slices(area)]
            if "alpha" in layers:
                if alpha is None:
                    alpha = np.empty((hr_data.height, hr_data.width, 1), dtype=np.float32)
                alpha[target.slices(hr_data)] = _fuse_alpha(part, layers, session, scale)[target.slices(area)]
            if progress is not None:
                progress(done + 1, len(plan))
    if alpha is not None and "alpha" not in low:
        warnings.append("the LRHS has no alpha: that of the HRLS is kept, noise and all")
    repaired = {f"lrhs.{k}": v for k, v in lr_repaired.items()} | {f"hrls.{k}": v for k, v in hr_repaired.items()}
    return FusedFrame(rgb, alpha, errors, pairing, exposure, repaired, warnings, len(plan), session.seconds - seconds)


def _converged(lrhs: Array, rgb: Array, exposure: float, seen: tuple[slice, slice], step: int) -> bool:
    """Whether the LRHS as the network sees it and the HRLS's colour hardly differ in a part of the tile, of whose rows
    one in ``step`` is looked at."""
    scale = rgb.shape[0] // lrhs.shape[0]
    rows = rgb.reshape(-1, scale, *rgb.shape[1:])[seen[0]][::step]
    means = box_downsample(rows.reshape(-1, *rgb.shape[1:]), scale)
    difference = encode_radiance(means, exposure)[:, seen[1]] - lrhs[seen][::step, :, :3]
    return float(np.abs(difference).max()) <= CONVERGED


def _linear_error(values: Array, deviation: Array, exposure: float) -> Array:
    """An error of network values (h, w, 3) as scene-linear radiance, (h, w, 1)."""
    middle = values.mean(axis=-1, keepdims=True)
    return decode_radiance(middle + deviation, exposure) - decode_radiance(middle, exposure)


def _read_low(
    lr: ReadableRender, pairing: Alignment, grid: Window, repaired: dict[str, int], names: list[str]
) -> dict[str, Array]:
    """Layers of the LRHS, those that are there, over ``grid``, resampled where an odd size was rounded."""
    if pairing.stretch == (1.0, 1.0):
        return read_features(lr, grid, pairing.lr_data, counts=repaired, counted=grid, features=names)
    whole = pairing.lr_data
    low = read_features(lr, whole, whole, counts=repaired, counted=whole, features=names)
    for axis, first, last, stretch, begin in (
        (0, grid.y0, grid.y1, pairing.stretch[1], whole.y0),
        (1, grid.x0, grid.x1, pairing.stretch[0], whole.x0),
    ):
        position = (np.arange(first, last, dtype=np.float64) + 0.5) * stretch - 0.5 - begin
        low = {name: _interpolated(values, position, axis) for name, values in low.items()}
    return low


def _interpolated(values: Array, position: NDArray[np.float64], axis: int) -> Array:
    """Linear interpolation along an axis; the edge pixel is repeated beyond the ends."""
    position = np.clip(position, 0, values.shape[axis] - 1)
    before = np.minimum(position.astype(np.int64), values.shape[axis] - 1)
    after = np.minimum(before + 1, values.shape[axis] - 1)
    share = (position - before).astype(np.float32).reshape([-1 if i == axis else 1 for i in range(values.ndim)])
    return values.take(before, axis) * (1 - share) + values.take(after, axis) * share


def _scaled(window: Window, scale: int) -> Window:
    return Window(window.x0 * scale, window.y0 * scale, window.x1 * scale, window.y1 * scale)


def _largest_tile(session: Session, frame_bytes: int, max_memory: int) -> int:
    """LRHS pixels of the largest tile that fits beside what is kept of the frame."""
    contract = session.contract
    left = max_memory - FIXED_MEMORY - frame_bytes
    pixels = min(left // contract.bytes_per_pixel, LARGEST)
    if pixels <= 0:
        needed = (FIXED_MEMORY + frame_bytes) / 2**30
        raise InputError(f"--max-memory: this frame alone takes {needed:.1f} GiB; allow at least {needed + 0.5:.1f}G")
    return int(pixels) // contract.scale**2


def _without_fireflies(low: Array, layers: dict[str, Array], scale: int) -> tuple[dict[str, Array], dict[str, Array]]:
    """The LRHS's colour, (h, w, 3), and the HRLS's layers, none brighter than the other render around it allows."""
    over_low = _ceiling(box_downsample(layers[RGB], scale))
    over_high = _ceiling(low).repeat(scale, axis=1)[:, None]
    lights = {}
    for name in RADIANCE_FEATURES:
        if name in layers:
            lights[name] = _dimmed(layers[name], over_high, scale)
    return {RGB: np.minimum(low, over_low)}, layers | lights


def _dimmed(values: Array, ceiling: Array, scale: int) -> Array:
    """HRLS values (s*h, s*w, c), none above the ceiling of its LRHS pixel, (h, 1, s*w, c)."""
    result = np.empty_like(values)

    def work(rows: slice) -> None:
        of_low = values[rows].reshape(-1, scale, *values.shape[1:])
        limits = ceiling[rows.start // scale : rows.stop // scale]
        result[rows] = np.minimum(of_low, limits).reshape(-1, *values.shape[1:])

    for_row_blocks(work, len(values), values[0].size, multiple=scale)
    return result


def _ceiling(low: Array) -> Array:
    """The brightest that one render may be, given the other at the LRHS's resolution, (h, w, 3)."""
    highest = low.copy()
    for axis in (0, 1):  # 3 x 3, one way after the other
        lines = highest.swapaxes(0, axis)
        before = lines.copy(order="K")
        np.maximum(lines[1:], before[:-1], out=lines[1:])
        np.maximum(lines[:-1], before[1:], out=lines[:-1])
    with np.errstate(over="ignore"):  # no ceiling, then; nor where there is no light at all
        return np.where(highest > 0, highest * np.float32(BRIGHTEST), np.float32(np.inf))


def _low_aovs(low: dict[str, Array], session: Session) -> dict[str, Array]:
    """What the session reads of the LRHS's layers beside colour, transformed."""
    return {name: encode_feature(name, low[name], 1.0) for name in session.low_aovs if name in low}


def _fuse_alpha(low: dict[str, Array], high: dict[str, Array], session: Session, scale: int) -> Array:
    """Coverage through the same network, as a grey picture with albedo and normal; (h, w, 1) in [0, 1].

    Where both renders agree that a pixel and its surroundings are wholly covered, or wholly empty, it stays exactly so;
    a tile that is all one or all the other never reaches the network.
    """
    alpha = np.clip(high["alpha"], 0.0, 1.0)
    if "alpha" not in low:
        return alpha
    of_low = np.clip(low["alpha"], 0.0, 1.0)
    solid, empty = _settled(of_low == 1, alpha == 1, scale), _settled(of_low == 0, alpha == 0, scale)
    if (solid | empty).all():
        return solid.astype(np.float32)
    grey = {name: values for name, values in high.items() if name in (ALBEDO, NORMAL)}
    grey[RGB] = np.repeat(alpha, 3, axis=-1)
    contract = session.contract
    lrhs = encode_features({RGB: np.repeat(of_low, 3, axis=-1)}, LRHS_FEATURES, 1.0, len(contract.lrhs))
    hrls = encode_features(grey, contract.features, 1.0, len(contract.hrls))
    values, _ = session.run(lrhs, hrls, low_aovs=_low_aovs(low, session))
    fused = np.clip(decode_radiance(values, 1.0).mean(axis=-1, keepdims=True), 0.0, 1.0)
    return np.where(solid, np.float32(1), np.where(empty, np.float32(0), fused))


def _settled(low: NDArray[np.bool_], high: NDArray[np.bool_], scale: int) -> NDArray[np.bool_]:
    """Where something holds for an HRLS pixel (h, w, 1) and for the 3 x 3 LRHS pixels around it."""
    return _enlarged(reduce(np.logical_and, _around(low)), scale) & high


def _enlarged(low: NDArray[np.bool_], scale: int) -> NDArray[np.bool_]:
    """(h, w, 1) to (s*h, s*w, 1)."""
    return low.repeat(scale, axis=0).repeat(scale, axis=1)


def _far(low: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where something holds for all of the 15 x 15 LRHS pixels around, (h, w, 1)."""
    for step in (1, 2, 4):
        low = reduce(np.logical_and, _around(low, step))
    return low


def _bare(layers: dict[str, Array]) -> NDArray[np.bool_]:
    """Where the HRLS (h, w, c) shows no surface, (h, w, 1); everywhere if it has no layer that could tell."""
    signs = [np.all(layers[name] == 0, axis=-1, keepdims=True) for name in ("alpha", NORMAL) if name in layers]
    return reduce(np.logical_or, signs) if signs else np.ones((*layers[RGB].shape[:2], 1), dtype=bool)


def _around(values: NDArray[Any], step: int = 1) -> Iterator[NDArray[Any]]:
    """The 3 x 3 neighbours of every pixel (h, w, c), so many pixels apart, one (h, w, c) each; the edge goes on."""
    height, width = values.shape[:2]
    padded = np.pad(values, ((step, step), (step, step), (0, 0)), mode="edge")
    for y, x in itertools.product(range(0, 3 * step, step), repeat=2):
        yield padded[y : y + height, x : x + width]
