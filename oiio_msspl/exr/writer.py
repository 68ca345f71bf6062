# SPDX-License-Identifier: Apache-2.0
"""Write the result: the fused beauty first, then the layers of the HRLS that are passed on, bit for bit."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.exr.contents import FileContents
from oiio_msspl.exr.part_specs import beauty_spec, extra_spec, passed_on_parts, share_attributes
from oiio_msspl.exr.reader import Channel, ExrFile, open_exr, reason_of
from oiio_msspl.exr.render import Window
from oiio_msspl.exr.single_part import channel_names, write_single_part
from oiio_msspl.exr.strips import LARGEST_STRIP, ROWS_PER_STRIP, strip_rows
from oiio_msspl.exr.write_options import ADDED, WriteOptions
from oiio_msspl.findings import Finding
from oiio_msspl.image.arrays import unload
from oiio_msspl.image.parallel import one_ahead


def write_fused(
    path: Path,
    contents: FileContents,
    *,
    overwrite: bool = False,
    before_rename: Callable[[], object] | None = None,
) -> list[Finding]:
    """Write the fused frame to ``path``, atomically.

    ``overwrite`` and ``before_rename`` are those of :func:`oiio_msspl.exr.atomic.replacing`.

    Returns:
        Warnings, one sentence each.

    Raises:
        InputError: the layout can't hold these parts, a layer can't be read, or ``path`` exists.
        MssplError: the file can't be written; a file at ``path`` is untouched.
    """
    parts, last = contents.source.parts, contents.fused[-1]
    warnings = [
        Finding("deep", f"part {part.index} ({part.name or 'unnamed'}) is deep and was not passed on")
        for part in parts
        if part.deep
    ]
    if last not in contents.beauty and contents.alpha is not None:
        alpha = contents.alpha[..., 0]
        if parts[last.part].data_window == contents.home.data_window:
            contents.replaced.add([last], alpha.shape[1], alpha.shape[0])
            contents.replaced.put(last, 0, alpha)
        else:
            text = "the alpha has another data window than the beauty, so it is passed on as it is"
            warnings.append(Finding("no_alpha", text))
        contents = replace(contents, alpha=None)
    with replacing(path, overwrite=overwrite, before_rename=before_rename) as temporary:
        if contents.options.layout == "multilayer":
            write_single_part(temporary, contents)
        else:
            _write_parts(temporary, contents)
        _check_whole(temporary, contents.compression)
    return warnings


def check_layout(source: ExrFile, beauty: tuple[Channel, ...], options: WriteOptions, extra: Iterable[str]) -> None:
    """Check by the headers alone that the layout can hold a fused frame with these ``extra`` layers."""
    contents = FileContents(source, beauty, options, extra=dict.fromkeys(extra, np.empty(0)))
    kept = {layer.name for channel, layer in contents.layers.items() if channel not in contents.dropped}
    if name := next((name for name in contents.extra if name in kept), None):
        raise InputError(
            f"--{ADDED[name].replace('_', '-')}: {source.path} has a layer '{name}' of its own; choose other layers "
            "with --layers, or leave the option out"
        )
    if options.layout == "multilayer":
        channel_names(contents)


def bytes_held(source: ExrFile, beauty: tuple[Channel, ...], options: WriteOptions) -> int:
    """Return the bytes of pixels that :func:`write_fused` holds beside the fused frame, by the headers alone."""
    if options.layout != "multilayer":
        return 0
    contents = FileContents(source, beauty, options)
    passed_on = (part.plane_bytes(channel) for part, channels in contents.passed_on for channel in channels)
    return sum(passed_on) + sum(contents.home.plane_bytes(channel) for channel in contents.beauty)


def _write_parts(path: Path, contents: FileContents) -> None:
    """Write a file of several parts: the beauty, the further layers, and those that are passed on."""
    beauty = beauty_spec(contents)
    taken = {str(beauty.getattribute("oiio:subimagename"))}
    passed_on = passed_on_parts(contents, taken)
    extra = {name: extra_spec(contents, name, taken) for name in contents.extra}
    specs = [beauty, *extra.values(), *(part.spec for part in passed_on)]
    share_attributes(specs, contents.source)

    writer = oiio.ImageOutput.create(str(path))
    if writer is None:
        raise OSError(reason_of(oiio))
    ok = writer.open(str(path), specs if len(specs) > 1 else beauty)
    ok = ok and _write_rows(writer, beauty, contents.rows)
    for name, spec in extra.items():
        ok = ok and writer.open(str(path), spec, "AppendSubimage")
        ok = ok and _write_rows(writer, spec, partial(contents.extra_rows, name))
    for source, group in itertools.groupby(passed_on, key=lambda part: part.source):
        parts = list(group)
        planes = contents.planes(
            source, [channel for part in parts for channel in part.channels], on_disk=source.nbytes > LARGEST_STRIP
        )
        for part in parts:
            ok = ok and writer.open(str(path), part.spec, "AppendSubimage")
            rows = partial(_interleaved, [planes[channel] for channel in part.channels])
            ok = ok and _write_rows(writer, part.spec, rows, source.strip_height)
    # Closing flushes: a full disk may show only here, and only as an error message.
    ok = writer.close() and ok
    if not ok or writer.has_error:
        raise OSError(f"{reason_of(writer)}; is the disk full?")


def _check_whole(temporary: Path, compression: str) -> None:
    """Read the first and last row of every part: OpenImageIO does not tell if a full disk cut off the file's end.

    Nor does it tell that it lacks a compression, and writes zip.
    """
    try:
        with closing(open_exr(temporary)) as file:
            written = file.parts[0].compression
            for part in file.parts:
                window = part.data_window
                for y in (window.y0, window.y1 - 1):
                    file.read(part.channels[:1], Window(window.x0, y, window.x1, y + 1))
    except InputError as error:
        raise OSError("its end is missing; is the disk full?") from error
    if written != compression:
        raise InputError(f"--compression {compression}: this OpenImageIO writes {written} instead; name another one")


def _write_rows(
    writer: Any, spec: Any, rows: Callable[[int, int], NDArray[Any]], strip_height: int = ROWS_PER_STRIP
) -> bool:
    """Write the part that is open, a strip at a time; ``rows(start, stop)`` gives its pixels."""
    ranges = strip_rows(0, spec.height, 0, strip_height, spec.height)
    # The next rows are converted while OpenImageIO compresses these.
    for start, stop, pixels in one_ahead((a, b, rows(a, b)) for a, b in ranges):
        if not writer.write_scanlines(spec.y + start, spec.y + stop, 0, pixels):
            return False
    return True


def _interleaved(planes: Sequence[NDArray[Any]], start: int, stop: int) -> NDArray[Any]:
    """Return rows of some channels, (stop - start, width, channels)."""
    rows = np.stack([plane[start:stop] for plane in planes], axis=-1)
    for plane in planes:
        unload(plane)
    return rows
