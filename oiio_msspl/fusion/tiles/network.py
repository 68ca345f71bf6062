# SPDX-License-Identifier: Apache-2.0
"""Runs the network on the tiles of a frame, of its beauty or of its passes, and writes them into the result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, RGB
from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.tiles.alignment import Alignment
from oiio_msspl.fusion.tiles.features import TileFeatures, in_hrls_pixels
from oiio_msspl.fusion.tiles.guards import (
    LAYER_REACH,
    SMEAR,
    black_in_both,
    check_finite,
    repeated,
    with_pure_colours,
    without_pure_colours,
)
from oiio_msspl.fusion.tiles.prepare import FramePair, PreparedTile, alpha_as_colour
from oiio_msspl.fusion.tiles.tiling import Tile
from oiio_msspl.fusion.tiles.trust import trust_renders
from oiio_msspl.image.arrays import HALF_MAX, Array, blank, unload
from oiio_msspl.image.filters import all_within, box_downsample, enlarged
from oiio_msspl.image.parallel import half_of_the_threads, one_ahead
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.render_mean import Images, Shares
from oiio_msspl.model.session import Session

#: Alpha that is 0 or 1 in both renders, with one pixel around, stays so if that of the network differs by less.
INVISIBLE = 1 / 256


@dataclass
class FusedPixels:
    """The fused pixels of a frame, over the HRLS's data window."""

    rgb: Array
    """(height, width, 3), scene linear, finite and >= 0: float32, or half if that was asked for."""
    alpha: Array | None
    """(height, width, 1) in [0, 1]; None if the HRLS has none."""
    error: Array | None
    """(height, width, 1): expected absolute error of ``rgb`` in scene-linear units, mean of the channels; None unless
    asked for."""
    alignment: Alignment
    exposure: float
    """Factor that the scene was multiplied by for the network."""
    trust: Array | None = field(default=None, kw_only=True)
    """(h, w) over the alignment's grid, in [0, 1]: how much of the difference to the HRLS was put back, see
    :func:`oiio_msspl.fusion.tiles.trust.trust_renders`. None if the network's picture is kept."""
    clipped: int = field(default=0, kw_only=True)
    """Number of values of ``rgb`` that were too bright for half; 0 for float32."""
    clean_aovs: dict[str, NDArray[np.float16]] = field(default_factory=dict, kw_only=True)
    """Albedo and normal of the HRLS without noise, (height, width, 3): those that it has, that the model denoises and
    that were asked for. Albedos above 1 are as rendered."""

    def trust_pixels(self) -> Array:
        """Return ``trust`` at the resolution of the HRLS, (height, width, 1); 0 without it."""
        if self.trust is None:
            return np.zeros_like(self.rgb[..., :1], np.float32)
        scale, grid = self.alignment.scale, in_hrls_pixels(self.alignment.grid, self.alignment.scale)
        return enlarged(self.trust[..., None], scale)[self.alignment.hr_data_window.slices(grid)]


@dataclass(frozen=True)
class TileTask:
    """A tile that is ready for the network, and the result into which it is written."""

    tile: PreparedTile
    shares: tuple[Shares, Shares]
    """Of colour and alpha, see :meth:`FramePair.sample_shares`."""
    result: FusedPixels
    number: int
    """Tiles of the result up to this one."""
    count: int
    """Tiles of the result."""


def tile_tasks(
    pair: FramePair,
    result: FusedPixels,
    threads: Callable[[], AbstractContextManager[object]] = nullcontext,
    tiles: Sequence[Tile] | None = None,
) -> Iterator[TileTask]:
    """Prepare the tiles of a frame, or some of them, one after the other, each inside of ``threads()``."""
    tiles = pair.tiles() if tiles is None else tiles
    with threads():
        shares = pair.sample_shares()
    for number, tile in enumerate(tiles, start=1):
        with threads():
            prepared = pair.prepare(tile)
        yield TileTask(prepared, shares, result, number, len(tiles))


