# SPDX-License-Identifier: Apache-2.0
"""Fuses the layers of additive sets, so that they still sum to the fused beauty.

A layer is estimated by a network (:mod:`oiio_msspl.fusion.passes.network`), or by a fit to the fused beauty
(:mod:`oiio_msspl.fusion.passes.lines`). Then the sum is made exact (:mod:`oiio_msspl.fusion.passes.exact_sum`).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce

import numpy as np

from oiio_msspl.aovs.additive_sets import AdditiveLayer
from oiio_msspl.exr.render import Window
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.passes.bands import Band, PassInputs, PassSources, band_windows, estimated_of, in_both
from oiio_msspl.fusion.passes.exact_sum import DARKEST_COLOUR, SharesAround, doubts_of, make_exact
from oiio_msspl.fusion.passes.layers import LayerLight, colours_of, is_large, layer_names, light_of, lrhs_names
from oiio_msspl.fusion.passes.lines import STEPS
from oiio_msspl.fusion.passes.network import LayersByNetwork
from oiio_msspl.fusion.passes.plan import PassJob, plan_passes
from oiio_msspl.image.arrays import HALF_MAX, Array, unload
from oiio_msspl.image.parallel import half_of_the_threads, in_parallel, one_ahead
from oiio_msspl.model.session import Session

#: What derived layers leave of the beauty counts as rounding below this share of it.
ROUNDING = np.float32(5e-7)
#: A render whose logarithm of light differs by this much from that of the fused beauty has 1/e of the weight.
LIGHT_SPREAD = 1.0


@dataclass
class FusedPasses:
    """The fused layers of all sets."""

    jobs: list[PassJob]
    """The sets that were fused."""
    pixels: ReplacedChannels
    """Their new pixels, over the HRLS's data window."""
    refused: dict[str, str]
    """Why other sets were not fused, by name."""
    warnings: list[Finding]
    """Sentences on sets whose layers the LRHS lacks, or do not sum to its beauty, or were too bright for half."""


