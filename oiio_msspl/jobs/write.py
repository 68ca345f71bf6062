# SPDX-License-Identifier: Apache-2.0
"""Writes the EXR of a fused frame, and its preview. Views beside the first one are stored until then.

A view whose motion is unknown has no neighbours, so it is fused and stored in a temporary file just before the first
view: memory holds one such view at a time.
"""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.errors import MssplError
from oiio_msspl.exr.contents import FileContents, stored_type
from oiio_msspl.exr.preview import old_preview, write_preview
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.exr.writer import write_fused
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.image.arrays import HALF_MAX
from oiio_msspl.image.parallel import in_background
from oiio_msspl.jobs.existing import ExistingResults
from oiio_msspl.jobs.frame import ShotFrame
from oiio_msspl.jobs.report import provenance

log = logging.getLogger(__name__)

#: Rows of a fused view that are stored at a time.
ROWS_PER_PUT = 256


def write_settled(frame: ShotFrame, existing: ExistingResults) -> None:
    """Write the EXR and the preview of a frame that is settled.

    The EXR gets its name after its preview, so a new EXR is a frame that is complete. A preview of an old frame is
    replaced or deleted when the new EXR is complete, just before it gets its name.

    Args:
        frame: its report gets the time of writing, the number of clipped values, and warnings.
        existing: says what is replaced.

    Raises:
        InputError: another process has put a file there in the meantime.
        MssplError: the file system refused. An old frame is as it was; of a new one nothing is left.
    """
    start, settings, report, picture = time.perf_counter(), existing.settings, frame.report, frame.picture
    assert picture is not None
    overwrite = settings.overwrite or (report.output.exists() and existing.replaces(frame.files))
    overwrite_preview = existing.replaces_preview(report.preview)
    if stored_type(report.hr.beauty_channels, settings.write) == "half":
        report.clipped = picture.clipped + int(np.count_nonzero(picture.rgb > HALF_MAX))
    if report.clipped:
        text = f"{report.clipped} values are too bright for half and were clipped to {HALF_MAX:.0f}; --float keeps them"
        report.warnings.append(Finding("clipped", text))

    replaces = overwrite and any(path is not None and path.exists() for path in (report.output, report.preview))
    old = old_preview(report.output) if replaces else None

    def preview() -> None:
        about = report.hr.data_window, report.hr.display_window, settings.view_transform, report.hr.space
        try:
            if report.preview is not None:
                write_preview(report.preview, picture.rgb, *about, overwrite=overwrite_preview)
        except MssplError as error:  # a frame is good without its preview
            report.warnings.append(Finding("no_preview", f"no preview: {error}"))
            report.preview = None
        if old is not None and old != report.preview:
            old.unlink(missing_ok=True)

    contents = FileContents(
        report.hr.file,
        report.hr.beauty_channels,
        settings.write,
        picture.rgb,
        picture.alpha,
        _layers_about(picture, settings.write),
        provenance(report),
        picture.replaced or ReplacedChannels(),
    )
    finish_preview = preview if replaces else in_background(preview)
    try:
        report.warnings += write_fused(report.output, contents, overwrite=overwrite, before_rename=finish_preview)
    except BaseException:
        if finish_preview is not preview:  # with one thread, it may not have begun
            with suppress(Exception):
                finish_preview()
        # What was there before stays. If another run has put a frame there in the meantime, the preview belongs to it.
        if report.preview is not None and not replaces and not report.output.exists():
            report.preview.unlink(missing_ok=True)
        raise
    frame.picture = None
    report.seconds["write"] = time.perf_counter() - start
    log.debug("report: %s", report.as_dict())


def store_view(hr: MappedRender, fused: FusedFrame, replaced: ReplacedChannels) -> None:
    """Keep the beauty and the alpha of a view. What half can't hold is clipped, and a warning says so.

    An alpha in a part with another data window is passed on as it is.
    """
    channels = [each for each in hr.beauty_channels if hr.file.parts[each.part].data_window == hr.data_window]
    if len(channels) < len(hr.beauty_channels):
        text = "the alpha has another data window than the beauty, so it is passed on as it is"
        fused.warnings.append(Finding("no_alpha", text))
    height, width = fused.rgb.shape[:2]
    replaced.add(channels, width, height)
    clipped = 0
    for start in range(0, height, ROWS_PER_PUT):
        rows = slice(start, start + ROWS_PER_PUT)
        for i, channel in enumerate(channels):
            values = fused.rgb[rows, :, i] if i < 3 or fused.alpha is None else fused.alpha[rows, :, 0]
            clipped += replaced.put(channel, start, values)
    if clipped:
        text = f"{clipped} values are too bright for half and were clipped to {HALF_MAX:.0f}"
        fused.warnings.append(Finding("clipped", text))


def _layers_about(fused: FusedFrame, options: WriteOptions) -> dict[str, NDArray[Any]]:
    """Return the layers about the fused beauty that are asked for."""
    layers: dict[str, NDArray[Any]] = {} if fused.error is None else {"error": fused.error}
    if options.frames_layer:
        layers["frames"] = np.ones_like(fused.rgb[..., :1]) if fused.frames is None else fused.frames
    if options.trust_layer:
        layers["trust"] = fused.trust_pixels()
    if options.data_passes:
        layers |= {f"denoised_{feature}": pixels for feature, pixels in fused.clean_aovs.items()}
    return layers
