# SPDX-License-Identifier: Apache-2.0
"""Writing the result: the fused beauty first, every other layer of the HRLS as it was, bit for bit.

Layers that are only passed on never become numbers of another type: whole parts are copied by OpenImageIO, the rest
travels a band of rows at a time in its own pixel type.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.arrays import Array
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.exr.layers import layers_of
from oiio_msspl.exr.reader import ROWS_PER_READ, Channel, ExrFile, Part, unreadable
from oiio_msspl.exr.write_options import DEFAULT_COMPRESSION, ERROR_LAYER, LOSSLESS, WriteOptions

#: OpenImageIO's attributes that describe how the source was stored; they are set anew or have no meaning in the copy.
_STRUCTURE = ("openexr:chunkCount", "openexr:lineOrder", "oiio:subimages", "oiio:RowsPerChunk", "compression", "type")
#: Attributes that must be the same in all parts of a file, and those that describe one part.
_SHARED = ("PixelAspectRatio", "chromaticities", "smpte:TimeCode", "view", "name", "oiio:subimagename", "compression")
_DTYPES = {"half": np.float16, "float": np.float32, "uint": np.uint32}


@dataclass(frozen=True)
class _OutPart:
    """A part to be written, and where its pixels come from."""

    spec: Any
    source: Part
    runs: tuple[tuple[Channel, ...], ...] | None
    """Runs of neighbouring channels of one pixel type; None copies the whole part."""


def write_fused(
    path: Path,
    hr: MappedRender,
    rgb: Array,
    alpha: Array | None,
    provenance: dict[str, str],
    options: WriteOptions,
    *,
    error: Array | None = None,
    overwrite: bool = False,
) -> list[str]:
    """Write the fused frame to ``path``, atomically.

    Args:
        rgb: (height, width, 3) over the HRLS's data window.
        alpha: (height, width, 1) if the HRLS has one, otherwise None.
        provenance: attributes added to the beauty's part.
        error: (height, width, 1), becomes the layer ``error``.

    Returns:
        Warnings, one sentence each.

    Raises:
        InputError: the layout can't hold these parts, or a passed-on layer can't be read.
        MssplError: the file can't be written; what stood at ``path`` is untouched.
    """
    fused = _Fused(rgb, alpha, error, _DTYPES[options.pixel_type or _widest_type(fused_channels(hr))])
    dropped = dropped_channels(hr, options)
    warnings = [
        f"part {part.index} ({part.name or 'unnamed'}) is deep and was not passed on"
        for part in hr.file.parts
        if part.deep
    ]
    with replacing(path, overwrite=overwrite) as temporary:
        if options.layout == "multilayer":
            _write_single_part(temporary, hr, fused, dropped, provenance, options)
        else:
            _write_parts(temporary, hr, fused, dropped, provenance, options)
    return warnings


@dataclass(frozen=True)
class _Fused:
    """The fused beauty, converted to what is stored only as rows are written: a frame of 8K is half a gigabyte."""

    rgb: Array
    alpha: Array | None
    error: Array | None
    dtype: Any

    def rows(self, start: int, stop: int) -> Any:
        """Rows of the beauty in the stored type, (stop - start, width, 3 or 4)."""
        values = self.rgb[start:stop]
        if self.alpha is not None:
            values = np.concatenate([values, self.alpha[start:stop]], axis=-1)
        return self._stored(values)

    def error_rows(self, start: int, stop: int) -> Any:
        """Rows of the error in the stored type, (stop - start, width, 1)."""
        assert self.error is not None
        return self._stored(self.error[start:stop])

    def _stored(self, values: Array) -> Any:
        if self.dtype == np.float16:
            values = np.minimum(values, np.float32(65504.0))
        return np.ascontiguousarray(values, dtype=self.dtype)


def _widest_type(channels: Sequence[Channel]) -> str:
    return "float" if any(c.type == "float" for c in channels) else "half"


def fused_channels(hr: MappedRender) -> list[Channel]:
    """The channels of the HRLS that the fused beauty replaces: R, G, B and, where there is one, A."""
    return [*hr.features[RGB].terms[0], *([hr.alpha] if hr.alpha else [])]


def dropped_channels(hr: MappedRender, options: WriteOptions) -> set[Channel]:
    """The channels of the HRLS that ``options.layers`` leaves out; a pattern matches a layer's or a channel's name.

    Raises:
        InputError: a pattern matches nothing.
    """
    if not options.layers:
        return set()
    others = {c: layer.name or c.name for layer in layers_of(hr.file) for c in layer.channels.values()}
    channels = {c for part in hr.file.parts for c in part.channels} - set(fused_channels(hr))
    kept: set[Channel] = set()
    for pattern in options.layers:
        found = {c for c in channels if fnmatchcase(others.get(c, c.name), pattern) or fnmatchcase(c.name, pattern)}
        if not found and pattern != "none":
            names = ", ".join(sorted({others.get(c, c.name) for c in channels})) or "no other layer"
            raise InputError(f"--layers {pattern!r}: {hr.file.path} has no such layer; it has: {names}")
        kept |= found
    return channels - kept


# ---------------------------------------------------------------------------------------------- several parts


def _write_parts(
    path: Path,
    hr: MappedRender,
    fused: _Fused,
    dropped: set[Channel],
    provenance: dict[str, str],
    options: WriteOptions,
) -> None:
    file = hr.file
    beauty = fused_channels(hr)
    home = file.parts[beauty[0].part]
    nuke = options.layout == "nuke"
    names = ["R", "G", "B", "A"][: len(beauty)] if nuke else [c.name for c in beauty]
    first = _spec(home, _nuke_name("rgba", home.view) if nuke else home.name or "rgba", names, fused.dtype)
    first.attribute("compression", options.compression or _kept_compression(home))
    for key, value in provenance.items():
        first.attribute(key, value)
    parts = list(_passed_on(file, set(beauty), dropped, nuke, first))
    specs = [first, *(p.spec for p in parts)]
    if fused.error is not None:
        name = _unique(ERROR_LAYER, {str(spec.getattribute("oiio:subimagename")) for spec in specs})
        specs.insert(1, _spec(home, name, ["Y" if nuke else f"{ERROR_LAYER}.Y"], fused.dtype))
        _keep_shared_attributes(specs[1])
        specs[1].attribute("compression", options.compression or _kept_compression(home))
    writer = oiio.ImageOutput.create(str(path))
    if writer is None:
        raise MssplError(f"{path}: OpenImageIO can't write it ({oiio.geterror()})")
    ok = writer.open(str(path), specs) if len(specs) > 1 else writer.open(str(path), first)
    ok = ok and _write_rows(writer, first, fused.rows)
    if fused.error is not None:
        ok = ok and writer.open(str(path), specs[1], "AppendSubimage")
        ok = ok and _write_rows(writer, specs[1], fused.error_rows)
    for part in parts:
        ok = ok and writer.open(str(path), part.spec, "AppendSubimage")
        ok = ok and _copy(file, part, writer)
    # Closing flushes: a full disk may show only here, and only as an error message.
    ok = writer.close() and ok
    if not ok or writer.has_error:
        reason = " ".join(writer.geterror().split()) or "disk full?"
        raise MssplError(f"{path.parent}: the result can't be written ({reason}); the target is as it was")


def _write_rows(writer: Any, spec: Any, rows: Callable[[int, int], Any]) -> bool:
    """Write the part that is open, a band at a time."""
    for start in range(0, spec.height, ROWS_PER_READ):
        stop = min(start + ROWS_PER_READ, spec.height)
        if not writer.write_scanlines(spec.y + start, spec.y + stop, 0, rows(start, stop)):
            return False
    return True


def _passed_on(
    file: ExrFile, replaced: set[Channel], dropped: set[Channel], nuke: bool, first: Any
) -> Iterator[_OutPart]:
    """Everything of the HRLS but the channels that were fused and those the user leaves out."""
    taken = {str(first.getattribute("oiio:subimagename"))}
    layer_of = {c: layer for layer in layers_of(file) for c in layer.channels.values()}
    for part in file.parts:
        if part.deep:
            continue
        touched = any(c in replaced for c in part.channels)
        whole = not touched and not any(c in dropped for c in part.channels)
        uniform = len({c.type for c in part.channels}) == 1
        # OpenEXR can't mix scan lines, which the beauty is written as, and tiles in a file of several parts.
        if whole and not nuke and (uniform or part.tile == (0, 0)):
            spec = oiio.ImageSpec(part.spec)
            _prepare(spec, _unique(part.name or f"part{part.index}", taken), _kept_compression(part))
            if uniform:
                spec.tile_width = spec.tile_height = spec.tile_depth = 0
            yield _OutPart(spec, part, (part.channels,) if uniform else None)
            continue
        groups: dict[tuple[str, str, str], list[Channel]] = {}
        for channel in part.channels:
            if channel not in replaced and channel not in dropped:
                layer = layer_of.get(channel)
                # A channel that no layer has doubles another one (foo.r beside foo.R): it stays on its own.
                key = (layer.view, layer.name, channel.type) if layer else ("", channel.name, channel.type)
                groups.setdefault(key, []).append(channel)
        for number, ((view, layer_name, kind), channels) in enumerate(groups.items()):
            plain = layer_name or ("depth" if [c.name for c in channels] == ["Z"] else "other")
            name = _unique(_nuke_name(plain, view) if nuke else plain, taken)
            names = [c.name.rpartition(".")[2] for c in channels] if nuke else [c.name for c in channels]
            spec = _spec(part, name, names, _DTYPES[kind])
            if touched or number:
                # The metadata is already in the beauty's part, or in the first that this part became.
                _keep_shared_attributes(spec)
            if nuke and view:
                spec.attribute("view", view)
            yield _OutPart(spec, part, tuple(_runs(channels)))


def _nuke_name(layer: str, view: str) -> str:
    """Part name of a layer as Nuke writes it: no dots but the one before the view."""
    return layer.replace(".", "_") + (f".{view}" if view else "")


def _copy(file: ExrFile, part: _OutPart, writer: Any) -> bool:
    """Copy a part's pixels, in their own type."""
    if part.runs is None:
        source = oiio.ImageInput.open(str(file.path))
        copied = source is not None and source.seek_subimage(part.source.index, 0) and writer.copy_image(source)
        if not copied and source is not None and source.has_error:
            raise unreadable(file.path, part.source, source.geterror())
        return bool(copied)
    streams = [file.native_bands(part.source, run[0].index, run[-1].index + 1) for run in part.runs]
    for bands in zip(*streams, strict=True):
        y0, y1 = bands[0][:2]
        rows = np.concatenate([band[2] for band in bands], axis=-1) if len(bands) > 1 else bands[0][2]
        if not writer.write_scanlines(y0, y1, 0, np.ascontiguousarray(rows)):
            return False
    return True


