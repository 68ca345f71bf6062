# SPDX-License-Identifier: Apache-2.0
"""Finds out how motion vectors are stored, by two frames of the shot, because manuals leave it open.

Every format that renderers are known to write is tried: it fetches albedo, normals and positions of the other frame.
The right format is the one that finds those of this frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from oiio_msspl.aovs.motion import CHOICES, MotionField, MotionFormat
from oiio_msspl.fusion.motion.guides import POSITION, Guide, TwoFrames
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.sampling import sample_linear

#: The best format must fit this many times as well as no motion, and as the runner-up.
MARGIN = 1.5
#: Differences that are smaller than this share of those without motion are equally small.
FLOOR = 1e-3
#: Or a vote of the pixels must be this many standard deviations from a tie.
SURE = 4.0
#: Pixels that are compared, for each guide.
SAMPLES = 4096
#: A verdict needs this many of them.
FEWEST = 64
#: Two formats are different if they say different places for a pixel, in pixels.
DIFFERENT = 0.25
#: Scales of vectors that are known to occur; 2 is a shutter of 180 degrees.
VECTOR_SCALES = (1.0, 2.0, 0.5)
#: Where none of these fits, any scale is tried, because a shutter may have any length. One of that many formats may fit
#: by chance, so the best one must fit ``MARGIN`` times better still, and must not be at either end of this range.
ANY_SCALES = tuple(2.0 ** (k / 8) for k in range(-40, 41))
#: The other units only repeat the scales of these two.
ANY_SCALES_OF = ("pixels", "ndc")
#: Scales of vectors that are encoded as colours, in pixels: the renderer's setting is not in the file.
ENCODED_SCALES = tuple(2.0 ** (k / 2) for k in range(2, 23))


@dataclass(frozen=True)
class FieldCheck:
    """The verdict of two frames on one layer of motion vectors."""

    field: MotionField
    """With the format that was found, if one was."""
    problem: str = ""
    """Why the vectors can't be used; empty if they are verified."""
    zero: bool = False
    """The vectors are 0 everywhere."""
    fit: float = 1.0
    """The share of the differences between the frames that is left; without motion it is 1."""
    by_user: bool = False
    """The user has described them, and nothing verifies that."""
    silent: frozenset[str] = frozenset()
    """Axes, ``x`` or ``y``, along which hardly anything moves in these frames. So they do not tell the sign of the
    vectors, and the expected one is taken."""

    @property
    def text(self) -> str:
        """The verdict in words."""
        if self.problem:
            return f"{self.field.name}: {self.problem}"
        if self.by_user:
            return f"{self.field.name} ({self.field.format}), as --motion-format says, not verified"
        return f"{self.field.name} ({self.field.format}), which explains {1 - self.fit:.0%} of what changes"


def check_field(
    frames: TwoFrames, field: MotionField, stored: tuple[Array, Array], *, verified: bool = False
) -> FieldCheck:
    """Find the format of motion vectors.

    Args:
        frames: frames t and t+1.
        field: the layer, with the format that is expected. Words in ``fixed`` are not varied.
        stored: its pixels (h, w, 2) in both frames, over their window and reduced as the guides are.
        verified: other frames of the shot have shown the expected format. Only one that fits clearly better is taken
            instead.
    """
    offsets = [field.format.offset]
    if "offset" not in field.fixed:  # vectors that are encoded as colours lie between 0 and 1
        lowest, highest = (float(f([f(values) for values in stored])) for f in (np.min, np.max))
        offsets = [0.0, 0.5] if lowest >= 0 and 0.25 < highest <= 1 else [0.0]
    checks = [_check_offset(frames, field, stored, offset, verified) for offset in offsets]
    return min(checks, key=lambda check: (bool(check.problem), not check.zero, check.fit))


