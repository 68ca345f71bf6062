# SPDX-License-Identifier: Apache-2.0
"""The main job on one frame: fuse a pair of EXRs into one EXR and its preview."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.aovs.candidates import mapped_files
from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.arrays import HALF_MAX
from oiio_msspl.colour import REC709, SPACES, ColourSpace, named_space, space_of
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_separate, check_target, remove_leftovers
from oiio_msspl.exr.contents import dropped_channels, widest_type
from oiio_msspl.exr.preview import check_view, old_preview, write_preview
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.exr.writer import bytes_held, write_fused
from oiio_msspl.fusion.alignment import Alignment, align
from oiio_msspl.fusion.fuse import FusedFrame, fuse, memory_to_fuse, result_bytes
from oiio_msspl.fusion.noise import is_noise_spread
from oiio_msspl.fusion.tiling import FIXED_MEMORY, MAX_MEMORY, require_memory
from oiio_msspl.jobs.report import FrameReport, provenance, report_on
from oiio_msspl.model.catalogue import AUTO, DEFAULT_FAMILY, SPREAD_NOISE_FAMILY, find_model
from oiio_msspl.model.session import Session
from oiio_msspl.parallel import in_background, limit_threads


@dataclass(frozen=True)
class InputOptions:
    """What the caller knows of the two files that they do not say themselves."""

    mapping: Mapping[str, Any] = field(default_factory=dict)
    """The user's own layer for each feature, see :func:`oiio_msspl.aovs.matching.map_render`."""
    view: str | None = None
    """View or view layer; the first one of each file if None."""
    lr_spp: float | None = None
    """Samples per pixel of the LRHS; None to read them from its header."""
    hr_spp: float | None = None
    """Samples per pixel of the HRLS; None to read them from its header."""
    colourspace: str | None = None
    """Linear RGB space of both renders, see :func:`oiio_msspl.colour.named_space`; None to read it from the headers,
    and to take linear Rec. 709 if they do not say."""
    map_file: Path | None = None
    """The file that ``mapping`` was read from, if any."""

    def files(self, hr_path: Path, model: str | None) -> set[Path]:
        """The files that a frame is made from beside the pair: of the mapping, and a model that is no shipped one."""
        named = [self.map_file, None if model is None else Path(model)]
        return mapped_files(self.mapping, hr_path) | {path for path in named if path is not None}


def map_pair(lr_path: str | Path, hr_path: str | Path, inputs: InputOptions) -> tuple[MappedRender, MappedRender]:
    """Open both files and map their layers to features.

    Args:
        lr_path, hr_path: the low-resolution and the high-resolution render.
        inputs: mapping, view and spp.

    Returns:
        LRHS and HRLS. The LRHS has albedo and normal only if its file does.

    Raises:
        InputError: one of the files can't be used, both are the same, or their headers declare two colour spaces.
    """
    lr_path, hr_path = Path(lr_path), Path(hr_path)
    if lr_path.exists() and hr_path.exists() and lr_path.samefile(hr_path):
        raise InputError(f"{lr_path}: given twice; give the low-resolution render, then the high-resolution one")
    lr_file, hr_file = open_exr(lr_path), open_exr(hr_path)
    lr, hr = _map_lrhs(lr_file, inputs), map_render(hr_file, inputs.mapping, view=inputs.view, spp=inputs.hr_spp)
    lr.space = hr.space = _common_space(lr, hr, inputs.colourspace)
    return lr, hr


def _common_space(lr: MappedRender, hr: MappedRender, name: str | None) -> ColourSpace:
    """The linear RGB space of a pair. ``name``: see :attr:`InputOptions.colourspace`."""
    if name is not None:
        space = named_space(name)
        if space is None:
            raise InputError(f"--colorspace {name!r}: use one of {', '.join(space.name for space in SPACES)}")
        return space
    low, high = space_of(lr.metadata), space_of(hr.metadata)
    if low is not None and high is not None and low != high:
        raise InputError(
            f"by their headers {lr.name} is in {low.name} and {hr.name} in {high.name}; write both in the same colour "
            "space (or name it with --colorspace if a header is wrong)"
        )
    return high or low or REC709


def _map_lrhs(file: ExrFile, inputs: InputOptions) -> MappedRender:
    """Map the LRHS: its beauty, and albedo and normal where it has them.

    The user's mapping is written for the HRLS. Of its entries only the beauty's applies here: the LRHS need not have
    the other layers, and an entry may name an EXR of the HRLS's size.
    """
    features = [name for name in (ALBEDO, NORMAL) if name not in inputs.mapping]
    rgb_only = {name: layer for name, layer in inputs.mapping.items() if name == RGB}
    return map_render(file, rgb_only, view=inputs.view, spp=inputs.lr_spp, features=features)


