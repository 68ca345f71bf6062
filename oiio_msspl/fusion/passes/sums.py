# SPDX-License-Identifier: Apache-2.0
"""Do layers sum to the beauty? Names only suggest it, so the pixels of the render decide."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.additive_sets import AdditiveLayer, AdditiveSet
from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.write_options import LOSSLESS
from oiio_msspl.fusion.passes.layers import LayerLight, layer_names, light_of
from oiio_msspl.image.arrays import HALF_MAX, Array
from oiio_msspl.image.parallel import one_ahead

#: Largest part of the beauty's light that may be wrong in a sum: what half floats round, and a few repaired pixels.
TOLERANCE = 2e-3
#: A sum is compared on so many strips of rows, evenly spaced: a quarter of a 1080p frame, in the blocks of most files.
STRIPS, ROWS = 17, 16
#: Largest residual that lossy compression explains.
LOSSY = 0.05
#: A layer has no noise if this share of its lit pixels equals a pixel beside it, within this share of their light.
NOISE_FREE, EQUAL = 2 / 3, 0.01
#: A layer with fewer lit pixels is not judged.
FEWEST = 64


@dataclass(frozen=True)
class SumCheck:
    """What :func:`check_sum` says of a set."""

    residual: float
    """Sum of |beauty - layers| divided by the sum of |beauty|."""
    remainder: bool = False
    """The layers lack some of the light, such as lights in no group. The rest is nowhere negative."""
    problem: str = ""
    """Why the layers do not sum to the beauty, or can't be fused though they do; empty if they can."""
    negative: bool = False
    """They sum to it, but a layer takes light away."""
    noise_free: frozenset[AdditiveLayer] = frozenset()
    """Layers without noise except at edges: they show a lamp or the sky directly."""

    @property
    def text(self) -> str:
        """The result in words."""
        if self.negative:
            return f"can't be fused: {self.problem}"
        if self.problem:
            return f"does not sum to the beauty: {self.problem}"
        if self.remainder:
            return f"sums to the beauty but for {self.residual:.1%} of its light, which is in no layer"
        return f"sums to the beauty (residual {self.residual:.2g})"


def check_sum(render: MappedRender, additive_set: AdditiveSet) -> SumCheck:
    """Compare the sum of a set's layers with the beauty of the same file, on some strips of rows.

    Raises:
        InputError: pixels can't be decoded.
    """
    return check_light(light_of(render, layer_names([additive_set])), additive_set)


def check_light(light: LayerLight, additive_set: AdditiveSet, total: AdditiveLayer | None = None) -> SumCheck:
    """Compare the sum of a set's layers with the beauty, or with another layer, on some strips of rows.

    Args:
        total: what they should sum to; None for the beauty. Then the check also says which layers are too many.
    """
    layers = additive_set.layers
    parts, window = light.file.file.parts, light.file.data_window
    for layer in layers if total is None else (*layers, total):
        if any(parts[channel.part].data_window != window for channel in layer.channels):
            return SumCheck(1.0, problem=f"{layer.name} has another data window")
    sums, of_layers = np.zeros(4), np.zeros((len(layers), 5))
    for pixels, sought, rest, usable in _strips_of(light, layers, total):
        lacking = rest[usable]
        sums += [np.abs(x).sum() for x in (sought[usable], lacking, np.maximum(lacking, 0), np.minimum(lacking, 0))]
        of_layers += [_layer_sums(layer, usable) for layer in pixels]
    light.pixels.unload()
    whole, wrong, missing, surplus = sums.tolist()
    negative, positive, equal, lit, finite = of_layers.T
    if not finite.all():
        return SumCheck(1.0, problem=f"the layer {layers[int(finite.argmin())].name} is NaN or infinite")
    if whole == 0:
        return SumCheck(0.0, problem="the beauty is black")
    residual = wrong / whole
    # Pixel filters with negative lobes make some values negative. Light that is taken away is another matter: a fused
    # layer is nowhere negative.
    taken = np.where(negative > positive, negative, 0)
    if taken.max(initial=0) > TOLERANCE * whole:
        return SumCheck(residual, problem=f"the layer {layers[int(taken.argmax())].name} is negative", negative=True)
    clean = (lit >= FEWEST) & (equal >= NOISE_FREE * lit)
    if residual <= TOLERANCE or surplus / whole <= TOLERANCE:
        noise_free = frozenset(layer for layer, is_clean in zip(layers, clean, strict=True) if is_clean)
        return SumCheck(residual, remainder=residual > TOLERANCE, noise_free=noise_free)
    if abs(missing - surplus) < wrong / 4:
        reason = "is the beauty denoised, or made with another pixel filter?"
        lossy = _lossy_compression(light.file, layers)
        if lossy and residual < LOSSY:
            reason = f"the compression {lossy} is lossy, so store them with zip or piz"
        return SumCheck(residual, problem=f"they differ by {residual:.1%} both ways; {reason}")
    superfluous = _superfluous(light, layers) if total is None else []
    advice = f"without {' and '.join(superfluous)} they would sum to it" if superfluous else "some layers overlap"
    return SumCheck(residual, problem=f"they have {surplus / whole:.1%} more light; {advice}")


