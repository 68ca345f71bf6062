# SPDX-License-Identifier: Apache-2.0
"""Do layers sum to the beauty? Names only suggest it, so the pixels of the render decide."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.additive_sets import AdditiveLayer, AdditiveSet
from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.render import Window
from oiio_msspl.exr.write_options import LOSSLESS
from oiio_msspl.image.arrays import HALF_MAX, Array
from oiio_msspl.image.parallel import one_ahead

#: Largest part of the beauty's light that may be wrong in a sum: what half floats round, and a few repaired pixels.
TOLERANCE = 2e-3
#: What a sum is compared on: so many strips of rows, evenly spaced. A quarter of a 1080p frame. Files are mostly
#: compressed in blocks of 16 rows, so each strip is one block.
STRIPS, ROWS = 17, 16
#: Largest residual that lossy compression explains.
LOSSY = 0.05
#: A layer has no noise if at least this share of its lit pixels equals a pixel beside it, within this share of their
#: light. Layers with noise have few such pixels.
NOISE_FREE, EQUAL = 2 / 3, 0.01
#: A layer with fewer lit pixels is not judged.
FEWEST = 64


@dataclass(frozen=True)
class SumCheck:
    """What :func:`check_sum` found."""

    residual: float
    """Sum of |beauty - layers| divided by the sum of |beauty|."""
    remainder: bool = False
    """The layers lack some of the light, such as lights in no group. The rest is nowhere negative."""
    problem: str = ""
    """Why the layers do not sum to the beauty, or can't be fused though they do; empty if they can."""
    negative: bool = False
    """They sum to it, but a layer takes light away."""
    noise_free: frozenset[AdditiveLayer] = frozenset()
    """Layers without noise, but for that of edges: they show a lamp or the sky directly."""

    @property
    def text(self) -> str:
        """In words."""
        if self.negative:
            return f"can't be fused: {self.problem}"
        if self.problem:
            return f"does not sum to the beauty: {self.problem}"
        if self.remainder:
            return f"sums to the beauty but for {self.residual:.1%} of its light, which is in no layer"
        return f"sums to the beauty (residual {self.residual:.2g})"


def check_sum(render: MappedRender, additive_set: AdditiveSet, *, advise: bool = True) -> SumCheck:
    """Compare the sum of a set's layers with the beauty of the same file, on some strips of rows.

    Args:
        advise: if the layers have more light, read them again to find out which are too many.

    Raises:
        InputError: pixels can't be decoded.
    """
    window = render.data_window
    other = [
        layer.name for layer in additive_set.layers for c in layer.channels if _window_of(render, c.part) != window
    ]
    if other:
        return SumCheck(1.0, problem=f"{other[0]} has another data window")
    light = wrong = missing = surplus = 0.0
    negative, positive = np.zeros((2, len(additive_set.layers)))
    finite = np.zeros(len(additive_set.layers), np.bool_)
    alike = np.zeros((len(additive_set.layers), 2), np.int64)
    for layers, beauty, rest, usable in _strips_of(render, additive_set):
        light, wrong = light + np.abs(beauty[usable]).sum(), wrong + np.abs(rest[usable]).sum()
        missing += np.maximum(rest[usable], 0).sum()
        surplus += np.maximum(-rest[usable], 0).sum()
        alike += [_equal_pixels(pixels) for pixels in layers]
        negative += [-np.minimum(pixels, 0)[usable].sum(dtype=np.float64) for pixels in layers]
        positive += [np.maximum(pixels, 0)[usable].sum(dtype=np.float64) for pixels in layers]
        if not finite.all():
            finite |= [bool(np.isfinite(pixels).any()) for pixels in layers]
    if not finite.all():
        broken = additive_set.layers[int(finite.argmin())].name
        return SumCheck(1.0, problem=f"the layer {broken} is NaN or infinite")
    if light == 0:
        return SumCheck(0.0, problem="the beauty is black")
    # Pixel filters with negative lobes make some values negative. Light that is taken away is another matter: a fused
    # layer is nowhere negative.
    taken = np.where(negative > positive, negative, 0)
    if taken.max(initial=0) > TOLERANCE * light:
        name = additive_set.layers[int(taken.argmax())].name
        return SumCheck(float(wrong / light), problem=f"the layer {name} is negative", negative=True)
    residual = float(wrong / light)
    noise_free = frozenset(
        layer
        for layer, (equal, lit) in zip(additive_set.layers, alike, strict=True)
        if lit >= FEWEST and equal >= NOISE_FREE * lit
    )
    if residual <= TOLERANCE:
        return SumCheck(residual, noise_free=noise_free)
    if surplus / light <= TOLERANCE:
        return SumCheck(residual, remainder=True, noise_free=noise_free)
    if abs(missing - surplus) < wrong / 4:
        reason = "is the beauty denoised, or made with another pixel filter?"
        lossy = _lossy_compression(render, additive_set)
        if lossy and residual < LOSSY:
            reason = f"the compression {lossy} is lossy, so store them with zip or piz"
        return SumCheck(residual, problem=f"they differ by {residual:.1%} both ways; {reason}")
    superfluous = _superfluous(render, additive_set) if advise else []
    advice = f"without {' and '.join(superfluous)} they would sum to it" if superfluous else "some layers overlap"
    return SumCheck(residual, problem=f"they have {surplus / light:.1%} more light; {advice}")