def fuse_tiles(tasks: Iterable[TileTask], session: Session) -> Iterator[TileTask]:
    """Run the network on each tile, write it into its result, and yield it. The next tile is prepared meanwhile."""
    for task in one_ahead(tasks):
        _fuse_tile(task, session)
        yield task
        del task  # or its memory would be held while the next one is fused


def _fuse_tile(task: TileTask, session: Session) -> None:
    """Run the network on a tile and write its core into the result."""
    tile, result, (shares, alpha_shares) = task.tile, task.result, task.shares
    features, empty = tile.features, tile.empty
    target = features.hrls_target.slices(result.alignment.hr_data_window)
    core = features.hrls_target.slices(features.hrls_area)
    if "alpha" in features.hrls:
        if result.alpha is None:
            result.alpha = np.empty((*result.rgb.shape[:2], 1), dtype=np.float32)
        alpha = _fuse_alpha(features, session, alpha_shares, trust=result.trust is not None)
        result.alpha[target] = alpha[core]
        if empty is not None and tile.lrhs is not None and tile.hrls is not None:
            empty = empty | black_in_both(tile.lrhs[RGB], tile.hrls[RGB]) & (alpha == 0)
    if tile.hrls is not None:
        images = _run_network(tile, session, result.exposure, shares, error=result.error is not None)
        for name in tile.aovs:
            if name not in result.clean_aovs:
                result.clean_aovs[name] = blank(result.rgb.shape, np.float16)
            result.clean_aovs[name][target] = images[name][core].clip(-HALF_MAX, HALF_MAX)
        rgb = _trusted(tile, images["fused"], result, shares, session.contract.overlap)[core]
        if tile.lights is not None:
            lights = tile.lights[core]
            rgb = np.where(np.any(lights > 0, axis=-1, keepdims=True), lights, rgb)
        if empty is not None:
            rgb = rgb * ~empty[core]
        if result.rgb.dtype == np.float16:
            result.clipped += int(np.count_nonzero(rgb > HALF_MAX))
            rgb = np.minimum(rgb, np.float32(HALF_MAX))
        result.rgb[target] = rgb
        if result.error is not None:
            # The network's error is one of log-encoded colours.
            grey = encode_radiance(images["fused"], result.exposure).mean(axis=-1, keepdims=True)
            bright = decode_radiance(grey + images["error"], result.exposure)
            error = bright - decode_radiance(grey, result.exposure)
            if empty is not None:
                error *= ~empty
            result.error[target] = error[core]


def _fuse_alpha(tile: TileFeatures, session: Session, shares: Shares, *, trust: bool) -> Array:
    """Fuse the alpha of a tile, (s*h, s*w, 1) in [0, 1], by the network as if it were a grey picture."""
    hrls_alpha = np.clip(tile.hrls["alpha"], 0.0, 1.0)
    if "alpha" not in tile.lrhs:
        return hrls_alpha
    lrhs_alpha = np.clip(tile.lrhs["alpha"], 0.0, 1.0)
    # A pixel stays 0 or 1 if both renders have that value there and around it.
    exact = [repeated(lrhs_alpha == value, tile.scale) & (hrls_alpha == value) for value in (0, 1)]
    if (exact[0] | exact[1]).all():
        return exact[1].astype(np.float32)
    grey = session.run(alpha_as_colour(tile.lrhs), alpha_as_colour(tile.hrls), 1.0, shares)["fused"]
    check_finite(session, grey)
    fused = grey.mean(axis=-1, keepdims=True)
    if trust and RGB in shares:
        reach = session.contract.overlap
        fused, _ = trust_renders(fused, lrhs_alpha, hrls_alpha, share=shares[RGB], exposure=1.0, reach=reach)
    fused = np.clip(fused, 0.0, 1.0)
    for value, mask in enumerate(exact):
        near = all_within(mask, 1) & (np.abs(fused - np.float32(value)) < INVISIBLE)
        fused[all_within(mask, SMEAR) | near] = value
    return fused