def _check_offset(
    frames: TwoFrames, field: MotionField, stored: tuple[Array, Array], offset: float, verified: bool
) -> FieldCheck:
    """Find the format of vectors whose offset is known."""
    field = replace(field, format=replace(field.format, offset=offset))
    if all(not _moving(values, offset).any() for values in stored):
        return FieldCheck(field, "is zero everywhere", zero=True)
    if not frames.guides:
        return FieldCheck(field, "there is no albedo, world-space normal or position to verify it by")
    trial = _Trial(frames, stored, offset)
    if not trial.places:
        return FieldCheck(field, "albedo, normal and position are too even to verify it by")
    fits = trial.fits(_formats(field, encoded=offset != 0))
    best = min(fits, key=lambda form: fits[form])
    needed = MARGIN
    if "scale" not in field.fixed:
        usual = set(fits)
        for form in (best, _mirrored(best)):
            if form in fits:
                scale = trial.fit_scale(form, fits[form])
                fits |= trial.fits(_formats(replace(field, format=form), encoded=False, scales=[scale]))
        best = min(fits, key=lambda form: fits[form])
        if offset == 0 and (best not in usual or fits[best] * MARGIN > 1):
            best, fits = _with_any_scale(trial, field, fits)
            needed = MARGIN if best in usual else MARGIN**2
    # Even movement fits equally well if the vectors are taken for those from the other frame: the table decides.
    mirrored = _mirrored(best)
    if mirrored.to == field.format.to and fits.get(mirrored, np.inf) < MARGIN * fits[best]:
        best = mirrored
    # Formats may differ in nothing that these frames show: a camera that moves sideways does not tell y.
    best = next(form for form in (field.format, best) if form == best or trial.is_same(form, best, fits))
    at_end = offset == 0 and "scale" not in field.fixed and not ANY_SCALES[0] < best.scale < ANY_SCALES[-1]
    if fits[best] * needed > 1 or at_end:
        names = ", ".join(guide.name for guide in frames.guides)
        left = f"at best {fits[best]:.0%} of the differences are left"
        return FieldCheck(field, f"no known format makes {names} of both frames agree ({left})", fit=fits[best])
    expected = replace(best, **{axis: getattr(field.format, axis) for axis in trial.silent(best)})
    fits[expected], best = fits[best], expected
    if verified and fits.get(field.format, np.inf) < MARGIN * max(fits[best], FLOOR):
        return FieldCheck(field, fit=fits[field.format], silent=trial.silent(field.format))
    limit = MARGIN**2 * max(fits[best], FLOOR)
    for rival in (form for form in fits if form.to == best.to and form != best and fits[form] < limit):
        if not trial.beats(best, rival):
            return FieldCheck(field, f"'{best}' and '{rival}' fit it equally well")
    return FieldCheck(replace(field, format=best), fit=fits[best], silent=trial.silent(best))


def _with_any_scale(
    trial: _Trial, field: MotionField, fits: dict[MotionFormat, float]
) -> tuple[MotionFormat, dict[MotionFormat, float]]:
    """Find the best format of any scale. Return it, and how well it and the formats of ``fits`` fit."""
    units = (field.format.unit,) if "unit" in field.fixed else ANY_SCALES_OF
    formats = (form for form in _formats(field, encoded=False, scales=ANY_SCALES) if form.unit in units)
    every = trial.fits(formats)
    for to, unit in itertools.product(CHOICES["to"], units):
        if forms := [form for form in every if (form.to, form.unit) == (to, unit)]:
            best = min(forms, key=lambda form: every[form])
            scale = trial.fit_scale(best, every[best], clearly=False)
            fits = fits | trial.fits(replace(form, scale=scale) for form in (best, _mirrored(best)) if form in every)
    best = min(fits, key=lambda form: fits[form])
    # Along one axis alone, units differ in nothing but their scales.
    same = (form for form in fits if form.unit == field.format.unit and trial.is_same(form, best, fits))
    return next(same, best), fits


def _moving(stored: Array, offset: float) -> Mask:
    """Return where vectors are not 0, (h, w)."""
    x, y = (np.abs(stored[..., i] - np.float32(offset)) > 1e-6 for i in (0, 1))
    return x | y