def resolve_auto(lr: MappedRender, hr: MappedRender, model: str | None) -> str:
    """The model that is meant: ``auto`` and None are a family that suits the pair's noise.

    Raises:
        InputError: the pair does not fit together.
    """
    if model not in (None, AUTO):
        return model
    if not is_noise_spread(lr, hr, align(lr, hr)):
        return DEFAULT_FAMILY
    hr.notes.append(
        f"the pixel filter has spread the noise over neighbouring pixels, so --model auto takes {SPREAD_NOISE_FAMILY}"
    )
    return SPREAD_NOISE_FAMILY


def files_read(lr: MappedRender, hr: MappedRender, inputs: InputOptions, model: str | None) -> set[Path]:
    """All files that a frame is made from: the pair, what lies beside it, the mapping's files and the model."""
    siblings = {*lr.file.siblings, *hr.file.siblings}
    return {lr.file.path, hr.file.path} | siblings | inputs.files(hr.file.path, model)


def memory_to_write(alignment: Alignment, hr: MappedRender, write: WriteOptions) -> int:
    """The smallest ``max_memory`` with which the result can be written, from the headers."""
    held = bytes_held(hr.file, hr.beauty_channels, write)
    return FIXED_MEMORY + result_bytes(alignment, error=write.error_layer) + held


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
    preview_path: Path | None = None,
    view_transform: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> FrameReport:
    """Fuse a pair of EXR files.

    Args:
        lr_path, hr_path: the low-resolution, high-spp render and the high-resolution, low-spp render of one frame.
        output: EXR to write.
        inputs: mapping, view and spp of the two files.
        write: layout, compression, pixel type and layers of the result.
        model: a shipped model, a family of models (``paper``), or an ONNX file. None or ``auto`` chooses one, see
            :func:`oiio_msspl.model.catalogue.find_model`.
        device: a key of :data:`oiio_msspl.model.session.PROVIDERS`, such as ``cpu`` or ``cuda``.
        threads: CPU threads; 0 for one on each core.
        max_memory: bytes that the process should stay below. The result does not depend on it.
        preview_path: PNG to write, or None.
        view_transform: OpenColorIO view of the preview; None for the sRGB curve.
        overwrite: replace existing files.
        progress: called with (tiles done, tiles in all).

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
        check_target(preview_path, overwrite=overwrite)
        if view_transform is not None:
            check_view(view_transform)
    lr, hr = map_pair(lr_path, hr_path, inputs)
    targets = [output] if preview_path is None else [output, preview_path]
    check_separate(files_read(lr, hr, inputs, model), targets)
    remove_leftovers(targets)
    dropped_channels(hr.file, hr.beauty_channels, write.layers)  # a missing layer is an error before the work
    # A frame that can't fit is refused below. Its noise is not looked at, because that reads pixels.
    fits = memory_to_write(align(lr, hr), hr, write) <= max_memory
    family = resolve_auto(lr, hr, model) if fits else model or DEFAULT_FAMILY
    session = Session(find_model(align(lr, hr).scale, family), device, threads)
    check_frame_memory(lr, hr, session, write, max_memory)
    opened = time.perf_counter()

    fused = fuse(lr, hr, session, error=write.error_layer, max_memory=max_memory, progress=progress)
    computed = time.perf_counter()

    report = report_on(lr, hr, session, fused, output, preview_path)
    del session  # its memory is for the writer's cache
    # Half of what is left: compression and the preview need memory, too.
    cache_bytes = max(0, max_memory - FIXED_MEMORY - fused.nbytes) // 2
    with limit_threads(threads), _frame_preview(report, fused, view_transform, overwrite=overwrite):
        write_frame(report, fused, write, overwrite=overwrite, cache_bytes=cache_bytes)
    report.seconds = {
        "read": opened - start,
        "fuse": computed - opened,
        "network": fused.seconds,
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
    if (options.pixel_type or widest_type(report.hr.beauty_channels)) == "half":
        report.clipped = int(np.count_nonzero(fused.rgb > HALF_MAX))
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
        error=fused.error,
        overwrite=overwrite,
        cache_bytes=cache_bytes,
        stale=old_preview(report.output) if overwrite else None,
    )


@contextmanager
def _frame_preview(report: FrameReport, fused: FusedFrame, view: str | None, *, overwrite: bool) -> Iterator[None]:
    """Write the preview while the ``with`` block writes the EXR. If the block fails, nothing is left of the preview."""
    if any(path is not None and path.exists() for path in (report.output, report.preview)):
        yield  # the old preview stays until the EXR has been replaced
        write_frame_preview(report, fused, view, overwrite=overwrite)
        return
    wait = in_background(lambda: write_frame_preview(report, fused, view, overwrite=overwrite))
    try:
        yield
    except BaseException:
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