def _runs(channels: Sequence[Channel]) -> Iterator[tuple[Channel, ...]]:
    """Channels of one type, cut where their indices are not neighbours: what one read can return."""
    run: list[Channel] = []
    for channel in channels:
        if run and channel.index != run[-1].index + 1:
            yield tuple(run)
            run = []
        run.append(channel)
    yield tuple(run)


def _spec(part: Part, name: str, channels: list[str], dtype: Any) -> Any:
    """A scan-line part with some channels of another, keeping its windows and metadata."""
    spec = oiio.ImageSpec(part.spec)
    spec.tile_width = spec.tile_height = spec.tile_depth = 0
    spec.nchannels = len(channels)
    spec.channelnames = tuple(channels)
    spec.channelformats = ()
    spec.format = oiio.TypeDesc(next(kind for kind, known in _DTYPES.items() if known == dtype))
    _prepare(spec, name, _kept_compression(part))
    return spec


def _keep_shared_attributes(spec: Any) -> None:
    """Drop what one part of a file may say for all, such as cryptomatte's manifests of megabytes."""
    for name in [attribute.name for attribute in spec.extra_attribs]:
        if name not in _SHARED:
            spec.erase_attribute(name)


def _prepare(spec: Any, name: str, compression: str) -> None:
    for attribute in _STRUCTURE:
        spec.erase_attribute(attribute)
    # ST 2065-4 forbids compression and AOVs in a file that carries this flag.
    spec.erase_attribute("acesImageContainerFlag")
    spec.attribute("oiio:subimagename", name)
    spec.attribute("name", name)
    spec.attribute("compression", compression)


