# SPDX-License-Identifier: Apache-2.0
"""Fuses one render or two into one EXR and its preview: a shot of one frame."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_target, remove_leftovers
from oiio_msspl.exr.preview import check_view
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.exr.writer import bytes_held
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY
from oiio_msspl.image.parallel import limit_threads
from oiio_msspl.jobs.inputs import InputOptions, both_paths
from oiio_msspl.jobs.memory import memory_to_write
from oiio_msspl.jobs.passes import WHOLE
from oiio_msspl.jobs.plan import ShotPlan
from oiio_msspl.jobs.report import FrameReport
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles, is_sequence
from oiio_msspl.jobs.settings import Settings, bytes_of, choose_model
from oiio_msspl.jobs.write import write_settled


def fuse_files(
    lr_path: str | Path | None,
    hr_path: str | Path,
    output: str | Path,
    *,
    inputs: InputOptions = InputOptions(),
    write: WriteOptions = WriteOptions(),
    model: str | None = None,
    device: str = "cpu",
    threads: int = 0,
    max_memory: int | str = MAX_MEMORY,
    preview_path: str | Path | bool | None = None,
    view_transform: str | None = None,
    overwrite: bool = False,
    strict: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> FrameReport:
    """Fuse the EXR files of a frame: one render, or two.

    Args:
        lr_path, hr_path: two renders of one frame, each with its own noise: the low-resolution, high-spp render and the
            high-resolution, low-spp render, or two of the same size. None and the only render, if there is one.
        output: EXR to write.
        inputs: mapping, view and spp of the two files. If it names no view, all views and view layers are fused.
        write: layout, compression, pixel type and layers of the result.
        model: a quality (``best``), a family of models (``paper``), a shipped model, or an ONNX file. None and ``auto``
            are the default quality, see :func:`oiio_msspl.model.catalogue.find_model`.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`, such as ``cpu`` or ``cuda``.
        threads: CPU threads; 0 for one on each core.
        max_memory: bytes that the process should stay below, also as ``4G``. The result does not depend on it.
        preview_path: PNG to write; True for one beside the result, None for none.
        view_transform: OpenColorIO view of the preview; None for the sRGB curve.
        overwrite: replace existing files.
        strict: refuse a frame that has a warning, and write nothing.
        progress: called with (thousandths done, 1000) of the whole work, from reading to writing.

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
    if is_sequence(output):
        raise InputError(f"{output}: is a pattern, but LR and HR are single files; name one file")
    max_memory = bytes_of(max_memory)
    preview = None
    if preview_path:
        preview = check_target(
            output.with_suffix(".png") if preview_path is True else preview_path, overwrite=overwrite
        )
        if preview.suffix.lower() != ".png":
            raise InputError(f"{preview}: the preview is a PNG; name it .png")
        if view_transform is not None:
            check_view(view_transform)
    settings = Settings(inputs, write, model, device, threads, max_memory, view_transform, overwrite, strict=strict)
    files = FrameFiles(0, *both_paths(lr_path, hr_path), output, preview)
    if progress is not None:
        progress(0, WHOLE)
    run = ShotRun(settings, ShotPlan(), [files], only_frame=True, tell=progress)
    views = run.read(files)
    frame = views[0]
    frame.require()
    remove_leftovers(files.targets)
    # A frame that can't fit is refused below. Its noise is not looked at, because that reads pixels.
    alignment = align(frame.lr, frame.hr)
    layers = bytes_held(frame.hr.file, frame.hr.beauty_channels, write)
    if memory_to_write(alignment, write, layers) <= max_memory:
        chosen, _ = choose_model(frame.lr, frame.hr, model, frame.read_if_small, error=write.error_layer)
        run.settings = replace(settings, model=chosen)
    run.settings.session(alignment.scale)
    opened = time.perf_counter()
    for settled in run.take(views):
        settled.require()
    frame.session.release_memory()  # for writing
    frame.report.seconds |= {"read": opened - start, "fuse": time.perf_counter() - opened}
    with limit_threads(threads):
        write_settled(frame, run.existing)
    if progress is not None:
        progress(WHOLE, WHOLE)
    return frame.report
