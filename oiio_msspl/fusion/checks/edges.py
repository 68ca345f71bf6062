# SPDX-License-Identifier: Apache-2.0
"""Checks that albedo and normals belong to the picture: their edges then lie where the picture has edges.

The strength of an AOV's edges in the picture is unknown: a dark corner hides them, and a mirror shows others. So the
AOV is its own control. Its edges, shifted by some pixels, say how well edges fit by chance. Without a shift they must
fit better than that, and no shift may fit clearly better.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.fusion.checks.framing import SMALLEST, central_area
from oiio_msspl.image.arrays import Array, quantile
from oiio_msspl.image.filters import blurred

#: Smallest and largest shift of the control, in LRHS pixels. With smaller shifts, edges still overlap.
CONTROL = (4, 16)
#: Edges belong together if they fit by this many standard deviations better than the control. The albedo is compared in
#: two ways, and the better one counts, so chance reaches further.
FITS = {ALBEDO: 3.5, NORMAL: 1.5}
#: AOVs that fit each other this well are of one frame. If normals fit the picture this well, it shows surfaces.
SAME_FRAME = 4.0
#: Both renders show the same edges if these fit this well. Otherwise normals can't be judged.
VISIBLE = 3.0
#: An AOV is shifted if its edges fit this well with a shift, and this much better than without.
SHIFTED, BY = 6.0, 3.0
#: A pattern is the same in two pictures if its correlations with both, by shift, correlate this much. Boards, tiles and
#: blinds reach 0.99, albedos and normals of other scenes 0.36.
SAME_PATTERN = 0.6
#: An AOV with edges at fewer pixels is not judged.
MIN_EDGES = 200
#: Normals are noise if, at this fraction of their edges, noise makes up this fraction of the difference: under motion
#: blur, each sample shows another moment. Without motion blur, renders at 1 spp of six scenes reach 0.45 in the one
#: that is all fine grooves, and 0.14 in the others.
NOISE = 0.5
#: A difference of log albedo, or the length of a difference of normals, counts as an edge from here.
EDGE = 0.2


@dataclass
class Aovs:
    """How the albedo and the normal fit the picture."""

    judged: list[str] = field(default_factory=list)
    """Those that could be judged."""
    foreign: list[str] = field(default_factory=list)
    """Those of another frame."""
    shifted: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Those that lie elsewhere than the picture, and how far to the right and down, in LRHS pixels."""


def judge_aovs(
    low: Array, high: Array, albedo: Array | None, normal_edges: Array | None, normal_noise: Array | None
) -> Aovs:
    """Check whether albedo and normal are of the frame that the picture shows.

    Args:
        low, high: luminance (h, w) of LRHS and HRLS.
        albedo, normal_edges, normal_noise: see :class:`oiio_msspl.fusion.checks.averages.HrlsAverages`.
    """
    low, high = central_area(low), central_area(high)
    if min(low.shape) < SMALLEST:
        return Aovs()
    lengths = {}
    if albedo is not None:
        surface = np.clip(albedo, 0, 1)
        lengths[ALBEDO] = np.minimum(_length(_log_differences(surface, 0.05)), 1)
    if normal_edges is not None:
        lengths[NORMAL] = np.minimum(normal_edges, 0.5)
    edges = {name: _Edges.of(v) for name, v in lengths.items() if np.count_nonzero(v > EDGE) >= MIN_EDGES}
    if not edges:
        return Aovs()
    total = low + high
    lit = total[total > 0]
    floor = 0.1 * quantile(lit, 0.5) if lit.size else 1.0
    differences = _log_differences(total, floor)
    picture = _Edges.of(np.minimum(_length(differences), 1))
    shifted = {name: shift for name, v in edges.items() if (shift := picture.shift_of(v)) is not None}
    fits = {name: v.fit(picture) for name, v in edges.items()}
    doubtful = [name for name, fit in fits.items() if fit < FITS[name] and name not in shifted]
    # Differences have a sign, too: a brighter albedo is brighter in the picture. A light may turn that around.
    if ALBEDO in doubtful and abs(_fit_signed(_log_differences(surface, 0.05), differences)) >= FITS[ALBEDO]:
        doubtful.remove(ALBEDO)
    doubtful = [name for name in doubtful if not edges[name].repeat_in(picture)]
    foreign = _foreign(doubtful, edges, fits, [_log_differences(v, floor / 2) for v in (low, high)])
    if NORMAL in foreign and normal_edges is not None and normal_noise is not None:
        # Normals that are noise can't be judged. That does not change how the albedo is judged.
        foreign = [name for name in foreign if name != NORMAL or not _are_noise(normal_edges, normal_noise)]
    return Aovs([name for name in edges if name not in doubtful or name in foreign], foreign, shifted)


