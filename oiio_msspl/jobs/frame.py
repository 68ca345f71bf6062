# SPDX-License-Identifier: Apache-2.0
"""The main job on one frame: fuse a pair of EXRs into one EXR and its preview."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.arrays import HALF_MAX
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_separate, check_target, remove_leftovers
from oiio_msspl.exr.contents import stored_type
from oiio_msspl.exr.preview import check_view, old_preview, write_preview
from oiio_msspl.exr.write_options import ALBEDO_LAYER, ERROR_LAYER, FRAMES_LAYER, NORMAL_LAYER, WriteOptions
from oiio_msspl.exr.writer import bytes_held, check_layout, write_fused
from oiio_msspl.fusion.alignment import Alignment, align
from oiio_msspl.fusion.fuse import FusedFrame, fuse, memory_to_fuse, result_bytes
from oiio_msspl.fusion.tiling import FIXED_MEMORY, MAX_MEMORY, require_memory
from oiio_msspl.jobs.inputs import InputOptions, files_read, map_pair, resolve_auto
from oiio_msspl.jobs.report import FrameReport, add_other_views, provenance, report_on
from oiio_msspl.jobs.views import (
    Progress,
    View,
    check_passes,
    find_other_views,
    fuse_frame_passes,
    fuse_other_views,
    steps_of,
    uses_clean_aovs,
)
from oiio_msspl.model.catalogue import load_model
from oiio_msspl.model.session import Session
from oiio_msspl.parallel import in_background, limit_threads


def memory_to_write(alignment: Alignment, hr: MappedRender, write: WriteOptions) -> int:
    """The smallest ``max_memory`` with which the result can be written, from the headers."""
    held = bytes_held(hr.file, hr.beauty_channels, write)
    return FIXED_MEMORY + result_bytes(alignment, error=write.error_layer) + held


def require_outputs(session: Session, write: WriteOptions) -> None:
    """Raise InputError if a model does not make a layer that is asked for."""
    if write.error_layer:
        session.require_error()
    if write.data_passes:
        session.require_clean_aovs()


def check_written_layers(hr: MappedRender, write: WriteOptions) -> None:
    """Check by the headers that the layers that are asked for are there, and that one file can hold them all.

    Raises:
        InputError: a pattern of ``write`` matches nothing, or the layout can't hold the layers.
    """
    wanted = {
        ERROR_LAYER: write.error_layer,
        FRAMES_LAYER: write.frames_layer,
        ALBEDO_LAYER: write.data_passes and ALBEDO in hr.features,
        NORMAL_LAYER: write.data_passes and NORMAL in hr.features,
    }
    check_layout(hr.file, hr.beauty_channels, write, [name for name, is_added in wanted.items() if is_added])


def check_frame_memory(
    lr: MappedRender, hr: MappedRender, session: Session, write: WriteOptions, max_memory: int, held: int = 0
) -> None:
    """Refuse a pair that does not fit into memory, before its pixels are read.

    Args:
        lr, hr, session, write: what is fused and how it is written.
        max_memory: bytes that the process should stay below.
        held: bytes of these that other frames need.

    Raises:
        InputError: it does not fit. The message says how much does.
    """
    alignment = align(lr, hr)
    to_fuse = memory_to_fuse(alignment, session, error=write.error_layer)
    to_write = memory_to_write(alignment, hr, write)
    only_layout = write.layout == "multilayer" and to_fuse + held <= max_memory
    hint = ", or use --layout spec, which does not hold all layers at once" if only_layout else ""
    require_memory(max(to_fuse, to_write) + held, session.contract, max_memory, hint)


def fuse_files(
    lr_path: str | Path,
    hr_path: str | Path,
    output: str | Path,
    *,
    inputs: InputOptions = InputOptions(),
    write: WriteOptions = WriteOptions(),
    model: str | None = None,
    device: str = "cpu",
    threads: int = 0,
    max_memory: int = MAX_MEMORY,
    preview_path: str | Path | None = None,
    view_transform: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> FrameReport:
    """Fuse a pair of EXR files.

    Args:
        lr_path, hr_path: the low-resolution, high-spp render and the high-resolution, low-spp render of one frame.
        output: EXR to write.
        inputs: mapping, view and spp of the two files. If it names no view, all views and view layers are fused.
        write: layout, compression, pixel type and layers of the result.
        model: a quality (``best``), a family of models (``paper``), a shipped model, or an ONNX file. None and ``auto``
            are the default quality, see :func:`oiio_msspl.model.catalogue.find_model`.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`, such as ``cpu`` or ``cuda``.
        threads: CPU threads; 0 for one on each core.
        max_memory: bytes that the process should stay below. The result does not depend on it.
        preview_path: PNG to write, or None.
        view_transform: OpenColorIO view of the preview; None for the sRGB curve.
        overwrite: replace existing files.
        progress: called with (steps done, steps in all). A step is a tile, or a band of rows of a set of passes.

    Returns:
        What was read, fused and written.

    Raises:
        InputError: a file, an option or the pair can't be used. Nothing was written.
        MssplError: the EXR can't be written. Nothing was written.
    """
    start = time.perf_counter()
    output = check_target(output, overwrite=overwrite)
    if output.suffix.lower() != ".exr":
        raise InputError(f"{output}: the result is an EXR; name it .exr")
    if preview_path is not None:
        preview_path = check_target(preview_path, overwrite=overwrite)
        if view_transform is not None:
            check_view(view_transform)
    lr, hr = map_pair(lr_path, hr_path, inputs)
    others = find_other_views(lr, hr, inputs, write)
    targets = [output] if preview_path is None else [output, preview_path]
    check_separate(files_read(lr, hr, inputs, model), targets)
    remove_leftovers(targets)
    check_written_layers(hr, write)  # a missing layer is an error before the work
    check_passes(hr, others, write)  # and so is a set
    # A frame that can't fit is refused below. Its noise is not looked at, because that reads pixels.
    fits = memory_to_write(align(lr, hr), hr, write) <= max_memory
    family = resolve_auto(lr, hr, model) if fits else model
    session = load_model(align(lr, hr).scale, family, device, threads)
    require_outputs(session, write)
    check_frame_memory(lr, hr, session, write, max_memory)
    opened = time.perf_counter()

    if progress is not None:
        progress = Progress(progress, steps_of([View(lr, hr), *others.views], session, write))
    replaced, reports = fuse_other_views(others, session, write, max_memory, progress=progress)
    half = stored_type(hr.beauty_channels, write) == "half"
    fused = fuse(
        lr,
        hr,
        session,
        error=write.error_layer,
        clean_aovs=uses_clean_aovs(hr, write),
        half=half,
        max_memory=max_memory,
        progress=progress,
    )
    fused.replaced = replaced
    fuse_frame_passes(lr, hr, fused, session, write, max_memory, progress)
    session.release_memory()  # for the writer's cache
    computed = time.perf_counter()

    report = report_on(lr, hr, session, fused, output, preview_path)
    add_other_views(report, reports, others.passed_on)
    # Half of what is left: compression and the preview need memory, too.
    cache_bytes = max(0, max_memory - FIXED_MEMORY - fused.nbytes) // 2
    with limit_threads(threads), _frame_preview(report, fused, view_transform, overwrite=overwrite):
        write_frame(report, fused, write, overwrite=overwrite, cache_bytes=cache_bytes)
    report.seconds = {
        "read": opened - start,
        "fuse": computed - opened,
        "network": report.network_seconds,
        "write": time.perf_counter() - computed,
    }
    return report


def write_frame(
    report: FrameReport, fused: FusedFrame, options: WriteOptions, *, overwrite: bool, cache_bytes: int = 0
) -> None:
    """Write the EXR that the report names. The number of clipped values and the writer's warnings are added to the
    report.

    A preview that shows the EXR that is replaced is deleted, because the new one may fail or may not be wanted.

    Args:
        cache_bytes: see :func:`oiio_msspl.exr.writer.write_fused`.
    """
    if stored_type(report.hr.beauty_channels, options) == "half":
        report.clipped = fused.clipped + int(np.count_nonzero(fused.rgb > HALF_MAX))
    if report.clipped:
        report.warnings.append(
            f"{report.clipped} values are too bright for half and were clipped to {HALF_MAX:.0f}; --float keeps them"
        )
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
        stale=old_preview(report.output) if overwrite else None,
    )


def _layers_about(fused: FusedFrame, options: WriteOptions) -> dict[str, NDArray[Any]]:
    """The layers about the fused beauty that are asked for."""
    layers: dict[str, NDArray[Any]] = {} if fused.error is None else {ERROR_LAYER: fused.error}
    if options.frames_layer:
        layers[FRAMES_LAYER] = np.ones_like(fused.rgb[..., :1]) if fused.frames is None else fused.frames
    if options.data_passes:
        names = {ALBEDO: ALBEDO_LAYER, NORMAL: NORMAL_LAYER}
        layers |= {names[feature]: pixels for feature, pixels in fused.clean_aovs.items()}
    return layers


@contextmanager
def _frame_preview(report: FrameReport, fused: FusedFrame, view: str | None, *, overwrite: bool) -> Iterator[None]:
    """Write the preview while the ``with`` block writes the EXR. If the block fails, nothing is left of the preview."""
    if any(path is not None and path.exists() for path in (report.output, report.preview)):
        yield  # the old preview stays until the EXR has been replaced
        write_frame_preview(report, fused, view, overwrite=overwrite)
        return

    def write() -> None:
        write_frame_preview(report, fused, view, overwrite=overwrite)

    wait = in_background(write)
    try:
        yield
    except BaseException:
        if wait is not write:  # with one thread, it has not begun
            with suppress(Exception):
                wait()
            if report.preview is not None:  # None if it was not written, because somebody else's file came first
                report.preview.unlink(missing_ok=True)
        raise
    wait()


def write_frame_preview(report: FrameReport, fused: FusedFrame, view: str | None, *, overwrite: bool) -> None:
    """Write the PNG that the report names, if any.

    A frame is good without its preview, so a failure is added to the report as a warning.
    """
    if report.preview is None:
        return
    windows = (report.hr.data_window, report.hr.display_window)
    try:
        write_preview(report.preview, fused.rgb, *windows, view, report.hr.space, overwrite=overwrite)
    except MssplError as error:
        report.warnings.append(f"no preview: {error}")
        report.preview = None
