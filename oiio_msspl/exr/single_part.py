# SPDX-License-Identifier: Apache-2.0
"""Write the result as a single part with all channels.

OpenImageIO would convert the channels of a part to one pixel type. OpenEXR's Python module keeps their types, but needs
the whole file in memory.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from oiio_msspl.errors import InputError
from oiio_msspl.exr.contents import FileContents
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.write_options import COMPONENTS
from oiio_msspl.image.arrays import planes_of

#: Header entries that describe how the source was stored. ST 2065-4 forbids the ACES flag in a file with AOVs.
_STRUCTURE = ("channels", "chunkCount", "lineOrder", "acesImageContainerFlag", "tiles", "name")
#: Header entries that count for all parts of a file, whichever part holds them.
_SHARED = ("chromaticities", "timeCode")


def write_single_part(path: Path, contents: FileContents) -> None:
    """Write all channels into one part of the file ``path``."""
    import OpenEXR

    channels, names = _fused_channels(contents), channel_names(contents)
    for part, passed_on in contents.passed_on:
        channels |= {names[c]: plane for c, plane in contents.planes(part, passed_on, on_disk=False).items()}
    header = _header(contents)
    try:
        with OpenEXR.File(header, channels) as file:
            file.write(str(path))
    except Exception as error:
        raise OSError(f"{error}; is the disk full?") from error


def _fused_channels(contents: FileContents) -> dict[str, NDArray[Any]]:
    """Return the fused beauty and the further layers, (height, width) by channel name."""
    height = contents.rgb.shape[0]
    channels = dict(zip([c.name for c in contents.beauty], planes_of(contents.rows(0, height)), strict=True))
    for name in contents.extra:
        names = [f"{name}.{component}" for component in COMPONENTS[name]]
        channels |= zip(names, planes_of(contents.extra_rows(name, 0, height)), strict=True)
    return channels


def channel_names(contents: FileContents) -> dict[Channel, str]:
    """Name the channels that are passed on, by the headers alone."""
    path, window = contents.source.path, contents.home.data_window
    taken = {channel.name for channel in contents.beauty}
    names: dict[Channel, str] = {}
    for part, passed_on in contents.passed_on:
        if part.data_window != window:
            raise InputError(
                f"--layout multilayer: part '{part.name}' of {path} has the data window {part.data_window}, "
                f"the beauty has {window}; one part can hold only one, use --layout spec"
            )
        for channel in passed_on:
            name = names[channel] = _name(contents, channel)
            if name in taken:
                raise InputError(f"--layout multilayer: two parts of {path} hold a channel '{name}'; use --layout spec")
            taken.add(name)
    return names


def _name(contents: FileContents, channel: Channel) -> str:
    """Return the channel's stored name, behind the part's name if only that names the layer."""
    layer = contents.layers.get(channel)
    if layer is not None and layer.view not in ("", contents.view):  # OpenEXR wants the view behind the layer
        return ".".join(name for name in (layer.name, layer.view, channel.name.rpartition(".")[2]) if name)
    if "." in channel.name or channel.part == contents.home.index:
        return channel.name
    part = contents.source.parts[channel.part]
    return f"{part.name or f'part{part.index}'}.{channel.name}"


def _header(contents: FileContents) -> dict[str, Any]:
    """Return the header of the HRLS's beauty, with metadata of the parts that are passed on."""
    import OpenEXR

    path = contents.source.path
    try:
        # OpenEXR 3.3 returns no parts without their pixels.
        with OpenEXR.File(str(path), header_only=not OpenEXR.__version__.startswith("3.3.")) as source:
            header = dict(source.parts[contents.home.index].header)
            for part, _ in contents.passed_on:  # such as Cryptomatte's manifests
                passed_on = source.parts[part.index].header
                header = {key: value for key, value in passed_on.items() if key != "view"} | header
            for part in source.parts:  # also those that are left out
                header = {key: part.header[key] for key in _SHARED if key in part.header} | header
    except UnicodeDecodeError as error:
        raise InputError(
            f"--layout multilayer: the header of {path} has names or texts that are not UTF-8; use --layout spec"
        ) from error
    for key in _STRUCTURE:
        header.pop(key, None)
    layers = contents.layers
    channels = (channel for _, passed_on in contents.passed_on for channel in passed_on)
    views = dict.fromkeys([contents.view, *(layers[channel].view for channel in channels if channel in layers)])
    views.pop("", None)
    if len(views) > 1 or "multiView" in header:
        header.pop("view", None)
        header["multiView"] = list(views)
    name = "NO" if contents.compression == "none" else contents.compression.upper()
    compression = getattr(OpenEXR, f"{name}_COMPRESSION", None)
    if compression is None:
        raise InputError(f"--compression {contents.compression}: OpenEXR {OpenEXR.__version__} lacks it; name another")
    return header | {"compression": compression, "type": OpenEXR.scanlineimage} | contents.attributes
