# SPDX-License-Identifier: Apache-2.0
"""Checks whether two renders show the same frame, at the LRHS's resolution.

`research.benchmarks.pair_checks` measures how many wrong pairs each check finds, and how many right pairs it doubts.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.errors import InputError
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.checks.averages import BLOCK, HrlsAverages, bounded_luminance
from oiio_msspl.fusion.checks.colours import different_colours
from oiio_msspl.fusion.checks.edges import Aovs, judge_aovs
from oiio_msspl.fusion.checks.framing import Framing, central_slices, find_framing, jackknife_error, parts
from oiio_msspl.fusion.checks.likeness import ALIKE, VISIBLE, correlations, tone_mapped
from oiio_msspl.fusion.checks.same_noise import MIDDLE, compare_noise
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.features import bucket_side, read_lrhs, read_tile
from oiio_msspl.fusion.tiles.tiling import Tile
from oiio_msspl.image.arrays import Array, quantile
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.parallel import in_background
from oiio_msspl.model.contract import ONE_SIZE

#: Renders that correlate by less have nothing in common, if :data:`VISIBLE` is expected.
NO_PAIR = 0.1
#: Exposures differ if the ratio of the mean luminances, without the brightest percent, exceeds this. Matching pairs
#: reach 1.21.
EXPOSURE_RATIO = 4 / 3
#: At least half of the blocks must differ by this factor in the same direction.
TYPICAL_RATIO = 1.1
#: Framings differ if the shift exceeds the first number in HRLS pixels and the second one in LRHS pixels.
MAX_SHIFT = (0.75, 0.3)
#: Framings also differ if the zoom moves the edge of the frame by more LRHS pixels than this.
MAX_ZOOM_AT_EDGE = 0.8
#: The normals of one render are negated if the mean cosine between those of both is below this. Those of right pairs
#: reach 0.80 in 38 views, and negated ones -0.80.
NEGATED = -0.5
#: A difference of exposure must be this many standard errors from none.
CERTAIN = 6.0
#: Groups of blocks that show different things: side of a block in LRHS pixels, blocks along each side of the group, and
#: the mean of t^2 above which the group differs. Groups of matching views reach 12.9, 8.2 and 9.8.
BLOCK_GROUPS = ((4, 2, 16.0), (4, 3, 11.0), (8, 2, 12.0))
#: Largest t of a single block.
LARGEST_T = 6.0
#: Pixel filters of different widths move light across edges, so this fraction of a block's contrast is no difference.
FILTER_FRACTION = 0.1
#: Pixels are not compared if fewer have noise.
MIN_NOISY_PIXELS = 256
#: The LRHS consists of HRLS pixels if this fraction of its noisy pixels equal an HRLS pixel.
EQUAL_PIXELS = 0.5
#: A render may be black by chance if at most this many pixels of the other render are lit. Around a rectangle, that
#: render may also have this fraction of the brightness inside: the soft edge of an object, where samples are few.
MOST_BY_CHANCE, REGION = 64, 0.1
#: A bucket failed if, by chance, fewer squares than this would be black.
SQUARES_BY_CHANCE = 0.01
#: The warning for a pair that is black.
BOTH_BLACK = Finding("black", "both renders are black (or NaN) everywhere: the result is black")
#: Pixels of the HRLS that :func:`check_renders` reads at a time.
PIXELS_PER_READ = 1024 * 1024


def check_renders(lr: ReadableRender, hr: ReadableRender) -> Judgement:
    """Check whether two renders show the same frame, without fusing them, see :func:`check_pair`.

    Raises:
        InputError: the pair does not fit together, or can't be read, or see :func:`check_pair`.
    """
    alignment = align(lr, hr)
    grid = alignment.grid
    lrhs = read_lrhs(lr, alignment, grid, [RGB, NORMAL])
    averages = HrlsAverages(alignment)
    for band in grid.bands(max(1, PIXELS_PER_READ // (grid.width * alignment.scale**2))):
        averages.add(read_tile(Tile(band, band), lrhs, grid, hr, alignment, [RGB, ALBEDO, NORMAL]))
    return check_pair(bounded_luminance(lrhs[RGB]), averages, lr.name, hr.name)


@dataclass
class Judgement:
    """What two renders say about each other."""

    warnings: list[Finding] = field(default_factory=list)
    """Why they may not show the same frame, one sentence each."""
    not_judged: list[Finding] = field(default_factory=list)
    """What could not be judged, for lack of light, of structure or of pixels: a few words each."""
    independent: bool = True
    """The difference of the renders tells their noise: the LRHS was not made from the HRLS."""


def check_pair(low: Array, hrls: HrlsAverages, lr_name: str, hr_name: str) -> Judgement:
    """Check whether two renders show the same frame.

    Args:
        low: luminance of the LRHS (h, w) over the grid of the alignment, see :func:`bounded_luminance`.
        hrls: averages of all tiles.

    Raises:
        InputError: one render is black, most likely a wrong layer, and the other one is lit by more than chance. Or the
            two do not look alike at all. Or two renders of one size have the same noise, so that there is nothing to
            gain from the second one.
    """
    judgement = _judge(low, hrls, lr_name, hr_name)
    if hrls.alignment.scale == ONE_SIZE:
        if not judgement.independent:
            raise InputError(f"{lr_name} and {hr_name} have the same noise; render each with a noise seed of its own")
        for texts in (judgement.warnings, judgement.not_judged):
            texts[:] = [
                Finding(text.code, text.replace("LRHS", "first render").replace("HRLS", "second render"))
                for text in texts
            ]
    return judgement


def _judge(low: Array, hrls: HrlsAverages, lr_name: str, hr_name: str) -> Judgement:
    """Return the result of :func:`check_pair`, which calls the renders LRHS and HRLS."""
    high, (lost_low, lost_high) = hrls.rgb, hrls.failed
    # As they were rendered, without the light that fills failed buckets.
    rendered = (np.where(lost_low, 0, low), np.where(lost_high, 0, high))
    if not rendered[0].any() and not rendered[1].any():
        return Judgement([BOTH_BLACK])
    if hrls.is_lost:
        raise _black_beauty(hr_name, lr_name)
    for black, lit, black_name, lit_name in ((*rendered, lr_name, hr_name), (*rendered[::-1], hr_name, lr_name)):
        if not black.any():
            if np.count_nonzero(lit) > min(MOST_BY_CHANCE, lit.size // 2):
                raise _black_beauty(black_name, lit_name)
            return Judgement(not_judged=[Finding("not_judged", "anything: few samples find the light")])
    low = np.where(lost_low, high, low)
    scale, places = hrls.alignment.scale, (low, high)
    if scale == ONE_SIZE and min(low.shape) > 1:  # means over 2 x 2 pixels have less noise than renders of full size
        scale, places = 2, (box_downsample(low, 2), box_downsample(high, 2))
    find = in_background(lambda: find_framing(*places))
    aovs = in_background(lambda: judge_aovs(low, hrls))
    judgement = Judgement(_holes(rendered, (low, high), hrls))
    _judge_noise(judgement, low, hrls)
    framing = find()
    if not _looks_alike(judgement, low, high, framing):
        return judgement
    ratio, certain = _brightness_ratio(low, high)
    if not 1 / EXPOSURE_RATIO < ratio < EXPOSURE_RATIO and certain and _is_typical(ratio, hrls):
        text = f"the HRLS is {ratio:.3g} times as bright as the LRHS: are exposure and view layer the same?"
        judgement.warnings.append(Finding("exposure", text))
    colours = different_colours(*(hrls.blocks[..., i : i + 3].reshape(-1, 3) / BLOCK**2 for i in (0, 3)))
    if colours is not None:
        judgement.warnings.append(Finding("colours", f"{colours}: write both in the same colour space"))
    _judge_aovs(judgement, aovs(), hrls)
    _judge_framing(judgement, framing, hrls.alignment, scale)
    if not judgement.warnings and (place := _different_place(*places)) is not None:
        grid, size = hrls.alignment.grid, hrls.alignment.scale
        x, y = (start + scale * at for start, at in zip((grid.x0 * size, grid.y0 * size), place, strict=True))
        text = (
            f"the two renders show different things, most of all around HRLS pixel ({x}, {y}): are they "
            "the same frame, with the same lights and objects?"
        )
        judgement.warnings.append(Finding("different_place", text))
    return judgement


def _black_beauty(name: str, lit_name: str) -> InputError:
    return InputError(
        f"{name}: the beauty is black (or NaN) everywhere, while that of {lit_name} is not; "
        "check which layer it is (--map rgb=LAYER)"
    )


def _holes(rendered: tuple[Array, Array], filled: tuple[Array, Array], hrls: HrlsAverages) -> list[Finding]:
    """Return warnings about regions that one render lacks, given the luminance of both as rendered and as filled."""
    warnings: list[Finding] = []
    grid, scale = hrls.alignment.grid, hrls.alignment.scale
    for i, (name, lit_name) in enumerate((("LRHS", "HRLS"), ("HRLS", "LRHS"))):
        failed = hrls.failed[i]
        if _is_region(rendered[i], filled[1 - i]):
            text = f"the {name} is black outside of a rectangle, where the {lit_name} is lit: was a render region on?"
            warnings.append(Finding("region", text))
        elif failed.any() and not _by_chance(rendered[i][~failed & (filled[1 - i] > 0)], scale):
            y, x = ((np.median(np.argwhere(failed), axis=0) + 0.5) * scale).astype(int)
            text = (
                f"a bucket of the {name} failed: it is black or magenta around HRLS pixel ({grid.x0 * scale + x}, "
                f"{grid.y0 * scale + y}), where the {lit_name} is lit; {failed.mean():.1%} of the frame is filled "
                f"from the {lit_name}"
            )
            warnings.append(Finding("failed_bucket", text))
    return warnings


def _by_chance(pixels: Array, scale: int) -> bool:
    """Return whether rare light may miss a whole square somewhere, by pixels (n,) where the other render is lit."""
    black = float(np.mean(pixels == 0)) if pixels.size else 1.0
    return black ** bucket_side(scale) ** 2 * pixels.size > SQUARES_BY_CHANCE


def _judge_noise(judgement: Judgement, low: Array, hrls: HrlsAverages) -> None:
    noisy, equal = hrls.blocks[..., 6:].sum(axis=(0, 1))
    middle, quarters = low[central_slices(low.shape, MIDDLE)], hrls.quarters
    if hrls.alignment.scale == ONE_SIZE and min(middle.shape) > 1:
        middle, quarters = box_downsample(middle, 2), quarters[: len(quarters) // 2 * 2, : quarters.shape[1] // 2 * 2]
    same, judgement.independent = compare_noise(middle, quarters)
    if same or (noisy >= MIN_NOISY_PIXELS and equal > EQUAL_PIXELS * noisy):
        text = (
            "the LRHS has the noise of the HRLS, so fusing can't remove it: an LRHS is rendered at the smaller size "
            "with more spp, and not made by scaling the HRLS down"
        )
        judgement.warnings.append(Finding("same_noise", text))
    elif same is None:
        judgement.not_judged.append(Finding("not_judged", "whether the LRHS has noise of its own"))


def _looks_alike(judgement: Judgement, low: Array, high: Array, framing: Framing) -> bool:
    """Judge the brightness of blocks, and raise InputError if nothing is common. Return False if more is no use."""
    if framing.mirrored is not None:
        text = f"one of the two renders is mirrored {framing.mirrored}: write both in the same orientation"
        judgement.warnings.append(Finding("mirrored", text))
        return False
    correlation, expected = correlations(*tone_mapped(low, high))
    said = f"correlation {correlation:.2f}, where their noise lets expect {expected:.2f}"
    if expected < VISIBLE:
        judgement.not_judged.append(Finding("not_judged", "whether both show the same thing"))
    elif correlation < NO_PAIR:
        raise InputError(f"the two renders have nothing in common ({said}); give two of the same frame and camera")
    elif correlation < ALIKE * expected and not (framing.x or framing.y or framing.zoom):
        text = f"the two renders hardly look alike ({said}): are they the same frame and camera?"
        judgement.warnings.append(Finding("unlike", text))
        return False
    return True


def _judge_aovs(judgement: Judgement, aovs: Aovs, hrls: HrlsAverages) -> None:
    for aov, (x, y) in aovs.shifted.items():
        text = (
            f"the {aov} is shifted against the picture by {_direction(x, y, hrls.alignment.scale)}: is it of this "
            f"frame, with the same crop and overscan? (--map {aov}=LAYER says which)"
        )
        judgement.warnings.append(Finding("shifted_aov", text))
    for aov in aovs.foreign:
        text = f"the {aov}'s edges are not in the picture: is it this frame's {aov}? (--map {aov}=LAYER says which)"
        judgement.warnings.append(Finding("foreign_aov", text))
    agree = hrls.normals_agree
    if agree is not None and agree < NEGATED:
        text = (
            "the normals of the two renders point in opposite directions: negate them in one "
            "(--map normal=LAYER says which layer they are)"
        )
        judgement.warnings.append(Finding("negated_normal", text))
    elif agree is None and NORMAL in hrls.aovs:
        judgement.not_judged.append(Finding("not_judged", "which way the normals point"))
    unclear = (aov for aov in (ALBEDO, NORMAL) if aov in hrls.aovs and aov not in aovs.judged)
    judgement.not_judged += [Finding("not_judged", f"the {aov}") for aov in unclear]


def _judge_framing(judgement: Judgement, framing: Framing, alignment: Alignment, scale: int) -> None:
    x, y = framing.x * scale, framing.y * scale
    # If an odd size was rounded, LRHS pixels lie up to half a pixel beside their HRLS pixels.
    most = MAX_SHIFT[1] if alignment.stretch == (1.0, 1.0) else max(MAX_SHIFT[1], 0.5)
    if max(abs(x), abs(y)) > max(MAX_SHIFT[0], most * scale):
        text = (
            f"the HRLS is shifted against the LRHS by {_direction(framing.x, framing.y, scale)}: "
            "are camera, crop and overscan the same?"
        )
        judgement.warnings.append(Finding("shifted", text))
    if abs(framing.zoom_at_edge) > MAX_ZOOM_AT_EDGE:
        tighter = "HRLS" if framing.zoom > 0 else "LRHS"
        text = (
            f"the {tighter} is framed {100 * abs(framing.zoom):.1f} % tighter than the other render: are focal "
            "length, crop and overscan the same?"
        )
        judgement.warnings.append(Finding("zoomed", text))
    if not framing.judged:
        judgement.not_judged.append(Finding("not_judged", "the framing"))


def _direction(x: float, y: float, scale: int) -> str:
    """Put a shift, in LRHS pixels, into words."""
    return (
        f"{abs(x * scale):.1f} pixels to the {'right' if x > 0 else 'left'} and "
        f"{abs(y * scale):.1f} pixels {'down' if y > 0 else 'up'}"
    )


def _is_region(black: Array, lit: Array) -> bool:
    """Return whether a picture (h, w) is black around a rectangle where the second one is lit."""
    rows, columns = (np.flatnonzero(black.any(axis=axis)) for axis in (1, 0))
    outside = np.ones(black.shape, np.bool_)
    # The pixel filter of the other render may reach further.
    outside[max(rows[0] - 2, 0) : rows[-1] + 3, max(columns[0] - 2, 0) : columns[-1] + 3] = False
    if np.count_nonzero(lit[outside]) <= MOST_BY_CHANCE:
        return False
    return float(lit[outside].mean()) > REGION * float(lit[~outside].mean())


def _brightness_ratio(low: Array, high: Array) -> tuple[float, bool]:
    """Return by which factor the HRLS is brighter, and whether that is more than noise."""
    # Fireflies dominate a plain mean, so pixels in the brightest percent of either render do not count.
    lit = (low > 0) | (high > 0)
    ordinary = lit & (low <= quantile(low[lit], 0.99)) & (high <= quantile(high[lit], 0.99))
    low_sums, high_sums = (
        np.array([part.sum(dtype=np.float64) for part in parts(v * ordinary)]) + 1e-30 for v in (low, high)
    )
    log_ratio = np.log(high_sums.sum() / low_sums.sum())
    without_part = [sums.sum() - sums for sums in (low_sums, high_sums)]
    error = jackknife_error(np.log(np.maximum(without_part[1], 1e-30) / np.maximum(without_part[0], 1e-30)))
    return float(np.exp(log_ratio)), bool(abs(log_ratio) > CERTAIN * error)


def _is_typical(ratio: float, hrls: HrlsAverages) -> bool:
    """Return whether most blocks differ as the frame does. Rare light may be found by one render alone."""
    low, high = (hrls.blocks[..., i : i + 3].sum(axis=-1) for i in (0, 3))
    lit = (low > 0) & (high > 0)
    typical = float(np.median(np.log(high[lit] / low[lit]))) if lit.any() else 0.0
    return typical * np.log(ratio) > np.log(TYPICAL_RATIO) * abs(np.log(ratio))


def _different_place(low: Array, high: Array) -> tuple[int, int] | None:
    """Return the place (x, y), in LRHS pixels, where the pictures differ by more than noise; None if there is none."""
    # A paired t-test of each block: the picture cancels out, and a firefly has a t of about 1. The mean of t^2 over
    # neighbouring blocks is 1 for noise. A difference of the whole frame raises the median, so that counts, too.
    floor = 0.05 * quantile((low + high).ravel(), 0.5)
    planes = low, high, np.square(low), np.square(low - high)
    for size, side, different in BLOCK_GROUPS:
        if min(low.shape) < size * side:
            continue
        low_mean, high_mean, low_square, difference_square = (box_downsample(plane, size) for plane in planes)
        difference = low_mean - high_mean
        deviation = np.sqrt(np.maximum(difference_square - np.square(difference), 0))
        contrast = np.sqrt(np.maximum(low_square - np.square(low_mean), 0))
        # Two percent of the brightness are no difference, even between renders without noise.
        unimportant = 0.02 * ((low_mean + high_mean) / 2 + floor)
        error = (deviation + FILTER_FRACTION * contrast) / size + unimportant
        t = np.minimum(np.abs(difference) / np.maximum(error, 1e-30), LARGEST_T)
        groups = np.lib.stride_tricks.sliding_window_view(np.square(t), (side, side))
        scores = groups.mean(axis=(-2, -1))
        if scores.max() > different * max(1.0, float(np.median(scores))):
            row, column = np.unravel_index(scores.argmax(), scores.shape)
            y, x = np.unravel_index(groups[row, column].argmax(), (side, side))
            return int((column + x) * size + size // 2), int((row + y) * size + size // 2)
    return None