def _formats(field: MotionField, *, encoded: bool, scales: Iterable[float] = ()) -> Iterator[MotionFormat]:
    """Yield all formats that a layer may have; the expected one comes first."""
    expected, fixed = field.format, field.fixed
    yield expected
    words = [(getattr(expected, word),) if word in fixed else CHOICES[word] for word in ("to", "x", "y", "unit")]
    for to, x, y, unit in itertools.product(*words):
        known = scales or (ENCODED_SCALES if encoded and unit == "pixels" else VECTOR_SCALES)
        for scale in (expected.scale,) if "scale" in fixed else known:
            yield replace(expected, to=to, x=x, y=y, unit=unit, scale=scale)


def _mirrored(form: MotionFormat) -> MotionFormat:
    """Return the format with the opposite vectors to the opposite frame, which fits as well if all motion is even."""
    to, x, y = (CHOICES[word][1 - CHOICES[word].index(getattr(form, word))] for word in ("to", "x", "y"))
    return replace(form, to=to, x=x, y=y)


@dataclass(frozen=True)
class _Place:
    """Pixels of one frame where a guide is compared."""

    guide: Guide
    frame: int
    x: Array
    y: Array
    stored: Array  #: (n, 2)
    here: Array  #: (n, c): the guide in this frame.
    still: Array  #: (n): its difference to the other frame without motion.


