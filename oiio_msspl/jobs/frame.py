# SPDX-License-Identifier: Apache-2.0
"""The main job on files: two EXRs in, one EXR and a preview out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_target
from oiio_msspl.exr.output import dropped_channels
from oiio_msspl.exr.preview import check_view, write_preview
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.exr.writer import write_fused
from oiio_msspl.fusion.alignment import align
from oiio_msspl.fusion.fuse import FusedFrame, fuse
from oiio_msspl.fusion.tiling import MAX_MEMORY
from oiio_msspl.jobs.report import FrameReport, _provenance, report_on
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.session import Session


@dataclass(frozen=True)
class InputOptions:
    """How the two files are to be understood, where they do not say it themselves."""

    mapping: Mapping[str, Any] = field(default_factory=dict)
    """The user's own layers by feature, see :func:`oiio_msspl.aovs.matching.map_render`."""
    view: str | None = None
    """View or view layer; the first one of each file if None."""
    lr_spp: float | None = None
    hr_spp: float | None = None


def map_pair(lr_path: str | Path, hr_path: str | Path, inputs: InputOptions) -> tuple[MappedRender, MappedRender]:
    """Open and map both files. Of the LRHS, albedo and normal are welcome beside the beauty, and not missed.

    Raises:
        InputError: one of the files can't be used, or both are the same.
    """
    lr_path, hr_path = Path(lr_path), Path(hr_path)
    if lr_path.exists() and hr_path.exists() and lr_path.samefile(hr_path):
        raise InputError(f"{lr_path}: given twice; give the low-resolution render, then the high-resolution one")
    lr_file, hr_file = open_exr(lr_path), open_exr(hr_path)
    return _map_lrhs(lr_file, inputs), map_render(hr_file, inputs.mapping, view=inputs.view, spp=inputs.hr_spp)


def _map_lrhs(file: ExrFile, inputs: InputOptions) -> MappedRender:
    """Map the LRHS. The user's mapping is the HRLS's: what it names need not be in the LRHS, or is another file."""
    features = [name for name in (ALBEDO, NORMAL) if name not in inputs.mapping]
    rgb_only = {name: layer for name, layer in inputs.mapping.items() if name == RGB}
    return map_render(file, rgb_only, view=inputs.view, spp=inputs.lr_spp, features=features)


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
    preview_path: Path | None = None,
    view_transform: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> FrameReport:
    """Fuse a pair of EXR files.

    Args:
        lr_path, hr_path: the low-resolution, high-spp render and the high-resolution, low-spp render of one frame.
        output: EXR to write.
        inputs, write: how files are understood and stored.
        model: name of a shipped model, a family of them (``paper``) or an ONNX file; None or ``auto``: see
            :func:`oiio_msspl.model.catalogue.find_model`.
        preview_path: PNG to write, or None.
        view_transform: OpenColorIO view of the preview; None for the paper's sRGB curve.
        overwrite: replace existing files.
        progress: called with (tiles done, tiles in all).

    Raises:
        InputError, MssplError: see their messages; nothing was written.
    """
    start = time.perf_counter()
    output = check_target(output, overwrite=overwrite)
    if output.suffix.lower() != ".exr":
        raise InputError(f"{output}: the result is an EXR; name it .exr")
    if any(Path(p).exists() and output.exists() and output.samefile(p) for p in (lr_path, hr_path)):
        raise InputError(f"{output}: is one of the inputs; write the result elsewhere")
    if preview_path is not None:
        check_target(preview_path, overwrite=overwrite)
        if view_transform is not None:
            check_view(view_transform)
    lr, hr = map_pair(lr_path, hr_path, inputs)
    dropped_channels(hr.file, hr.beauty_channels, write.layers)  # raises before any work if a layer is missing
    session = Session(find_model(align(lr, hr).scale, model), device, threads)
    opened = time.perf_counter()

    fused = fuse(lr, hr, session, error=write.error_layer, max_memory=max_memory, progress=progress)
    computed = time.perf_counter()

    report = report_on(lr, hr, session, fused, output, preview_path)
    write_frame(report, fused, write, overwrite=overwrite)
    write_frame_preview(report, fused, view_transform, overwrite=overwrite)
    report.seconds = {
        "read": opened - start,
        "fuse": computed - opened,
        "network": fused.seconds,
        "write": time.perf_counter() - computed,
    }
    return report


def write_frame(report: FrameReport, fused: FusedFrame, options: WriteOptions, *, overwrite: bool) -> None:
    """Write the EXR that the report names, and add what there is to say about it."""
    report.warnings += write_fused(
        report.output,
        report.hr.file,
        report.hr.beauty_channels,
        fused.rgb,
        fused.alpha,
        _provenance(report),
        options,
        error=fused.error,
        overwrite=overwrite,
    )


def write_frame_preview(report: FrameReport, fused: FusedFrame, view: str | None, *, overwrite: bool) -> None:
    """Write the PNG that the report names, if any. A frame without its preview is still a frame: that is a warning."""
    if report.preview is None:
        return
    windows = (report.hr.data_window, report.hr.display_window)
    try:
        write_preview(report.preview, fused.rgb, *windows, view, overwrite=overwrite)
    except MssplError as error:
        report.warnings.append(f"no preview: {error}")
        report.preview = None