def fuse_passes(
    inputs: PassInputs,
    pixels: ReplacedChannels | None = None,
    *,
    session: Session | None = None,
    cache_bytes: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> FusedPasses:
    """Fuse the layers of additive sets of the HRLS.

    Args:
        inputs: the fused pair and the sets.
        pixels: where the fused layers go; None for a new store.
        session: its network for layers fuses them, if it has one. Layers that it can't fuse are fitted.
        cache_bytes: memory for decoded rows that two bands need.
        progress: called with (steps done, steps in all).

    Raises:
        InputError: pixels can't be decoded.
    """
    low, high = _read_light(inputs, by_network=session is not None and len(session.layers) > 0)
    jobs, refused, warnings = plan_passes(low, high, inputs.sets)
    sources = _sources_of(inputs, low, high)
    in_order = sorted(jobs, key=lambda job: inputs.sets.index(job.layers))
    fused = FusedPasses(in_order, ReplacedChannels() if pixels is None else pixels, refused, warnings)
    window = inputs.alignment.hr_data_window
    fused.pixels.add([channel for job in jobs for channel in job.channels], window.width, window.height)
    network = LayersByNetwork(sources, jobs, session)
    bands = len(band_windows(inputs.alignment))
    # A layer for a network counts as much as a set. Without any set, all is done.
    steps, done = bands * sum(1 + network.count(job) for job in jobs) or 1, 0 if jobs else 1

    def tell(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(done, steps)

    tell(0)
    for _ in itertools.chain.from_iterable(map(network.fuse, jobs)):
        tell(bands)
    later = {part for job in jobs for parts in job.derived.values() for part in parts}
    clipped, repaired = Counter[str](), Counter[str]()
    shares = SharesAround(sources)
    with high.pixels.cache_strips(cache_bytes // 2), low.pixels.cache_strips(cache_bytes // 2):
        for band in _read_bands(sources, jobs, network):
            lights: dict[AdditiveLayer, Array] = {}
            for job in jobs:
                with half_of_the_threads():
                    made = _fuse_set(job, band, network, shares, lights)
                    new = {layer: light for layer, light in made.items() if layer not in lights}
                    clipped[job.layers.name] += _store(new, band, window, fused.pixels)
                # Copies, because a layer alone would keep the memory of its whole set.
                lights |= {layer: made[layer].copy() for layer in made.keys() & later}
                tell(1)
            repaired.update(band.repaired)
    fused.warnings += [
        Finding(
            "clipped",
            f"{name}: {count} values are too bright for half and were clipped to {HALF_MAX:.0f}, so the layers do not "
            "sum to the beauty there; render them as float",
        )
        for name, count in clipped.items()
        if count
    ]
    fused.warnings += [
        Finding("repaired", f"{name}: {count} values of the HRLS are NaN or infinite; they were repaired")
        for name, count in repaired.items()
    ]
    return fused


def _read_light(inputs: PassInputs, *, by_network: bool) -> tuple[LayerLight, LayerLight]:
    """Return the light of all layers of LRHS and HRLS."""
    # A large frame is read in strips if no network needs whole layers, and the strips that are compared twice.
    decode = inputs.averaged is None and (by_network or not is_large(inputs.hr))
    low, high = inputs.decoded or (None, None)
    if inputs.lr is inputs.hr:
        light = light_of(inputs.hr, layer_names(inputs.sets), decode=decode, decoded=high)
        return light, light
    return in_parallel(
        partial(light_of, inputs.lr, lrhs_names(inputs.lr, inputs.sets), decode=decode, decoded=low),
        partial(light_of, inputs.hr, layer_names(inputs.sets), decode=decode, decoded=high),
    )


def _sources_of(inputs: PassInputs, low: LayerLight, high: LayerLight) -> PassSources:
    lrhs, hrls, names = low.pixels, high.pixels, colours_of(high.names)
    if inputs.averaged is not None:
        # Light is divided by the colours of this frame, because those are written.
        colours = high.file.load(names.values(), on_disk=is_large(high.file)).layers
        lrhs, averaged = inputs.averaged
        hrls = replace(averaged, layers=averaged.layers | colours)
    return PassSources(**vars(inputs), low=lrhs, high=hrls, colours=names)


def _read_bands(sources: PassSources, jobs: Sequence[PassJob], network: LayersByNetwork) -> Iterator[Band]:
    """Yield bands from top to bottom. The next one is read and compared while the layers of one are fused."""

    def prepare(core: Window) -> Band:
        with half_of_the_threads():
            return Band(sources, core, jobs, network.at_full_size)

    for band in one_ahead(map(prepare, band_windows(sources.alignment) if jobs else ())):
        yield band
        for image in sources.beauty.clean_aovs.values():
            unload(image)
        network.unload()


def _fuse_set(
    job: PassJob, band: Band, network: LayersByNetwork, shares: SharesAround, earlier: Mapping[AdditiveLayer, Array]
) -> dict[AdditiveLayer, Array]:
    """Return the light of each layer of a set, (3, h, w) over the core of a band, given that of earlier sets."""
    lights = {layer: reduce(np.add, (earlier[part] for part in parts)) for layer, parts in job.derived.items()}
    if job.estimated:
        rest = band.beauty
        if lights:
            rest = rest - reduce(np.add, lights.values())
            rest[rest < ROUNDING * band.beauty] = 0
        renders = band.renders_of(job)
        doubts = doubts_of(job, band, *renders) if job.lrhs else None
        layers = np.zeros((len(job.estimated) + job.remainder, *rest.shape), np.float32)
        fused = network.estimate(band, job, layers)
        if job in band.to_fit:
            _fit_to_beauty(band, job, renders, layers, [i for i in range(len(layers)) if i not in fused])
        make_exact(layers, rest, job, band, shares, doubts)
        lights |= dict(zip(job.estimated, layers, strict=False))
    return lights | {layer: reduce(np.add, (lights[part] for part in parts)) for layer, parts in job.coarser.items()}


def _fit_to_beauty(band: Band, job: PassJob, renders: Sequence[Array], out: Array, missing: Sequence[int]) -> None:
    """Fit the ``missing`` layers in ``out`` (layers, 3, h, w) to the fused beauty; changes ``renders``."""
    noisy, *lrhs = renders
    for layers in lrhs:
        weight = _likeness(band, layers)
        for i in np.flatnonzero(in_both(job, len(noisy))):
            noisy[i] += weight * layers[i]
            noisy[i] /= 1 + weight
    noisy = estimated_of(job, noisy)
    if lit := [i for i in missing if noisy[i].any()]:
        fit = band.fit_at(STEPS[band.scale])
        fit.fit_layers([noisy[i] for i in lit], [out[i] for i in lit], few_samples=True)


def _likeness(band: Band, layers: Array) -> Array:
    """Return the weight (h, w) of the LRHS's layers (layers, 3, h, w): 1 where the fused beauty has as much light."""
    # The pixel filter of the LRHS is wider, so small lights and highlights lose light to the pixels around them.
    lights = (layers.sum(axis=(0, 1), dtype=np.float64), band.low_beauty.sum(axis=0, dtype=np.float64))
    rendered, fused = (np.log(light + 3 * band.sources.dark) for light in lights)
    return np.exp(-np.square((rendered - fused) / LIGHT_SPREAD)).astype(np.float32)


def _store(lights: Mapping[AdditiveLayer, Array], band: Band, window: Window, pixels: ReplacedChannels) -> int:
    """Store layers over an HRLS of this data window. Return how many values were too bright."""
    inside, clipped = band.hrls_core.intersect(window), 0
    for layer, light in lights.items():
        if layer.factor in band.colours:
            light = np.divide(light, np.maximum(band.colours[layer.factor], DARKEST_COLOUR), dtype=np.float32)
        for channel, plane in zip(layer.channels, light, strict=True):
            clipped += pixels.put(channel, inside.y0 - window.y0, plane[inside.slices(band.hrls_core)])
    return clipped