class _Trial:
    """Compares the guides of two frames as formats bring them to each other."""

    def __init__(self, frames: TwoFrames, stored: tuple[Array, Array], offset: float) -> None:
        frame = frames.renders[0].display_window
        self._size = frame.width, frame.height
        self._reduction = frames.reduction
        places = (_place(guide, frame, stored[frame], offset) for guide in frames.guides for frame in (0, 1))
        self.places = [place for place in places if place]

    def fits(self, formats: Iterable[MotionFormat]) -> dict[MotionFormat, float]:
        """Return the share of the differences without motion that each format leaves.

        It is the geometric mean over the guides that some format explains.
        """
        # 1 in a unit may be 2 in another one.
        formats = {(f.to, f.offset, *f.pixels_per_unit(*self._size)): f for f in reversed(list(formats))}.values()
        left = {form: {p.guide.name: self._left(p, form) for p in self._of(form)} for form in formats}
        names = {name for shares in left.values() for name in shares}
        if not names:
            return dict.fromkeys(left, 1.0)  # nothing moves in the frames in which these formats are tried
        deciding = [n for n in names if min(shares.get(n, 1.0) for shares in left.values()) * MARGIN < 1] or list(names)
        return {
            form: float(np.exp(np.mean([np.log(max(shares.get(n, 1.0), FLOOR)) for n in deciding])))
            for form, shares in left.items()
        }

    def fit_scale(self, form: MotionFormat, fit: float, *, clearly: bool = True) -> float:
        """Return a scale that fits better than that of a format, ``clearly`` or not; its own scale if there is none."""
        best = form
        for width in (2.0, 2 ** (1 / 8), 2 ** (1 / 64)):
            scales = [best.scale * width ** (k / 8) for k in range(-8, 9)]
            fits = self.fits([replace(best, scale=float(f"{s:.4g}")) for s in scales] + [best])
            best = min(fits, key=lambda f: fits[f])
        return best.scale if fits[best] * (MARGIN if clearly else 1) < fit else form.scale

    def is_same(self, form: MotionFormat, other: MotionFormat, fits: dict[MotionFormat, float]) -> bool:
        """Return whether two formats say the same places in these frames."""
        if form not in fits or form.to != other.to:
            return False
        return not any(self._apart(place, form, other).any() for place in self._of(form))

    def silent(self, form: MotionFormat) -> frozenset[str]:
        """Return the axes along which vectors of the other sign would lead to the same places."""
        vectors = np.concatenate([self._vectors(place, form) for place in self._of(form)])
        longest = np.abs(vectors).max(axis=0) * self._reduction
        return frozenset(axis for axis, length in zip("xy", longest, strict=True) if is_silent(length))

    def beats(self, form: MotionFormat, rival: MotionFormat) -> bool:
        """Return whether a format fits clearly better where the two say different places; True if they nowhere do."""
        votes = []
        for place in self._of(form):
            apart = self._apart(place, form, rival)
            if np.count_nonzero(apart) < FEWEST or self._left(place, form) >= 1:
                continue  # positions of a thing that has moved in the world tell nothing
            errors, of_rival = (self._errors(place, self._vectors(place, f)[apart], apart) for f in (form, rival))
            if _median(errors) * MARGIN < _median(of_rival):
                return True
            # In noise, the best format does not fit many times as well as another one. Then pixels vote (sign test).
            voters = np.isfinite(errors) & np.isfinite(of_rival)
            for_form = float(np.mean(errors[voters] < of_rival[voters])) if voters.any() else 0.5
            # Smoothing has correlated the noise over 9 pixels.
            votes.append((2 * for_form - 1) * np.sqrt(np.count_nonzero(voters) / 9))
        return not votes or float(np.sum(votes) / np.sqrt(len(votes))) > SURE

    def _of(self, form: MotionFormat) -> list[_Place]:
        """Return the places of the frame whose vectors a format describes."""
        return [place for place in self.places if place.frame == (0 if form.hop == 1 else 1)]

    def _vectors(self, place: _Place, form: MotionFormat) -> Array:
        factors = np.array(form.pixels_per_unit(*self._size), np.float32) / np.float32(self._reduction)
        with np.errstate(over="ignore"):
            return np.asarray((place.stored - np.float32(form.offset)) * factors)

    def _apart(self, place: _Place, form: MotionFormat, other: MotionFormat) -> Mask:
        """Return where two formats say different places, (n)."""
        difference = self._vectors(place, form) - self._vectors(place, other)
        return np.asarray(np.hypot(*difference.T) * self._reduction > DIFFERENT)

    def _errors(self, place: _Place, vectors: Array, which: Mask | slice = slice(None)) -> Array:
        """Return the differences (n) to the other frame where vectors of ``which`` pixels lead; NaN outside."""
        other = place.guide.images[1 - place.frame]
        height, width = other.shape[:2]
        with np.errstate(invalid="ignore", over="ignore"):
            x, y = place.x[which] + vectors[:, 0], place.y[which] + vectors[:, 1]
            inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
        there = sample_linear(other, np.where(inside, x, 0), np.where(inside, y, 0))
        errors = np.abs(there - place.here[which]).mean(axis=-1)
        errors[~inside] = np.nan
        return errors

    def _left(self, place: _Place, form: MotionFormat) -> float:
        errors = self._errors(place, self._vectors(place, form))
        inside = np.isfinite(errors)
        if np.count_nonzero(inside) < max(FEWEST, len(errors) // 4):
            return 2.0  # a format that leads out of the picture
        still = float(np.median(place.still[inside]))
        return float(np.median(errors[inside])) / still if still > 0 else 1.0


def is_silent(length: float) -> bool:
    """Return whether a movement, in pixels, is too short to tell its sign."""
    return bool(2 * length <= DIFFERENT)


def _median(errors: Array) -> float:
    """Return the median of the finite values; infinity if there are none."""
    finite = errors[np.isfinite(errors)]
    return float(np.median(finite)) if finite.size else float("inf")


def _place(guide: Guide, frame: int, stored: Array, offset: float) -> _Place | None:
    """Choose the pixels of a frame where a guide tells most: where it is steep, and where surfaces move."""
    here, other, steep = guide.images[frame], guide.images[1 - frame], guide.steepness[frame]
    length = np.hypot(*np.moveaxis(stored - np.float32(offset), -1, 0))
    moving = np.isfinite(length) & _moving(stored, offset)
    if not moving.any():
        return None
    # Less than that is nearly still beside the rest, and says little of the format.
    moving &= length >= 0.25 * np.median(length[moving])
    moving &= steep > 1e-6 * float(np.abs(here).max(initial=0.0))
    if np.count_nonzero(moving) < FEWEST:
        return None
    if guide.name != POSITION:  # textures: the steepest quarter; positions tell everywhere
        moving &= steep >= np.quantile(steep[moving], 0.75)
    y, x = np.nonzero(moving)
    chosen = np.linspace(0, len(x) - 1, min(len(x), SAMPLES)).astype(np.int64)
    y, x = y[chosen], x[chosen]
    still = np.abs(other[y, x] - here[y, x]).mean(axis=-1)
    return _Place(guide, frame, x.astype(np.float32), y.astype(np.float32), stored[y, x], here[y, x], still)