def _foreign(
    doubtful: list[str], edges: dict[str, _Edges], fits: dict[str, float], renders: list[list[Array]]
) -> list[str]:
    """Return those of the doubtful AOVs that should fit the picture. ``renders``: differences of both renders."""
    if not doubtful:
        return []
    # If shapes are seen, so are colours. Even light shows colours without shapes.
    if doubtful != [ALBEDO] or fits.get(NORMAL, 0) < SAME_FRAME:
        first, second = (_Edges.of(np.minimum(_length(differences), 1)) for differences in renders)
        if first.fit(second) < VISIBLE:
            return []
    if len(edges) == 2 and len(doubtful) == 1 and edges[ALBEDO].fit(edges[NORMAL]) > SAME_FRAME:
        return []  # one AOV fits the picture, and the second one fits the first
    return [*doubtful]


def _are_noise(edges: Array, noise: Array) -> bool:
    """Return whether most edges (h, w) come from noise."""
    noisy = blurred(np.square(noise), 4) > NOISE * blurred(np.square(edges), 4)
    return bool(np.mean(noisy[edges > EDGE]) > NOISE)


def _log_differences(values: Array, floor: float) -> list[Array]:
    """Return differences of the logarithm to the next pixel, to the right and down: 2 x (h, w)."""
    logs = np.log(values + np.float32(floor + 1e-20))
    return [np.diff(logs, axis=axis, append=logs.take([-1], axis)) for axis in (1, 0)]


def _length(differences: list[Array]) -> Array:
    length: Array = np.sqrt(np.square(differences[0]) + np.square(differences[1]))  # a fraction of the time of np.hypot
    return length


@dataclass(frozen=True)
class _Edges:
    """The edges of a picture (h, w)."""

    spectrum: NDArray[np.complexfloating]
    shape: tuple[int, ...]

    @classmethod
    def of(cls, values: Array) -> _Edges:
        """Keep values that differ from their neighbourhood, in units of its RMS, so that no bright corner dominates."""
        fine = values - blurred(values, 4)
        power = blurred(np.square(fine), 12)
        contrast = fine / np.sqrt(power + np.float32(1e-3 * float(np.mean(np.square(fine))) + 1e-20))
        return cls(np.fft.rfft2(contrast), values.shape)

    def fit(self, picture: _Edges) -> float:
        """Return by how many standard deviations two pictures fit better than with a shift."""
        return _above_control(np.conj(self.spectrum) * picture.spectrum, self.shape)

    def shift_of(self, aov: _Edges) -> tuple[int, int] | None:
        """Return the shift (x, y) with which an AOV's edges fit these clearly better, or None."""
        window = _correlation(np.conj(self.spectrum) * aov.spectrum, self.shape)
        fits = (window - _control(window).mean()) / max(float(_control(window).std()), 1e-30)
        row, column = np.unravel_index(fits.argmax(), fits.shape)
        furthest = CONTROL[1]
        if fits.max() < SHIFTED or fits.max() - fits[furthest, furthest] < BY:
            return None
        return int(column) - furthest, int(row) - furthest

    def repeat_in(self, picture: _Edges) -> bool:
        """Return whether ``picture`` has a pattern of these edges that repeats, as boards or tiles do.

        Shifted by a period, the pattern fits as well. But if both pictures have it, their correlation depends on the
        shift as the correlation of the pattern with itself.
        """
        auto, cross = (
            _correlation(np.conj(self.spectrum) * edges.spectrum, self.shape).ravel() for edges in (self, picture)
        )
        auto, cross = auto - auto.mean(), cross - cross.mean()
        # Written so that a picture without edges, whose correlations are all 0, does not match.
        return bool(auto @ cross > SAME_PATTERN * np.linalg.norm(auto) * np.linalg.norm(cross))


def _fit_signed(a: list[Array], b: list[Array]) -> float:
    """Return how well signed differences of two pictures fit, in the units of :meth:`_Edges.fit`."""
    first, second = ([np.fft.rfft2(np.clip(values, -1, 1)) for values in differences] for differences in (a, b))
    products = [np.conj(u) * v for u, v in zip(first, second, strict=True)]
    return _above_control(products[0] + products[1], a[0].shape)


def _correlation(spectrum: NDArray[np.complexfloating], shape: tuple[int, ...]) -> Array:
    """Return the correlation of two pictures for shifts up to the furthest of ``CONTROL``, no shift in the middle."""
    furthest = CONTROL[1]
    correlation: Array = np.roll(np.fft.irfft2(spectrum, shape), (furthest, furthest), (0, 1))
    return correlation[: 2 * furthest + 1, : 2 * furthest + 1]


def _control(window: Array) -> Array:
    """Return the correlations at the shifts of the control."""
    furthest = CONTROL[1]
    y, x = np.abs(np.mgrid[-furthest : furthest + 1, -furthest : furthest + 1])
    control: Array = window[np.maximum(x, y) >= CONTROL[0]]
    return control


def _above_control(spectrum: NDArray[np.complexfloating], shape: tuple[int, ...]) -> float:
    window = _correlation(spectrum, shape)
    control = _control(window)
    return float((window[CONTROL[1], CONTROL[1]] - control.mean()) / max(float(control.std()), 1e-30))
