# SPDX-License-Identifier: Apache-2.0
"""Writing the result as a single part with all channels.

OpenImageIO would convert the channels of a part to one pixel type. OpenEXR's own module keeps each channel's type, but
needs the whole file in memory.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.contents import FileContents
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.write_options import ERROR_LAYER

#: Header entries that say how the source was stored. The ACES flag is forbidden in a file with AOVs (ST 2065-4).
_STRUCTURE = ("channels", "chunkCount", "lineOrder", "acesImageContainerFlag", "tiles", "name")


def write_single_part(path: Path, contents: FileContents) -> None:
    """Write all channels into one part of the file ``path``.

    Raises:
        InputError: parts have different data windows or equal channel names, or a layer can't be read.
        MssplError: the file can't be written.
    """
    import OpenEXR

    channels = _fused_channels(contents)
    _add_passed_on_channels(contents, channels)
    header = _header(contents)
    try:
        with OpenEXR.File(header, channels) as file:
            file.write(str(path))
    except Exception as error:
        raise MssplError(f"{path.parent}: the result can't be written ({error}); the target is as it was") from error


def _fused_channels(contents: FileContents) -> dict[str, NDArray[Any]]:
    """The fused beauty and its error: (height, width) by channel name."""
    height = contents.pixels.rgb.shape[0]
    beauty = contents.pixels.rows(0, height)
    channels = {c.name: np.ascontiguousarray(beauty[..., i]) for i, c in enumerate(contents.beauty)}
    if contents.pixels.error is not None:
        channels[f"{ERROR_LAYER}.Y"] = np.ascontiguousarray(contents.pixels.error_rows(0, height)[..., 0])
    return channels


def _add_passed_on_channels(contents: FileContents, channels: dict[str, NDArray[Any]]) -> None:
    """Add the channels of the HRLS that are neither fused nor dropped."""
    file, home = contents.source, contents.home
    for part in file.parts:
        if part.deep or contents.dropped.issuperset(part.channels):
            continue
        if part.data_window != home.data_window:
            raise InputError(
                f"--layout multilayer: part '{part.name}' of {file.path} has the data window {part.data_window}, "
                f"the beauty has {home.data_window}; one part can hold only one, use --layout spec"
            )
        for channel in part.channels:
            if channel in contents.beauty or channel in contents.dropped:
                continue
            name = _name(contents, channel)
            if name in channels:
                raise InputError(
                    f"--layout multilayer: two parts of {file.path} hold a channel '{name}'; use --layout spec"
                )
            strips = [strip for _, _, strip in file.native_strips(part, channel.index, channel.index + 1)]
            channels[name] = np.concatenate(strips)[..., 0]


def _name(contents: FileContents, channel: Channel) -> str:
    """The channel's own name, or the part's name in front of it if only that names the layer."""
    if "." in channel.name or channel.part == contents.home.index:
        return channel.name
    part = contents.source.parts[channel.part]
    return f"{part.name or f'part{part.index}'}.{channel.name}"


def _header(contents: FileContents) -> dict[str, Any]:
    """The header of the HRLS's beauty, with the compression and the attributes of the contents."""
    import OpenEXR

    with OpenEXR.File(str(contents.source.path), header_only=True) as source:
        header = dict(source.parts[contents.home.index].header)
    for key in _STRUCTURE:
        header.pop(key, None)
    name = "NO" if contents.compression == "none" else contents.compression.upper()
    header["compression"] = getattr(OpenEXR, f"{name}_COMPRESSION")
    header["type"] = OpenEXR.scanlineimage
    header.update(contents.attributes)
    return header