def _superfluous(render: MappedRender, additive_set: AdditiveSet) -> list[str]:
    """The names of what a set has too much of to sum to the beauty: one layer, or all that by their names are sums of
    others. Empty if the rest would not sum to it either.
    """
    all_layers = additive_set.layers
    choices = [[i] for i in range(len(all_layers))]
    choices.append([i for i, each in enumerate(all_layers) if any(each.words < other.words for other in all_layers)])
    light, wrong = 0.0, np.zeros(len(choices))
    for layers, beauty, rest, usable in _strips_of(render, additive_set):
        light += np.abs(beauty[usable]).sum()
        wrong += [np.abs(rest[usable] + sum(layers[i][usable] for i in left_out)).sum() for left_out in choices]
    best = int(wrong.argmin())
    return [all_layers[i].name for i in choices[best]] if wrong[best] <= TOLERANCE * light else []


def _lossy_compression(render: MappedRender, additive_set: AdditiveSet) -> str:
    """The compression with which the beauty or a layer has lost precision; empty if none has."""
    channels = [*render.beauty_channels, *(channel for layer in additive_set.layers for channel in layer.channels)]
    used = ((render.file.parts[channel.part].compression, channel.type) for channel in channels)
    # PXR24 keeps all bits of half floats.
    return min((name for name, kind in used if name not in LOSSLESS and (name, kind) != ("pxr24", "half")), default="")


def _strips_of(
    render: MappedRender, additive_set: AdditiveSet
) -> Iterator[tuple[list[Array], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]]:
    """For strips of rows from top to bottom: the layers, the beauty, what the layers lack of it, and which of its
    values can be compared, (h, w, 3) each."""
    window, layers, keys = render.data_window, with_layers(render, additive_set), layer_keys(additive_set)
    # Where a beauty of half floats is clipped, its layers have more light.
    brightest = HALF_MAX if render.beauty_channels[0].type == "half" else np.inf
    strips = (Window(window.x0, y, window.x1, min(y + ROWS, window.y1)) for y in _strips(window))
    for features in one_ahead(layers.read(strip, [RGB, *keys]) for strip in strips):
        beauty, pixels = features[RGB].astype(np.float64), [features[key] for key in keys]
        with np.errstate(invalid="ignore", over="ignore"):
            rest = beauty - sum(pixels)
        yield pixels, beauty, rest, np.isfinite(rest) & (beauty < brightest)


def _equal_pixels(pixels: Array) -> tuple[int, int]:
    """How many lit pixels of a layer (h, w, 3) equal one of the four next to them, and how many are lit."""
    red, green, blue = np.moveaxis(pixels, -1, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        light = red + green + blue
    lit = light > 0
    equal = np.zeros_like(lit)
    for here, found in ((light, equal), (light.T, equal.T)):
        with np.errstate(invalid="ignore", over="ignore"):
            same = np.abs(here[1:] - here[:-1]) <= np.float32(EQUAL / 2) * (here[1:] + here[:-1])
        found[1:] |= same
        found[:-1] |= same
    return int(np.count_nonzero(equal & lit)), int(np.count_nonzero(lit))


def is_sum_of(render: MappedRender, layer: AdditiveLayer, parts: Sequence[AdditiveLayer]) -> bool:
    """Whether a layer is the sum of others of the same file, on some strips of rows. A layer with another data window
    than the beauty's is none.

    Raises:
        InputError: pixels can't be decoded.
    """
    if any(_window_of(render, channel.part) != render.data_window for channel in layer.channels):
        return False
    whole = replace(render, features={RGB: layer.formula}, alpha=None)
    check = check_sum(whole, AdditiveSet(layer.name, tuple(parts)), advise=False)
    return not check.problem and not check.remainder


def with_layers(render: MappedRender, additive_set: AdditiveSet) -> MappedRender:
    """The render with the light of each layer as a feature beside the beauty, see :func:`layer_keys`."""
    formulas = dict(zip(layer_keys(additive_set), (layer.formula for layer in additive_set.layers), strict=True))
    return replace(render, features={RGB: render.features[RGB], **formulas}, alpha=None)


def layer_keys(additive_set: AdditiveSet) -> list[str]:
    """Names of the layers' features."""
    return [f"layer {i}" for i in range(len(additive_set.layers))]


def _strips(window: Window) -> list[int]:
    """First rows of the strips that are compared."""
    if window.height <= STRIPS * ROWS:
        return list(range(window.y0, window.y1, ROWS))
    last = (window.height - ROWS) // ROWS
    return [window.y0 + round(i * last / (STRIPS - 1)) * ROWS for i in range(STRIPS)]


def _window_of(render: MappedRender, part: int) -> Window:
    return render.file.parts[part].data_window
