# SPDX-License-Identifier: Apache-2.0
"""Checks that albedo and normals belong to the picture: their edges then lie where the picture has edges.

A dark corner hides edges, and a mirror shows others, so the AOV is its own control: shifted by some pixels, its edges
fit by chance. Without a shift they must fit better than that, and no shift may fit clearly better.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.fusion.checks.averages import NOISE, HrlsAverages
from oiio_msspl.fusion.checks.framing import SMALLEST, central_area
from oiio_msspl.fusion.checks.likeness import CONTROL, by_shift, fine_structure
from oiio_msspl.image.arrays import Array, quantile
from oiio_msspl.image.filters import blurred

#: Edges belong together if they fit by this many standard deviations better than the control: the albedo by more,
#: because it is compared in two ways, and the better one counts.
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
#: blur, each sample shows another moment. Without it, renders at 1 spp reach 0.45 in a scene full of fine grooves.
MOSTLY_NOISE = 0.5
#: A difference of log albedo, or the length of a difference of normals, counts as an edge from here.
EDGE = 0.2
#: Where no shift lies among all, see :func:`oiio_msspl.fusion.checks.likeness.by_shift`.
IN_PLACE = (CONTROL[1], CONTROL[1])


@dataclass
class Aovs:
    """How the albedo and the normal fit the picture."""

    judged: list[str] = field(default_factory=list)
    """Those that could be judged."""
    foreign: list[str] = field(default_factory=list)
    """Those of another frame."""
    shifted: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Those that lie elsewhere than the picture, and how far to the right and down, in LRHS pixels."""


def judge_aovs(low: Array, hrls: HrlsAverages) -> Aovs:
    """Check whether albedo and normal are of the frame that the picture shows, given the LRHS's luminance (h, w)."""
    low, high = central_area(low), central_area(hrls.rgb)
    if min(low.shape) < SMALLEST:
        return Aovs()
    lengths = {}
    if ALBEDO in hrls.aovs:
        of_albedo = _log_differences(np.clip(hrls.aovs[ALBEDO], 0, 1), 0.05)
        lengths[ALBEDO] = _length(of_albedo)
    if NORMAL in hrls.aovs:
        lengths[NORMAL] = np.minimum(hrls.aovs[NORMAL], 0.5)
    edges = {name: _Edges(v) for name, v in lengths.items() if np.count_nonzero(v > EDGE) >= MIN_EDGES}
    if not edges:
        return Aovs()
    total = low + high
    lit = total[total > 0]
    floor = 0.1 * quantile(lit, 0.5) if lit.size else 1.0
    differences = _log_differences(total, floor)
    picture = _Edges(_length(differences))
    shifted = {name: shift for name, v in edges.items() if (shift := picture.shift_of(v)) is not None}
    fits = {name: v.fit(picture) for name, v in edges.items()}
    doubtful = [name for name, fit in fits.items() if fit < FITS[name] and name not in shifted]
    # Differences have a sign, too: a brighter albedo is brighter in the picture. A light may turn that around.
    if ALBEDO in doubtful and abs(_fit_signed(of_albedo, differences)) >= FITS[ALBEDO]:
        doubtful.remove(ALBEDO)
    doubtful = [name for name in doubtful if not edges[name].repeat_in(picture)]
    foreign = _foreign(doubtful, edges, fits, [_log_differences(v, floor / 2) for v in (low, high)])
    if NORMAL in foreign and _are_noise(hrls.aovs[NORMAL], hrls.aovs[NOISE]):
        foreign.remove(NORMAL)  # normals that are noise can't be judged; that does not change how the albedo is judged
    return Aovs([name for name in edges if name not in doubtful or name in foreign], foreign, shifted)


def _foreign(
    doubtful: list[str], edges: dict[str, _Edges], fits: dict[str, float], renders: list[list[Array]]
) -> list[str]:
    """Return those of the doubtful AOVs that should fit the picture. ``renders``: differences of both renders."""
    if not doubtful:
        return []
    # If shapes are seen, so are colours. Even light shows colours without shapes.
    if doubtful != [ALBEDO] or fits.get(NORMAL, 0) < SAME_FRAME:
        first, second = (_Edges(_length(differences)) for differences in renders)
        if first.fit(second) < VISIBLE:
            return []
    if len(edges) == 2 and len(doubtful) == 1 and edges[ALBEDO].fit(edges[NORMAL]) > SAME_FRAME:
        return []  # one AOV fits the picture, and the second one fits the first
    return [*doubtful]


def _are_noise(edges: Array, noise: Array) -> bool:
    """Return whether most edges (h, w) come from noise."""
    noisy = blurred(np.square(noise), 4) > MOSTLY_NOISE * blurred(np.square(edges), 4)
    return bool(np.mean(noisy[edges > EDGE]) > MOSTLY_NOISE)


def _log_differences(values: Array, floor: float) -> list[Array]:
    """Return differences of the logarithm to the next pixel, to the right and down: 2 x (h, w)."""
    logs = np.log(values + np.float32(floor + 1e-20))
    return [np.diff(logs, axis=axis, append=logs.take([-1], axis)) for axis in (1, 0)]


def _length(differences: list[Array]) -> Array:
    """Return the length (h, w) of differences, at most 1."""
    # This takes a fraction of the time of np.hypot.
    return np.minimum(np.sqrt(np.square(differences[0]) + np.square(differences[1])), 1)


class _Edges:
    """The edges of a picture (h, w)."""

    def __init__(self, values: Array) -> None:
        self.spectrum, self.shape = np.fft.rfft2(fine_structure(values)), values.shape

    def fit(self, picture: _Edges) -> float:
        """Return by how many standard deviations two pictures fit better than with a shift."""
        return float(_above_control(np.conj(self.spectrum) * picture.spectrum, self.shape)[IN_PLACE])

    def shift_of(self, aov: _Edges) -> tuple[int, int] | None:
        """Return the shift (x, y) with which an AOV's edges fit these clearly better, or None."""
        fits = _above_control(np.conj(self.spectrum) * aov.spectrum, self.shape)
        row, column = np.unravel_index(fits.argmax(), fits.shape)
        if fits.max() < SHIFTED or fits.max() - fits[IN_PLACE] < BY:
            return None
        return int(column) - IN_PLACE[1], int(row) - IN_PLACE[0]

    def repeat_in(self, picture: _Edges) -> bool:
        """Return whether a picture has a pattern of these edges, such as boards: both then correlate alike by shift."""
        auto, cross = (
            by_shift(np.conj(self.spectrum) * edges.spectrum, self.shape)[0].ravel() for edges in (self, picture)
        )
        auto, cross = auto - auto.mean(), cross - cross.mean()
        # Written so that a picture without edges, whose correlations are all 0, does not match.
        return bool(auto @ cross > SAME_PATTERN * np.linalg.norm(auto) * np.linalg.norm(cross))


def _fit_signed(a: list[Array], b: list[Array]) -> float:
    """Return how well signed differences of two pictures fit, in the units of :meth:`_Edges.fit`."""
    first, second = ([np.fft.rfft2(np.clip(values, -1, 1)) for values in differences] for differences in (a, b))
    products = [np.conj(u) * v for u, v in zip(first, second, strict=True)]
    return float(_above_control(products[0] + products[1], a[0].shape)[IN_PLACE])


def _above_control(spectrum: NDArray[np.complexfloating], shape: tuple[int, ...]) -> Array:
    """Return by how many standard deviations two pictures fit better than the control, for each shift."""
    window, control = by_shift(spectrum, shape)
    return np.asarray((window - control.mean()) / max(float(control.std()), 1e-30))
