# SPDX-License-Identifier: Apache-2.0
"""Fuses an LRHS and an HRLS, in memory or on disk, tile by tile."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import ReadableRender, Render, Window
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.fusion.checks.pair import HrlsAverages, bounded_luminance, check_pair
from oiio_msspl.fusion.passes.fuse import FusedPasses
from oiio_msspl.fusion.passes.network import LayerFuser
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.alpha import alpha_as_colour, fuse_alpha
from oiio_msspl.fusion.tiles.features import RepairCounts, TilePair, read_lrhs, read_tile
from oiio_msspl.fusion.tiles.guards import (
    FAR,
    LAYER_REACH,
    EmptyRegions,
    bright_lights,
    check_finite,
    dim_fireflies,
    is_noise_free,
    lit_window,
)
from oiio_msspl.fusion.tiles.tiling import (
    MAX_MEMORY,
    Tile,
    aligned_grid,
    memory_for_tiles,
    plan_tiles,
    require_memory,
    sample_bands,
    strips_memory,
)
from oiio_msspl.image.arrays import HALF_MAX, Array, Mask, blank, unload
from oiio_msspl.image.parallel import half_of_the_threads, limit_threads, one_ahead
from oiio_msspl.model.catalogue import shipped_models
from oiio_msspl.model.encoding import decode_radiance, encode_radiance, find_exposure
from oiio_msspl.model.render_mean import Images, Shares, find_shares
from oiio_msspl.model.session import Session


@dataclass
class FusedFrame:
    """The result, over the HRLS's data window."""

    rgb: Array
    """(height, width, 3), scene linear, finite and >= 0: float32, or half where :func:`fuse` was asked for that."""
    alpha: Array | None
    """(height, width, 1) in [0, 1]; None if the HRLS has none."""
    error: Array | None
    """(height, width, 1): expected absolute error of ``rgb`` in scene-linear units, mean of the channels; None unless
    asked for."""
    alignment: Alignment
    exposure: float
    """Factor that the scene was multiplied by for the network."""
    repaired: dict[str, int]
    """Numbers of values that were NaN or infinite, by layer, as ``lrhs.rgb``."""
    lrhs_luminance: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """(h, w): luminance of the LRHS over the alignment's grid, at the places of its HRLS pixels."""
    hrls_luminance: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """(h, w): luminance of the HRLS, averaged over the LRHS's pixels."""
    frames: Array | None = None
    """(height, width, 1): how many frames were averaged, see
    :class:`oiio_msspl.fusion.neighbours.results.Accumulated`; None for a frame that was fused alone."""
    clipped: int = 0
    """Values of ``rgb`` that were too bright for half; 0 for float32."""
    negative: dict[str, int] = field(default_factory=dict)
    """Numbers of values that were negative and set to 0 (colours out of gamut), by layer; never of normals."""
    warnings: list[str] = field(default_factory=list)
    """One sentence each."""
    clean_aovs: dict[str, NDArray[np.float16]] = field(default_factory=dict)
    """Albedo and normal of the HRLS without noise, (height, width, 3), as far as it has them, the model denoises them,
    and they are asked for. Albedos above 1 are as rendered."""
    passes: FusedPasses | None = None
    """The fused layers of additive sets; None if there are none."""
    replaced: ReplacedChannels | None = None
    """New pixels of other channels of the HRLS: the fused layers, and further views; None if there are none."""
    tiles: int = 1
    seconds: float = 0.0
    """Time in the network alone."""

    @property
    def nbytes(self) -> int:
        """Memory of colour, alpha (whether there is one or not) and, if asked for, error."""
        return self.rgb.nbytes + self.rgb.size // 3 * (4 if self.error is None else 8)