def _kept_compression(part: Part) -> str:
    return part.compression if part.compression in LOSSLESS else DEFAULT_COMPRESSION


def _unique(name: str, taken: set[str]) -> str:
    """Parts of one file need different names."""
    candidate, number = name, 2
    while candidate in taken:
        candidate, number = f"{name}{number}", number + 1
    taken.add(candidate)
    return candidate


# ---------------------------------------------------------------------------------------------- a single part


def _write_single_part(
    path: Path,
    hr: MappedRender,
    fused: _Fused,
    dropped: set[Channel],
    provenance: dict[str, str],
    options: WriteOptions,
) -> None:
    """One part of mixed pixel types, through OpenEXR's own module: OpenImageIO converts them to a common type.

    The module writes only what it holds whole: this layout needs memory for the file.
    """
    import OpenEXR

    file = hr.file
    beauty = fused_channels(hr)
    home = file.parts[beauty[0].part]
    values = fused.rows(0, fused.rgb.shape[0])
    channels: dict[str, Any] = {c.name: np.ascontiguousarray(values[..., i]) for i, c in enumerate(beauty)}
    del values
    if fused.error is not None:
        channels[f"{ERROR_LAYER}.Y"] = np.ascontiguousarray(fused.error_rows(0, fused.rgb.shape[0])[..., 0])
    for part in file.parts:
        if part.deep or dropped.issuperset(part.channels):
            continue
        if part.data_window != home.data_window:
            raise InputError(
                f"--layout multilayer: part '{part.name}' of {file.path} has the data window {part.data_window}, "
                f"the beauty has {home.data_window}; one part can hold only one, use --layout spec"
            )
        for channel in part.channels:
            if channel in beauty or channel in dropped:
                continue
            # A part's name carries the layer where the channel's does not.
            name = channel.name
            if "." not in name and part.index != home.index:
                name = f"{part.name or f'part{part.index}'}.{name}"
            if name in channels:
                raise InputError(
                    f"--layout multilayer: two parts of {file.path} hold a channel '{name}'; use --layout spec"
                )
            bands = [rows for _, _, rows in file.native_bands(part, channel.index, channel.index + 1)]
            channels[name] = np.concatenate(bands)[..., 0]
    with OpenEXR.File(str(file.path), header_only=True) as source:
        header = dict(source.parts[home.index].header)
    for key in ("channels", "chunkCount", "lineOrder", "acesImageContainerFlag", "tiles", "name"):
        header.pop(key, None)
    compression = options.compression or _kept_compression(home)
    header["compression"] = getattr(OpenEXR, f"{compression.upper() if compression != 'none' else 'NO'}_COMPRESSION")
    header["type"] = OpenEXR.scanlineimage
    header.update(provenance)
    try:
        with OpenEXR.File(header, channels) as out:
            out.write(str(path))
    except Exception as error:
        raise MssplError(f"{path.parent}: the result can't be written ({error}); the target is as it was") from error
