# SPDX-License-Identifier: Apache-2.0
"""Checks one frame by the headers of its pair and by its model, before any pixel is read."""

from __future__ import annotations

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.write_options import ALBEDO_LAYER, ERROR_LAYER, FRAMES_LAYER, NORMAL_LAYER, WriteOptions
from oiio_msspl.exr.writer import bytes_held, check_layout
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.tiling import FIXED_MEMORY, memory_to_fuse, require_memory, result_bytes
from oiio_msspl.model.session import Session


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
    layers = bytes_held(hr.file, hr.beauty_channels, write)
    require_frame_memory(align(lr, hr), session, write, max_memory, layers=layers, held=held)


def require_frame_memory(
    alignment: Alignment, session: Session, write: WriteOptions, max_memory: int, *, layers: int, held: int
) -> None:
    """The same for a pair that need not exist yet.

    Args:
        layers: bytes of other layers that writing holds at once.
    """
    to_fuse = memory_to_fuse(alignment, session.contract, error=write.error_layer)
    to_write = FIXED_MEMORY + result_bytes(alignment, error=write.error_layer) + layers
    only_layout = write.layout == "multilayer" and to_fuse + held <= max_memory
    hint = ", or use --layout spec, which does not hold all layers at once" if only_layout else ""
    require_memory(max(to_fuse, to_write) + held, session.contract, max_memory, hint)