def _trusted(tile: PreparedTile, fused: Array, result: FusedPixels, shares: Shares, reach: int) -> Array:
    """Return the picture of a tile with the detail and the light that both renders show."""
    if result.trust is None or tile.noise_free or (RGB not in shares and tile.variance is None):
        return fused
    assert tile.lrhs is not None and tile.hrls is not None
    lrhs, hrls, share = tile.lrhs[RGB], tile.hrls[RGB], shares.get(RGB, 0.5)
    borrowed, scale = tile.features.borrowed, tile.features.scale
    if tile.variance is not None:
        deviation = np.sqrt(tile.variance)  # two renders of half of the samples would differ by twice that on average
        lrhs, hrls = hrls + deviation, hrls - deviation
    if borrowed is not None:
        lrhs = np.where(borrowed[..., None], box_downsample(fused, scale), lrhs)
    picture, trust = trust_renders(
        fused, lrhs, hrls, share=share, exposure=result.exposure, reach=reach, correct_light=tile.variance is None
    )
    if borrowed is not None:  # there, the renders are not independent
        trust[borrowed] = 0
        picture = np.where(repeated(borrowed[..., None], scale), fused, picture)
    core, area = tile.features.core, tile.features.lrhs_area
    result.trust[core.slices(result.alignment.grid)] = trust[core.slices(area)]
    return picture


def _run_network(tile: PreparedTile, session: Session, exposure: float, shares: Shares, *, error: bool) -> Images:
    """Return the images of :meth:`Session.run` for a tile; the HRLS itself if the tile has no noise."""
    assert tile.lrhs is not None and tile.hrls is not None
    if tile.noise_free:
        errors = {"error": np.zeros_like(tile.hrls[RGB][..., :1])} if error else {}
        return {"fused": tile.hrls[RGB], **errors, **{name: tile.features.hrls[name] for name in tile.aovs}}
    colours = [without_pure_colours(render[RGB], exposure) for render in (tile.lrhs, tile.hrls)]
    low, high = (render | {RGB: rgb} for render, rgb in zip((tile.lrhs, tile.hrls), colours, strict=True))
    images = session.run(low, high, exposure, shares, error=error, aovs=tile.aovs)
    check_finite(session, *images.values())
    images["fused"] = with_pure_colours(images["fused"], tile.hrls[RGB], colours[1], exposure)
    if ALBEDO in images:
        # The albedo of an emitter may be its light. The network only knows albedos up to 1.
        albedo = tile.features.hrls[ALBEDO]
        images[ALBEDO] = np.where((albedo > 1).any(axis=-1, keepdims=True), albedo, images[ALBEDO])
    return images


def fuse_layers(
    session: Session, beauty: FusedPixels, renders: Iterable[tuple[Render, Render]], alignment: Alignment
) -> Iterator[Array]:
    """Fuse passes of a frame, such as the light of each lamp.

    Args:
        session: has a model for layers.
        beauty: fused by it.
        renders: LRHS and HRLS with a pass in place of the beauty, for each pass. The next two are taken in the
            background while the network works.
        alignment: of the renders.

    Yields:
        The fused passes, (height, width, 3) over the HRLS's data window, finite and >= 0: in temporary files if they
        have many pixels.
    """
    layer_session = session.layer_session(half=alignment.scale != beauty.alignment.scale)
    # Networks tell light from noise by its brightness, so the exposure is that of the beauty.
    of_pass = (beauty.exposure, max(LAYER_REACH // beauty.alignment.scale - 1, 1))
    size = alignment.hr_data_window.height, alignment.hr_data_window.width

    def tasks() -> Iterator[TileTask]:
        for lr, hr in renders:
            # The network works at the same time, and has threads on all cores.
            with half_of_the_threads():
                pair = FramePair(lr, hr, alignment, layer_session.contract, of_pass=of_pass)
            result = FusedPixels(blank((*size, 3)), None, None, alignment, beauty.exposure)
            for task in tile_tasks(pair, result, half_of_the_threads):
                for render in (lr, hr):
                    render.unload()
                yield task

    for task in fuse_tiles(tasks(), layer_session):
        unload(task.result.rgb)
        finished = task.result.rgb if task.number == task.count else None
        del task  # or its memory would be held while the next one is fused
        if finished is not None:
            yield finished
