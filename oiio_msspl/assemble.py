# SPDX-License-Identifier: Apache-2.0
"""Writing the result: the fused beauty first, every other layer of the HRLS as it was, bit for bit.

Layers that are only passed on never become numbers of another type: whole parts are copied by OpenImageIO, the rest
travels a band of rows at a time in its own pixel type.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from oiio_msspl import schema
from oiio_msspl.aovs import Resolution, layers_of
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr import Channel, ExrFile, Part
from oiio_msspl.output import replacing
from oiio_msspl.render import Array

LAYOUTS = {
    "spec": "channels named layer.component in parts as the HRLS has them (OpenEXR's rule; most tools)",
    "nuke": "a part a layer, the layer in the part's name alone, as Nuke writes",
    "multilayer": "a single part with all channels",
}
#: Compressions that change pixels.
LOSSY = ("b44", "b44a", "dwaa", "dwab", "pxr24", "htj2k")
LOSSLESS = ("none", "rle", "zip", "zips", "piz")
DEFAULT_COMPRESSION = "zip"

#: OpenImageIO's attributes that describe how the source was stored; they are set anew or have no meaning in the copy.
_STRUCTURE = ("openexr:chunkCount", "openexr:lineOrder", "oiio:subimages", "oiio:RowsPerChunk", "compression", "type")
#: Attributes that must be the same in all parts of a file, and those that describe one part.
_SHARED = ("PixelAspectRatio", "chromaticities", "smpte:TimeCode", "view", "name", "oiio:subimagename", "compression")
_DTYPES = {"half": np.float16, "float": np.float32, "uint": np.uint32}


@dataclass(frozen=True)
class WriteOptions:
    """How the result is stored."""

    layout: str = "spec"
    compression: str | None = None
    """Of the fused beauty; None: as the HRLS's beauty, or ``zip`` where that is lossy. Passed-on layers keep theirs, or
    ``zip`` where it is lossy: they must not lose bits a second time."""
    pixel_type: str | None = None
    """``half`` or ``float`` for the fused beauty; None: as the HRLS's."""

    def __post_init__(self) -> None:
        if self.layout not in LAYOUTS:
            raise InputError(f"--layout {self.layout!r}: use one of {', '.join(LAYOUTS)}")
        if self.compression is not None and self.compression.split(":")[0] not in (*LOSSLESS, *LOSSY):
            raise InputError(f"--compression {self.compression!r}: use one of {', '.join((*LOSSLESS, *LOSSY))}")


@dataclass(frozen=True)
class _OutPart:
    """A part to be written, and where its pixels come from."""

    spec: Any
    source: Part
    runs: tuple[tuple[Channel, ...], ...] | None
    """Runs of neighbouring channels of one pixel type; None copies the whole part."""


def write(
    path: Path, hr: Resolution, rgb: Array, alpha: Array | None, provenance: dict[str, str], options: WriteOptions
) -> list[str]:
    """Write the fused frame to ``path``, atomically.

    Args:
        rgb: (height, width, 3) over the HRLS's data window.
        alpha: (height, width, 1), or None to pass on what the HRLS has.
        provenance: attributes added to the beauty's part.

    Returns:
        Warnings, one sentence each.

    Raises:
        InputError: the layout can't hold these parts.
        MssplError: the file can't be written; what stood at ``path`` is untouched.
    """
    beauty = fused_channels(hr)
    fused = rgb if alpha is None else np.concatenate([rgb, alpha], axis=-1)
    pixel_type = options.pixel_type or beauty[0].type
    if pixel_type == "half":
        fused = np.minimum(fused, np.float32(65504.0))
    fused = np.ascontiguousarray(fused.astype(_DTYPES[pixel_type]))

    warnings = [
        f"part {part.index} ({part.name or 'unnamed'}) is deep and was not passed on"
        for part in hr.file.parts
        if part.deep
    ]
    with replacing(path) as temporary:
        if options.layout == "multilayer":
            _write_single_part(temporary, hr, beauty, fused, provenance, options)
        else:
            _write_parts(temporary, hr, beauty, fused, provenance, options)
    return warnings


def fused_channels(hr: Resolution) -> list[Channel]:
    """The channels of the HRLS that the fused beauty replaces: R, G, B and, where there is one, A."""
    return [*hr.features[schema.RGB].terms[0], *([hr.alpha] if hr.alpha else [])]


# ---------------------------------------------------------------------------------------------- several parts