def fuse(
    lr: ReadableRender,
    hr: ReadableRender,
    session: Session,
    *,
    error: bool = False,
    clean_aovs: bool = False,
    half: bool = False,
    max_memory: int = MAX_MEMORY,
    held: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> FusedFrame:
    """Fuse a low-resolution, high-spp render with a high-resolution, low-spp render of the same frame.

    Args:
        lr, hr: files with their layers mapped (:func:`oiio_msspl.aovs.matching.map_render`), or renders in memory.
        session: a model for the scale of the pair.
        error: also predict the error of the result.
        clean_aovs: also keep the albedo and the normal that the model denoises, see :attr:`Session.clean_aovs`.
        half: keep the result as half floats, in half the memory, with what is too bright clipped to ``HALF_MAX``.
        max_memory: bytes that the whole process should stay below. The result does not depend on it.
        held: bytes that the caller holds beside this frame.
        progress: called with (tiles done, tiles in all).

    Raises:
        InputError: the pair does not fit together or into memory, or the model is for another scale or does not
            predict its error. No pixel was read.
        MssplError: the network failed, or returned NaN or infinite values.
    """
    alignment = align(lr, hr)
    check_model(session, alignment.scale, error=error)
    require_memory(memory_to_fuse(alignment, session, error=error) + held, session.contract, max_memory)
    seconds = session.seconds
    with limit_threads(session.threads):
        pair = _Pair(lr, hr, alignment, session, session.clean_aovs if clean_aovs else ())
        frame = _blank_frame(alignment, pair.exposure, error=error, half=half)
        with hr.cache_strips(strips_memory(max_memory, held)):
            for step in _run(_steps(pair, frame), session):
                frame.tiles = step.count
                for image in frame.clean_aovs.values():
                    unload(image)
                for render in (lr, hr):
                    render.unload()
                if progress is not None:
                    progress(step.done, step.count)
                del step  # or its memory would be held while the next one is fused
        if frame.tiles > 1:
            session.release_memory()  # to check a large frame needs memory, too
        frame.lrhs_luminance, frame.hrls_luminance = pair.luminances()
        frame.warnings += pair.check()
    frame.repaired, frame.negative = pair.counts("repaired"), pair.counts("negative")
    frame.warnings += _lost_aovs(frame)
    frame.seconds = session.seconds - seconds
    if frame.alpha is not None and not pair.lrhs_has_alpha:
        frame.warnings.append("the LRHS has no alpha, so the noisy alpha of the HRLS is kept")
    return frame


def _lost_aovs(frame: FusedFrame) -> list[str]:
    """A sentence for each AOV of the HRLS that is broken in most of its values."""
    pixels = frame.rgb.shape[0] * frame.rgb.shape[1]
    shares = {name: frame.repaired.get(f"hrls.{name}", 0) / (3 * pixels) for name in (ALBEDO, NORMAL)}
    return [
        f"{share:.0%} of the HRLS's {name} is NaN or infinite, so it tells little of the surfaces; render it again"
        for name, share in shares.items()
        if share > 0.5
    ]


def fuse_layers(
    pairs: Iterable[tuple[Render, Render]], session: Session, alignment: Alignment, exposure: float, reach: int
) -> Iterator[Array]:
    """Fuse layers of both renders of a frame, such as the light of each lamp.

    Args:
        pairs: both renders with a layer in place of the beauty, for each layer. The next pair is taken in the
            background while the network works.
        session: a model for the scale of the pair.
        alignment: of the pairs.
        exposure: that of the frame's beauty, because networks tell light from noise by its brightness.
        reach: see :class:`oiio_msspl.fusion.tiles.guards.EmptyRegions`.

    The caller limits the threads of NumPy, see :func:`oiio_msspl.image.parallel.limit_threads`.

    Yields:
        The fused layers, (height, width, 3) over the HRLS's data window, finite and >= 0: in temporary files, if they
        have many pixels.

    Raises:
        InputError: pixels can't be decoded.
        MssplError: the network failed, or returned NaN or infinite values.
    """

    size = alignment.hr_data_window.height, alignment.hr_data_window.width

    def steps() -> Iterator[_Step]:
        for lr, hr in pairs:
            # The network works at the same time, and has threads on all cores.
            with half_of_the_threads():
                pair = _Pair(lr, hr, alignment, session, (), (exposure, reach))
            result = FusedFrame(blank((*size, 3)), None, None, alignment, exposure, {})
            for step in _steps(pair, result, half_of_the_threads):
                for render in (lr, hr):
                    render.unload()
                yield step

    for step in _run(steps(), session):
        unload(step.result.rgb)
        finished = step.result.rgb if step.done == step.count else None
        del step  # or its memory would be held while the next one is fused
        if finished is not None:
            yield finished


def layer_fuser(session: Session, frame: FusedFrame) -> LayerFuser | None:
    """What fuses single layers of a frame whose beauty ``session`` has fused; None if no network does."""
    if session.layers is None:
        return None

    def fuse_them(pairs: Iterable[tuple[Render, Render]], alignment: Alignment) -> Iterator[Array]:
        whole = alignment.scale == frame.alignment.scale
        layer_session = session.layer_session if whole else session.half_layer_session
        assert layer_session is not None
        reach = max(LAYER_REACH // frame.alignment.scale - 1, 1)
        return fuse_layers(pairs, layer_session, alignment, frame.exposure, reach)

    return fuse_them


def memory_to_fuse(alignment: Alignment, session: Session, *, error: bool) -> int:
    """The smallest ``max_memory`` with which a pair can be fused, from its headers."""
    grid = _grid(alignment, session)
    # Of the features that the LRHS may have; it is not read yet. Alpha has 1 channel, every other one 3.
    lrhs_bytes = grid.width * grid.height * (3 * len(session.contract.lrhs) + 1) * 4
    frame_bytes = result_bytes(alignment, error=error) + lrhs_bytes
    # The tiles of larger frames are as large. A damaged header may claim millions of tiles.
    part = grid.intersect(Window(grid.x0, grid.y0, grid.x0 + 16384, grid.y0 + 16384))
    tiles = plan_tiles(part, session.contract)
    return memory_for_tiles(session.contract, tiles, frame_bytes)


def tile_count(alignment: Alignment, session: Session) -> int:
    """The number of tiles that a pair is fused in."""
    return len(plan_tiles(_grid(alignment, session), session.contract))


def _grid(alignment: Alignment, session: Session) -> Window:
    """The LRHS pixels that the network reads: the alignment's grid, extended to a size that the network takes."""
    return aligned_grid(alignment.grid, session.contract.alignment)


def result_bytes(alignment: Alignment, *, error: bool) -> int:
    """Memory of a result: colour, alpha (whether there is one or not) and, if asked for, error."""
    return alignment.hr_data_window.width * alignment.hr_data_window.height * (5 if error else 4) * 4


def check_model(session: Session, scale: int, *, error: bool) -> None:
    """Raise InputError if a model is for another scale than a pair, or does not predict the ``error`` if that is asked
    for."""
    if error:
        session.require_error()
    if session.contract.scale != scale:
        name = session.contract.name
        hint = f"; --model {name.rpartition('-x')[0]} takes the one for the pair" if name in shipped_models() else ""
        raise InputError(f"model {name} is for x{session.contract.scale}, but this pair is x{scale}{hint}")


def _blank_frame(alignment: Alignment, exposure: float, *, error: bool, half: bool) -> FusedFrame:
    size = (alignment.hr_data_window.height, alignment.hr_data_window.width)
    errors: Array | None = blank((*size, 1), on_disk=False) if error else None
    rgb: NDArray[Any] = blank((*size, 3), np.float16 if half else np.float32, on_disk=False)
    return FusedFrame(rgb, None, errors, alignment, exposure, {})


@dataclass(frozen=True)
class _FrameShares:
    """How a model averages both renders of a frame."""

    rgb: Shares = field(default_factory=dict)
    alpha: Shares = field(default_factory=dict)


@dataclass
class _PreparedTile:
    """A tile that is ready for the network."""

    area: Window
    """The tile's area in HRLS pixels."""
    target: Window
    """The part of the HRLS's data window that the tile contributes."""
    empty: Mask | None
    """See :meth:`oiio_msspl.fusion.tiles.guards.EmptyRegions.mask`."""
    pair: TilePair
    """With alpha, albedo and normal of the HRLS only."""
    lrhs: Images | None = None
    """Inputs of the model; None for a tile that is empty everywhere."""
    hrls: Images | None = None
    lights: Array | None = None
    """See :func:`oiio_msspl.fusion.tiles.guards.bright_lights`."""
    noise_free: bool = False
    """There is no noise to remove: the HRLS is the result."""
    aovs: tuple[str, ...] = ()
    """AOVs of the HRLS whose denoised pixels are kept."""


class _Pair:
    """The LRHS in memory, and the HRLS that is read tile by tile."""

    def __init__(
        self,
        lr: ReadableRender,
        hr: ReadableRender,
        alignment: Alignment,
        session: Session,
        aovs: Sequence[str],
        of_layer: tuple[float, int] | None = None,
    ) -> None:
        """
        Args:
            aovs: see :attr:`_PreparedTile.aovs`.
            of_layer: exposure and reach of :func:`fuse_layers`, if the pair shows a layer. Then there is no
                :meth:`check`.
        """
        self._lr, self._hr, self._alignment, self._session, self._aovs = lr, hr, alignment, session, aovs
        self.grid = _grid(alignment, session)
        self._lrhs_counts, self._hrls_counts = RepairCounts(), RepairCounts()
        features = [*session.contract.lrhs, "alpha"]
        self._lrhs = read_lrhs(lr, alignment, self.grid, features, self._lrhs_counts)
        self._lrhs_rgb = self._lrhs[RGB][alignment.grid.slices(self.grid)]
        self.exposure, reach = of_layer or (find_exposure(self._lrhs_rgb), FAR)
        self._empty_regions = EmptyRegions(self._lrhs[RGB], reach, of_layer=of_layer is not None)
        self._part = self._lit_part(reach) if of_layer else None
        self._averages = None if of_layer else HrlsAverages(alignment)

    @property
    def lrhs_has_alpha(self) -> bool:
        return "alpha" in self._lrhs

    def counts(self, kind: str) -> dict[str, int]:
        """What :attr:`FusedFrame.repaired` (``repaired``) or :attr:`FusedFrame.negative` (``negative``) holds."""
        renders = (("lrhs", self._lrhs_counts), ("hrls", self._hrls_counts))
        return {f"{which}.{name}": n for which, counts in renders for name, n in getattr(counts, kind).items()}

    def tiles(self) -> list[Tile]:
        """The tiles in which the pair is fused. A layer is black where none of them is."""
        return plan_tiles(self.grid, self._session.contract, self._part)

    def prepare(self, tile: Tile) -> _PreparedTile:
        """Read a tile and dim fireflies."""
        contract, grid = self._session.contract, self.grid
        features = [*contract.hrls, "alpha"]
        pair = read_tile(tile, self._lrhs, grid, self._hr, self._alignment, features, self._hrls_counts)
        if self._averages is not None:
            self._averages.add(pair)
        empty = self._empty_regions.mask(pair, tile.area.slices(grid))
        # An empty tile may still show surfaces.
        lit = empty is None or not empty.all() or bool(self._aovs)
        rest = {name: values for name, values in pair.hrls.items() if name in (ALBEDO, NORMAL, "alpha")}
        aovs = tuple(name for name in self._aovs if name in pair.hrls)
        prepared = _PreparedTile(pair.hrls_area, pair.hrls_target, empty, replace(pair, hrls=rest), aovs=aovs)
        if lit:
            lrhs_rgb, prepared.hrls = dim_fireflies(pair)
            prepared.lrhs = pair.lrhs | {RGB: lrhs_rgb}
            prepared.lights = bright_lights(lrhs_rgb, prepared.hrls[RGB], self.exposure)
            prepared.noise_free = is_noise_free(pair, lrhs_rgb, prepared.hrls[RGB], self.exposure)
        return prepared

    def _lit_part(self, reach: int) -> Window | None:
        """The part of the grid beyond which both renders are black, and as far from light as ``reach``, see
        :class:`EmptyRegions`; None, for all of it, if a render is black everywhere."""
        scale, data = self._alignment.scale, self._alignment.hr_data_window
        low = lit_window(self._lrhs[RGB], self.grid, reach)
        high = lit_window(self._hr.read(self._hr.data_window, [RGB])[RGB], data, 0)
        if low is None or high is None:
            return None
        whole = Window(high.x0 // scale, high.y0 // scale, -(-high.x1 // scale), -(-high.y1 // scale))
        both = min(low.x0, whole.x0), min(low.y0, whole.y0), max(low.x1, whole.x1), max(low.y1, whole.y1)
        return Window(*both).intersect(self.grid)

    def sample_shares(self) -> _FrameShares:
        """Decide how to average both renders, from a sample of the frame, so that neighbouring tiles agree."""
        contract = self._session.contract
        if not contract.denoiser:
            return _FrameShares()
        rgb, alpha = [], []
        for band in sample_bands(self._alignment.grid, contract.scale):
            features, counts = [RGB, ALBEDO, NORMAL, "alpha"], RepairCounts()
            pair = read_tile(Tile(band, band), self._lrhs, self.grid, self._hr, self._alignment, features, counts)
            lrhs_rgb, hrls = dim_fireflies(pair)
            rgb.append((pair.lrhs | {RGB: lrhs_rgb}, hrls))
            if "alpha" in pair.lrhs and "alpha" in pair.hrls:
                alpha.append(alpha_as_colour(pair))
        return _FrameShares(find_shares(rgb, self.exposure), find_shares(alpha, 1.0) if alpha else {})

    def luminances(self) -> tuple[Array, Array]:
        """Luminance of both renders at the same places, (h, w) each over the grid, once all tiles are prepared."""
        assert self._averages is not None
        lrhs, alignment = self._lrhs_rgb, self._alignment
        if alignment.stretch != (1.0, 1.0):  # networks read the nearest pixels, which lie beside these places
            lrhs = read_lrhs(self._lr, alignment, alignment.grid, [RGB], RepairCounts(), exact=True)[RGB]
        return bounded_luminance(lrhs), self._averages.rgb

    def check(self) -> list[str]:
        """Compare the two renders once all tiles are prepared, see :func:`check_pair`."""
        assert self._averages is not None
        return check_pair(bounded_luminance(self._lrhs_rgb), self._averages, self._lr.name, self._hr.name)


@dataclass(frozen=True)
class _Step:
    """A tile that is ready for the network, of the beauty or of a layer."""

    pair: _Pair
    tile: _PreparedTile
    shares: _FrameShares
    result: FusedFrame
    """Gets the tile's core."""
    done: int
    """Tiles of the result up to this one."""
    count: int
    """Tiles of the result."""


def _steps(
    pair: _Pair, result: FusedFrame, threads: Callable[[], AbstractContextManager[object]] = nullcontext
) -> Iterator[_Step]:
    """Prepare the tiles of a frame, one after the other, each inside of ``threads()``."""
    tiles = pair.tiles()
    with threads():
        shares = pair.sample_shares()
    for done, tile in enumerate(tiles, start=1):
        with threads():
            prepared = pair.prepare(tile)
        yield _Step(pair, prepared, shares, result, done, len(tiles))


def _run(steps: Iterable[_Step], session: Session) -> Iterator[_Step]:
    """Run the network on each tile; the next one is read meanwhile. Yield each when it is fused."""
    for step in one_ahead(steps):
        _fuse_tile(step.tile, session, step.result, step.shares)
        yield step


def _fuse_tile(tile: _PreparedTile, session: Session, frame: FusedFrame, shares: _FrameShares) -> None:
    """Run the network on a tile and write its core into the frame."""
    empty = tile.empty
    target = tile.target.slices(frame.alignment.hr_data_window)
    core = tile.target.slices(tile.area)
    if tile.hrls is not None:
        images = _run_network(tile, session, frame.exposure, shares.rgb, error=frame.error is not None)
        for name in tile.aovs:
            if name not in frame.clean_aovs:
                frame.clean_aovs[name] = blank(frame.rgb.shape, np.float16)
            frame.clean_aovs[name][target] = images[name][core].clip(-HALF_MAX, HALF_MAX)
        rgb = images["fused"][core]
        if tile.lights is not None:
            lights = tile.lights[core]
            rgb = np.where(np.any(lights > 0, axis=-1, keepdims=True), lights, rgb)
        if empty is not None:
            rgb = rgb * ~empty[core]
        if frame.rgb.dtype == np.float16:
            frame.clipped += int(np.count_nonzero(rgb > HALF_MAX))
            rgb = np.minimum(rgb, np.float32(HALF_MAX))
        frame.rgb[target] = rgb
        if frame.error is not None:
            error = _scene_linear_error(images["fused"], images["error"], frame.exposure)
            if empty is not None:
                error *= ~empty
            frame.error[target] = error[core]
    if "alpha" in tile.pair.hrls:
        if frame.alpha is None:
            frame.alpha = np.empty((*frame.rgb.shape[:2], 1), dtype=np.float32)
        frame.alpha[target] = fuse_alpha(tile.pair, session, shares.alpha)[core]


def _run_network(tile: _PreparedTile, session: Session, exposure: float, shares: Shares, *, error: bool) -> Images:
    """What :meth:`Session.run` returns for a tile, with its expected error if asked for."""
    assert tile.lrhs is not None and tile.hrls is not None
    if tile.noise_free:
        own = {name: tile.pair.hrls[name] for name in tile.aovs}
        errors = {"error": np.zeros_like(tile.hrls[RGB][..., :1])} if error else {}
        return {"fused": tile.hrls[RGB], **errors, **own}
    images = session.run(tile.lrhs, tile.hrls, exposure, shares, error=error, aovs=tile.aovs)
    check_finite(session, *images.values())
    if ALBEDO in images:
        # The albedo of an emitter may be its light. The network only knows albedos up to 1.
        albedo = tile.pair.hrls[ALBEDO]
        images[ALBEDO] = np.where((albedo > 1).any(axis=-1, keepdims=True), albedo, images[ALBEDO])
    return images


def _scene_linear_error(rgb: Array, error: Array, exposure: float) -> Array:
    """An error (h, w, 1) of the log-encoded colour, in scene-linear units as the colour (h, w, 3)."""
    grey = encode_radiance(rgb, exposure).mean(axis=-1, keepdims=True)
    return decode_radiance(grey + error, exposure) - decode_radiance(grey, exposure)
