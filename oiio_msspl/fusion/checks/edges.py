# SPDX-License-Identifier: Apache-2.0
"""Do albedo and normals belong to the picture? Then their edges lie where the picture has edges.

Nothing is known of how strong an AOV's edges are in the picture: a dark corner hides them, a mirror shows others. So
the AOV is its own control. Its edges, shifted by some pixels, say how well edges fit by chance, and the AOV that is not
shifted must fit better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.fusion.checks.framing import SMALLEST, central_area
from oiio_msspl.image.arrays import Array, quantile
from oiio_msspl.image.filters import blurred

#: Shifts in LRHS pixels that the control consists of; smaller ones than the first still overlap the edges.
CONTROL = (4, 16)
#: How many standard deviations above the control edges fit that belong together. The albedo is compared in two ways, of
#: which the better counts, so chance reaches further.
FITS = {ALBEDO: 3.5, NORMAL: 1.5}
#: AOVs that fit each other this well are of one frame. Where normals fit the picture this well, it shows surfaces.
SAME_FRAME = 4.0
#: Both renders show the same edges if these fit this well. In a picture with fewer edges, normals can't be judged.
VISIBLE = 3.0
#: A pattern is the same in two pictures if its correlations with both, by shift, correlate this much. Boards, tiles and
#: blinds reach 0.99, albedos and normals of other scenes 0.36.
SAME_PATTERN = 0.6
#: An AOV with edges at fewer pixels says nothing.
MIN_EDGES = 200
#: Normals are noise if, at this share of their edges, noise makes up this share of what the normals differ by: under
#: motion blur, each sample shows another moment. Renders at 1 spp without it reach 0.45, those of one scene in six that
#: is all fine grooves; others reach 0.14.
NOISE = 0.5
#: A step of log albedo, or the length of a difference of normals, counts as an edge from here.
EDGE = 0.2


def foreign_aovs(
    low: Array, high: Array, albedo: Array | None, normal_edges: Array | None, normal_noise: Array | None
) -> list[str]:
    """The AOVs, of "albedo" and "normal", that are of another frame than the picture.

    Args:
        low, high: luminance (h, w) of LRHS and HRLS.
        albedo: luminance of the albedo, averaged over LRHS pixels, over the central area; None if there is none.
        normal_edges: length of the difference of the normals to the next pixels, over the same area; None if there are
            none.
        normal_noise: how long it would be by the noise of the normals alone.
    """
    low, high = central_area(low), central_area(high)
    if min(low.shape) < SMALLEST:
        return []
    found = {}
    if albedo is not None:
        surface = np.clip(albedo, 0, 1)
        found[ALBEDO] = np.minimum(_length(_log_steps(surface, 0.05)), 1)
    if normal_edges is not None:
        found[NORMAL] = np.minimum(normal_edges, 0.5)
    edges = {name: _Edges.of(v) for name, v in found.items() if np.count_nonzero(v > EDGE) >= MIN_EDGES}
    if not edges:
        return []
    both = low + high
    lit = both[both > 0]
    floor = 0.1 * quantile(lit, 0.5) if lit.size else 1.0
    steps = _log_steps(both, floor)
    picture = _Edges.of(np.minimum(_length(steps), 1))
    fits = {name: v.fit(picture) for name, v in edges.items()}
    foreign = [name for name, fit in fits.items() if fit < FITS[name]]
    # Steps have a direction, too: what has the brighter albedo is brighter. A light may turn that around.
    if ALBEDO in foreign and abs(_fit_steps(_log_steps(surface, 0.05), steps)) >= FITS[ALBEDO]:
        foreign.remove(ALBEDO)
    foreign = [name for name in foreign if not edges[name].repeat_in(picture)]
    if not foreign:
        return []
    # Where shapes are seen, so are colours. Even light shows colours without shapes.
    if foreign != [ALBEDO] or fits.get(NORMAL, 0) < SAME_FRAME:
        one, other = (_Edges.of(np.minimum(_length(_log_steps(v, floor / 2)), 1)) for v in (low, high))
        if one.fit(other) < VISIBLE:
            return []
    if len(edges) == 2 and len(foreign) == 1 and edges[ALBEDO].fit(edges[NORMAL]) > SAME_FRAME:
        return []  # one of the two fits the picture, and the other fits that one
    if NORMAL in foreign and normal_edges is not None and normal_noise is not None:
        # Noise says nothing of what the normals are of, and the albedo is judged as it would be beside any normals.
        return [name for name in foreign if name != NORMAL or not _are_noise(normal_edges, normal_noise)]
    return foreign


def _are_noise(edges: Array, noise: Array) -> bool:
    """Whether most edges (h, w) are by noise."""
    strong = edges > EDGE
    noisy = blurred(np.square(noise), 4) > NOISE * blurred(np.square(edges), 4)
    return bool(np.count_nonzero(strong & noisy) > NOISE * np.count_nonzero(strong))


def _log_steps(values: Array, floor: float) -> list[Array]:
    """Differences of the logarithm to the next pixel, to the right and down: 2 x (h, w)."""
    logs = np.log(values + np.float32(floor + 1e-20))
    return [np.diff(logs, axis=axis, append=logs.take([-1], axis)) for axis in (1, 0)]


def _length(steps: list[Array]) -> Array:
    length: Array = np.sqrt(np.square(steps[0]) + np.square(steps[1]))  # a fraction of the time of np.hypot
    return length


@dataclass(frozen=True)
class _Edges:
    """The edges of a picture (h, w)."""

    spectrum: NDArray[np.complexfloating]
    shape: tuple[int, ...]

    @classmethod
    def of(cls, values: Array) -> _Edges:
        """What stands out of its neighbourhood, in units of its local RMS: a noisy or bright corner does not
        dominate."""
        fine = values - blurred(values, 4)
        power = blurred(np.square(fine), 12)
        contrast = fine / np.sqrt(power + np.float32(1e-3 * float(np.mean(np.square(fine))) + 1e-20))
        return cls(np.fft.rfft2(contrast), values.shape)

    def fit(self, other: _Edges) -> float:
        """By how many standard deviations two pictures fit better than when one is shifted."""
        return _above_control(np.conj(self.spectrum) * other.spectrum, self.shape)

    def repeat_in(self, other: _Edges) -> bool:
        """Whether another picture has a pattern of these edges that repeats, as boards or tiles do.

        Shifted by a period, the pattern fits as well. But if it is in both pictures, the fit depends on the shift as
        that of the pattern with itself.
        """
        own, both = (_correlation(np.conj(self.spectrum) * each.spectrum, self.shape).ravel() for each in (self, other))
        own, both = own - own.mean(), both - both.mean()
        # Written so that a picture without edges, whose correlations are all 0, does not match.
        return bool(own @ both > SAME_PATTERN * np.linalg.norm(own) * np.linalg.norm(both))


def _fit_steps(a: list[Array], b: list[Array]) -> float:
    """The same as :meth:`_Edges.fit` for the directed steps of two pictures."""
    first, second = ([np.fft.rfft2(np.clip(step, -1, 1)) for step in steps] for steps in (a, b))
    products = [np.conj(u) * v for u, v in zip(first, second, strict=True)]
    return _above_control(products[0] + products[1], a[0].shape)


def _correlation(spectrum: NDArray[np.complexfloating], shape: tuple[int, ...]) -> Array:
    """The correlation of two pictures for all shifts up to the furthest of ``CONTROL``, no shift in the middle."""
    furthest = CONTROL[1]
    correlation: Array = np.roll(np.fft.irfft2(spectrum, shape), (furthest, furthest), (0, 1))
    return correlation[: 2 * furthest + 1, : 2 * furthest + 1]


def _above_control(spectrum: NDArray[np.complexfloating], shape: tuple[int, ...]) -> float:
    nearest, furthest = CONTROL
    window = _correlation(spectrum, shape)
    y, x = np.abs(np.mgrid[-furthest : furthest + 1, -furthest : furthest + 1])
    control = window[np.maximum(x, y) >= nearest]
    return float((window[furthest, furthest] - control.mean()) / max(float(control.std()), 1e-30))