def _layer_sums(pixels: Array, usable: NDArray[np.bool_]) -> list[float]:
    """Return a layer's negative and positive light, lit pixels like one beside them, all lit ones, if one is finite."""
    negative, positive = (np.maximum(sign * pixels[usable], 0).sum(dtype=np.float64) for sign in (-1, 1))
    red, green, blue = np.moveaxis(pixels, -1, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        light = red + green + blue
        lit = light > 0
        equal = np.zeros_like(lit)
        for values, result in ((light, equal), (light.T, equal.T)):
            same = np.abs(values[1:] - values[:-1]) <= np.float32(EQUAL / 2) * (values[1:] + values[:-1])
            result[1:] |= same
            result[:-1] |= same
    return [negative, positive, np.count_nonzero(equal & lit), np.count_nonzero(lit), np.isfinite(pixels).any()]


def _superfluous(light: LayerLight, layers: Sequence[AdditiveLayer]) -> list[str]:
    """Return names of layers without which the others sum to the beauty: one, all that are sums by name, or none."""
    choices = [[i] for i in range(len(layers))]
    choices.append([i for i, layer in enumerate(layers) if any(layer.words < finer.words for finer in layers)])
    total, wrong = 0.0, np.zeros(len(choices))
    for pixels, sought, rest, usable in _strips_of(light, layers):
        total += np.abs(sought[usable]).sum()
        wrong += [np.abs(rest[usable] + sum(pixels[i][usable] for i in choice)).sum() for choice in choices]
    best = int(wrong.argmin())
    return [layers[i].name for i in choices[best]] if wrong[best] <= TOLERANCE * total else []


def _lossy_compression(render: MappedRender, layers: Sequence[AdditiveLayer]) -> str:
    """Return the compression with which the beauty or a layer has lost precision; empty if none has."""
    channels = [*render.beauty_channels, *(channel for layer in layers for channel in layer.channels)]
    used = ((render.file.parts[channel.part].compression, channel.type) for channel in channels)
    # PXR24 keeps all bits of half floats.
    return min((name for name, kind in used if name not in LOSSLESS and (name, kind) != ("pxr24", "half")), default="")


def _strips_of(
    light: LayerLight, layers: Sequence[AdditiveLayer], total: AdditiveLayer | None = None
) -> Iterator[tuple[list[Array], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]]:
    """Yield rows of a set, (h, w, 3): its layers, what they should sum to, what they lack of it, and usable values."""
    window, names = light.file.data_window, [light.names[layer] for layer in layers]
    whole = RGB if total is None else light.names[total]
    channels: Sequence[Channel] = light.file.beauty_channels if total is None else total.channels
    # Where a beauty of half floats is clipped, its layers have more light.
    brightest = HALF_MAX if channels[0].type == "half" else np.inf
    strips = list(window.bands(ROWS))
    if window.height > STRIPS * ROWS:
        last = (window.height - ROWS) // ROWS
        strips = [strips[round(i * last / (STRIPS - 1))] for i in range(STRIPS)]
    for features in one_ahead(light.pixels.read(strip, [whole, *names]) for strip in strips):
        sought, pixels = features[whole].astype(np.float64), [features[name] for name in names]
        with np.errstate(invalid="ignore", over="ignore"):
            rest = sought - sum(pixels)
        yield pixels, sought, rest, np.isfinite(rest) & (sought < brightest)
