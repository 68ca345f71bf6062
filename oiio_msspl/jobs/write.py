# SPDX-License-Identifier: Apache-2.0
"""Writes the EXR of a fused frame, and its preview."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.errors import MssplError
from oiio_msspl.exr.contents import stored_type
from oiio_msspl.exr.preview import old_preview, write_preview
from oiio_msspl.exr.write_options import (
    ALBEDO_LAYER,
    ERROR_LAYER,
    FRAMES_LAYER,
    NORMAL_LAYER,
    TRUST_LAYER,
    WriteOptions,
)
from oiio_msspl.exr.writer import write_fused
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.tiles.tiling import FIXED_MEMORY
from oiio_msspl.image.arrays import HALF_MAX
from oiio_msspl.image.parallel import in_background
from oiio_msspl.jobs.existing import ExistingResults
from oiio_msspl.jobs.frame import ShotFrame, State
from oiio_msspl.jobs.report import FrameReport, provenance

log = logging.getLogger(__name__)


def write_settled(frame: ShotFrame, existing: ExistingResults, *, only_frame: bool = False) -> None:
    """Write the EXR and the preview of a frame that is settled.

    Args:
        frame: the frame; its report gets the time and the warnings of writing.
        existing: says what is replaced.
        only_frame: no other frame needs memory.

    Raises:
        InputError: another process has put a file there in the meantime.
        MssplError: the file system refused. An old frame is as it was; of a new one nothing is left.
    """
    start, settings, picture = time.perf_counter(), existing.settings, frame.picture
    assert picture is not None
    overwrite = settings.overwrite or (frame.files.output.exists() and existing.replaces(frame.files))
    # Half of what is left, because compression and the preview need memory, too. In a shot, the next frame needs all.
    cache_bytes = max(0, settings.max_memory - FIXED_MEMORY - picture.nbytes) // 2 if only_frame else 0
    write_frame(
        frame.report,
        picture,
        settings.write,
        settings.view_transform,
        overwrite=overwrite,
        overwrite_preview=existing.replaces_preview(frame.report.preview),
        cache_bytes=cache_bytes,
    )
    frame.state, frame.picture = State.WRITTEN, None
    frame.report.seconds["write"] = time.perf_counter() - start
    log.debug("report: %s", frame.report.as_dict())


def write_frame(
    report: FrameReport,
    fused: FusedFrame,
    options: WriteOptions,
    view_transform: str | None = None,
    *,
    overwrite: bool,
    overwrite_preview: bool,
    cache_bytes: int = 0,
) -> None:
    """Write the EXR and the preview that a report names. It gets the number of clipped values, and warnings.

    A new EXR gets its name after its preview, so an EXR that exists is a frame that is complete. An EXR that is
    replaced goes first: if it can't be replaced, the old frame keeps its preview.

    Args:
        report, fused: the frame.
        options: how the EXR is written.
        view_transform: OpenColorIO view of the preview; None for the sRGB curve.
        overwrite, overwrite_preview: replace an existing file.
        cache_bytes: see :func:`oiio_msspl.exr.writer.write_fused`.

    Raises:
        InputError: another process has put an EXR there in the meantime.
        MssplError: the file system refused. An old frame is as it was; of a new one nothing is left.
    """

    def preview() -> None:
        _write_preview(report, fused, view_transform, overwrite=overwrite_preview)

    if overwrite and any(path is not None and path.exists() for path in (report.output, report.preview)):
        old = old_preview(report.output)  # shows the old frame, and the new preview may fail or may not be wanted
        delete = None if old is None else lambda: old.unlink(missing_ok=True)
        _write_exr(report, fused, options, overwrite, cache_bytes, before_rename=delete)
        preview()
        return
    wait = in_background(preview)
    try:
        _write_exr(report, fused, options, overwrite, cache_bytes, before_rename=wait)
    except BaseException:
        if wait is not preview:  # with one thread, it may not have begun
            with suppress(Exception):
                wait()
        # If another run has put the frame there in the meantime, the preview belongs to that frame.
        if report.preview is not None and not report.output.exists():
            report.preview.unlink(missing_ok=True)
        raise


def _write_exr(
    report: FrameReport,
    fused: FusedFrame,
    options: WriteOptions,
    overwrite: bool,
    cache_bytes: int,
    before_rename: Callable[[], object] | None,
) -> None:
    if stored_type(report.hr.beauty_channels, options) == "half":
        report.clipped = fused.clipped + int(np.count_nonzero(fused.rgb > HALF_MAX))
    if report.clipped:
        text = f"{report.clipped} values are too bright for half and were clipped to {HALF_MAX:.0f}; --float keeps them"
        report.warnings.append(Finding("clipped", text))
    report.warnings += write_fused(
        report.output,
        report.hr.file,
        report.hr.beauty_channels,
        fused.rgb,
        fused.alpha,
        provenance(report),
        options,
        extra=_layers_about(fused, options),
        replaced=fused.replaced,
        overwrite=overwrite,
        cache_bytes=cache_bytes,
        before_rename=before_rename,
    )


def _layers_about(fused: FusedFrame, options: WriteOptions) -> dict[str, NDArray[Any]]:
    """Return the layers about the fused beauty that are asked for."""
    layers: dict[str, NDArray[Any]] = {} if fused.error is None else {ERROR_LAYER: fused.error}
    if options.frames_layer:
        layers[FRAMES_LAYER] = np.ones_like(fused.rgb[..., :1]) if fused.frames is None else fused.frames
    if options.trust_layer:
        layers[TRUST_LAYER] = fused.trust_pixels()
    if options.data_passes:
        names = {ALBEDO: ALBEDO_LAYER, NORMAL: NORMAL_LAYER}
        layers |= {names[feature]: pixels for feature, pixels in fused.clean_aovs.items()}
    return layers


def _write_preview(report: FrameReport, fused: FusedFrame, view: str | None, *, overwrite: bool) -> None:
    """Write the PNG that the report names, if any.

    A frame is good without its preview, so a failure is added to the report as a warning.
    """
    if report.preview is None:
        return
    windows = (report.hr.data_window, report.hr.display_window)
    try:
        write_preview(report.preview, fused.rgb, *windows, view, report.hr.space, overwrite=overwrite)
    except MssplError as error:
        report.warnings.append(Finding("no_preview", f"no preview: {error}"))
        report.preview = None