def _write_parts(
    path: Path, hr: Resolution, beauty: list[Channel], fused: Any, provenance: dict[str, str], options: WriteOptions
) -> None:
    file = hr.file
    home = file.parts[beauty[0].part]
    nuke = options.layout == "nuke"
    names = ["R", "G", "B", "A"][: len(beauty)] if nuke else [c.name for c in beauty]
    first = _spec(
        home, "rgba" if nuke else home.name or "rgba", names, "half" if fused.dtype == np.float16 else "float"
    )
    first.attribute("compression", options.compression or _kept_compression(home))
    for key, value in provenance.items():
        first.attribute(key, value)
    parts = list(_passed_on(file, set(beauty), nuke, first))

    specs = [first, *(p.spec for p in parts)]
    writer = oiio.ImageOutput.create(str(path))
    if writer is None:
        raise MssplError(f"{path}: OpenImageIO can't write it ({oiio.geterror()})")
    ok = writer.open(str(path), specs) if len(specs) > 1 else writer.open(str(path), first)
    ok = ok and writer.write_image(fused)
    for part in parts:
        ok = ok and writer.open(str(path), part.spec, "AppendSubimage")
        ok = ok and _copy(file, part, writer)
    # Closing flushes: a full disk may show only here, and only as an error message.
    ok = writer.close() and ok
    if not ok or writer.has_error:
        reason = " ".join(writer.geterror().split()) or "disk full?"
        raise MssplError(f"{path.parent}: the result can't be written ({reason}); the target is as it was")


def _passed_on(file: ExrFile, replaced: set[Channel], nuke: bool, first: Any) -> Iterator[_OutPart]:
    """Everything of the HRLS but the channels that were fused."""
    taken = {str(first.getattribute("oiio:subimagename"))}
    layer_of = {c: layer.name for layer in layers_of(file) for c in layer.channels.values()}
    for part in file.parts:
        if part.deep:
            continue
        touched = any(c in replaced for c in part.channels)
        if not touched and not nuke:
            spec = oiio.ImageSpec(part.spec)
            _prepare(spec, _unique(part.name or f"part{part.index}", taken), _kept_compression(part))
            uniform = len({c.type for c in part.channels}) == 1
            if uniform:
                spec.tile_width = spec.tile_height = spec.tile_depth = 0
            yield _OutPart(spec, part, (part.channels,) if uniform else None)
            continue
        groups: dict[tuple[str, str], list[Channel]] = {}
        for channel in part.channels:
            if channel not in replaced:
                groups.setdefault((layer_of.get(channel, ""), channel.type), []).append(channel)
        for number, ((layer_name, kind), channels) in enumerate(groups.items()):
            plain = layer_name or ("depth" if [c.name for c in channels] == ["Z"] else "other")
            name = _unique(plain.replace(".", "_") if nuke else plain, taken)
            names = [c.name.rpartition(".")[2] for c in channels] if nuke else [c.name for c in channels]
            spec = _spec(part, name, names, kind)
            if touched or number:
                # The metadata is already in the beauty's part, or in the first that this part became.
                _keep_shared_attributes(spec)
            yield _OutPart(spec, part, tuple(_runs(channels)))


def _copy(file: ExrFile, part: _OutPart, writer: Any) -> bool:
    """Copy a part's pixels, in their own type."""
    if part.runs is None:
        source = oiio.ImageInput.open(str(file.path))
        return bool(source is not None and source.seek_subimage(part.source.index, 0) and writer.copy_image(source))
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


def _spec(part: Part, name: str, channels: list[str], kind: str) -> Any:
    """A scan-line part with some channels of another, keeping its windows and metadata."""
    spec = oiio.ImageSpec(part.spec)
    spec.tile_width = spec.tile_height = spec.tile_depth = 0
    spec.nchannels = len(channels)
    spec.channelnames = tuple(channels)
    spec.channelformats = ()
    spec.format = oiio.TypeDesc(kind)
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
    path: Path, hr: Resolution, beauty: list[Channel], fused: Any, provenance: dict[str, str], options: WriteOptions
) -> None:
    """One part of mixed pixel types, through OpenEXR's own module: OpenImageIO converts them to a common type."""
    import OpenEXR

    file = hr.file
    home = file.parts[beauty[0].part]
    for part in file.parts:
        if not part.deep and part.data_window != home.data_window:
            raise InputError(
                f"--layout multilayer: part '{part.name}' of {file.path} has the data window {part.data_window}, "
                f"the beauty has {home.data_window}; one part can hold only one, use --layout spec"
            )
    channels: dict[str, Any] = {c.name: np.ascontiguousarray(fused[..., i]) for i, c in enumerate(beauty)}
    for layer in layers_of(file):
        for channel in layer.channels.values():
            part = file.parts[channel.part]
            if part.deep or channel.name in channels:
                continue
            # A part's name carries the layer where the channel's does not.
            name = channel.name if "." in channel.name or not layer.name else f"{layer.name}.{channel.name}"
            bands = [rows for _, _, rows in file.native_bands(part, channel.index, channel.index + 1)]
            channels.setdefault(name, np.concatenate(bands)[..., 0])
    with OpenEXR.File(str(file.path), header_only=True) as source:
        header = dict(source.parts[home.index].header)
    for key in ("channels", "chunkCount", "lineOrder", "acesImageContainerFlag", "tiles", "name"):
        header.pop(key, None)
    compression = (options.compression or _kept_compression(home)).split(":")[0]
    header["compression"] = getattr(OpenEXR, f"{compression.upper() if compression != 'none' else 'NO'}_COMPRESSION")
    header["type"] = OpenEXR.scanlineimage
    header.update(provenance)
    try:
        with OpenEXR.File(header, channels) as out:
            out.write(str(path))
    except Exception as error:
        raise MssplError(f"{path.parent}: the result can't be written ({error}); the target is as it was") from error
