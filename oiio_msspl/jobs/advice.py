# SPDX-License-Identifier: Apache-2.0
"""Says what more would help for a scene, and what it costs. The figures are those of ``docs/design/results.md``."""

from __future__ import annotations

from oiio_msspl.aovs.features import ALBEDO
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.model.contract import ONE_SIZE

#: PSNR in dB that one render has over two sizes with the same samples: the least and the most, for 2 to 128 spp.
ONE_OVER_TWO_SIZES = 0.18, 1.53
#: PSNR in dB that three quarters of 8 spp in the HRLS have over half of them.
THREE_QUARTERS = 0.25
#: PSNR in dB that neighbouring frames with motion vectors add, at x2.
NEIGHBOURS = 2.66
#: PSNR in dB of a lit display at 64 and 16 spp: without what both renders show, and with it.
BOTH_SHOW = 17.6, 49.3
#: PSNR in dB at 2 spp of noise that a wide pixel filter has spread: OIDN's, and ours.
SPREAD_NOISE = (21.20, 32.40)
#: From so many samples per pixel of the HRLS on, most samples belong there; the LRHS then has at most this share.
MANY_SPP, LARGEST_SHARE = 3, 1 / 3


def advise(lr: MappedRender, hr: MappedRender, spread: bool | None, *, in_shot: bool) -> list[Finding]:
    """Return what more would help for a frame, one or two sentences each, and what does not pay. For a result: nothing.

    Args:
        lr, hr: the pair; one render is both.
        spread: whether the pixel filter has spread the noise; None if that is unknown.
        in_shot: whether other frames follow.

    Raises:
        InputError: the pair does not fit together.
    """
    scale = align(lr, hr).scale
    if any(name.startswith("msspl/") for name in hr.metadata):
        return []  # it is fused already
    advice = []
    if ALBEDO not in hr.features:
        text = "render an albedo, or name its layer with --map albedo=LAYER: without it textures blur. It costs a layer"
        advice.append(Finding("add_albedo", f"{text}, and no samples"))
    if in_shot and not hr.motion.fields:
        text = f"render motion vectors: averaging with neighbouring frames adds {NEIGHBOURS:.1f} dB. They cost a layer"
        advice.append(Finding("add_motion", f"{text}, and no samples"))
    if spread:
        oidn, ours = SPREAD_NOISE
        text = (
            "render with a box filter of one pixel: it costs nothing, and the result is a little sharper. With this "
            f"filter, the noise is removed all the same ({ours:.1f} dB at 2 spp, where OIDN reaches {oidn:.1f})"
        )
        advice.append(Finding("box_filter", text))
    if lr is hr and not hr.features_read((), alone=True):
        without, with_both = BOTH_SHOW
        text = (
            "render half of the samples with another seed, as a second file, or the variance of each pixel's mean as a "
            "layer: they cost no samples. Detail that no AOV shows, such as screens and thin shadows, is kept where "
            f"they tell it from noise (a lit display at 64 and 16 spp: {with_both} dB, and {without} by the network "
            "alone)"
        )
        advice.append(Finding("second_seed", text))
    if not spread and (lr is hr or scale != ONE_SIZE):  # sizes were compared with independent noise
        what = "without the low-resolution render, one render with all samples would be"
        if lr is hr:
            what = "a low-resolution render would not pay here: one render is"
        least, most = ONE_OVER_TWO_SIZES
        text = f"{what} {least:.1f} to {most:.1f} dB more accurate than two sizes with the same samples"
        advice += [
            *_samples(lr, hr, scale),
            Finding("no_lrhs", f"{text}. Two sizes pay where the small render exists anyway"),
        ]
    return advice


def _samples(lr: MappedRender, hr: MappedRender, scale: int) -> list[Finding]:
    """Advise to move samples to the HRLS, if it has enough to gain from more."""
    if lr is hr or lr.spp is None or hr.spp is None or hr.spp < MANY_SPP:
        return []
    small = lr.spp / scale**2
    total = small + hr.spp
    if small <= LARGEST_SHARE * total:
        return []
    text = (
        f"give three quarters of the samples to the full-resolution render: {0.75 * total:.3g} spp, and "
        f"{0.25 * total * scale**2:.3g} in the small one. It costs nothing, and adds {THREE_QUARTERS} dB at 8 "
        "spp in all"
    )
    return [Finding("more_hr_samples", text)]
