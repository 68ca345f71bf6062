# SPDX-License-Identifier: Apache-2.0
"""Budgets memory: how many frames of a shot live at once, where their pixels wait, and what is left for a tile.

All of it follows from the headers, so a frame that can't fit is refused before its pixels are read. Sizes are in bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB, is_light_of_pass
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Window
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.neighbours.average import memory_to_average_renders, memory_to_average_results
from oiio_msspl.fusion.passes.layers import is_large
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.tiling import FIXED_MEMORY, TILE_MEMORY, memory_to_fuse, require_memory, result_bytes
from oiio_msspl.image.arrays import has_many_pixels
from oiio_msspl.jobs.plan import ViewPlan
from oiio_msspl.jobs.timeline import Reach
from oiio_msspl.model.session import Session

#: Bytes of a pixel: a fused frame with alpha and the expected error; a vector, whether it is believed, and
#: whether an object has moved that it does not follow; and the averaged frame.
FRAME_BYTES, VECTOR_BYTES, RESULT_BYTES = 20, 10, 20
#: Bytes of an LRHS pixel for both renders: their colours while they wait, and their luminance while a fused frame does.
COLOUR_BYTES, LUMINANCE_BYTES = 24, 8
#: Bytes of a pixel for each channel of motion vectors that is read: as stored, decoded, and compared with zero.
READ_VECTOR_BYTES = 12


@dataclass(frozen=True)
class ViewMemory:
    """The memory of a view of a shot whose frames are all like one."""

    features: Sequence[str]
    """The features to read, where the pair has them."""
    motion_channels: list[Channel]
    """The channels of the motion vectors; none if the motion is known otherwise."""
    fits: bool
    """Whether the pixels of all frames that live can wait, beside a tile and two results. They can if ``on_disk``."""
    on_disk: bool
    """Whether renders that are averaged wait in temporary files: when several views are averaged, or memory has no room
    for them and their motion vectors."""
    vectors_ahead: list[Channel]
    """The motion vectors to read with the pixels. If they do not fit beside these, they are read later."""
    held: int
    """Memory of other frames while one is fused: the pixels of the next one, the result of the previous one, and
    neighbours."""
    waiting: int
    """The most memory that the frames of this view take while another view is fused."""


def budget_view(
    lr: MappedRender,
    hr: MappedRender,
    features: Sequence[str],
    plan: ViewPlan,
    *,
    error: bool,
    max_memory: int,
    other_views: int = 0,
) -> ViewMemory:
    """Budget the memory of a view.

    The pair has the light of its passes if renders are averaged with those of neighbours.
    """
    alignment, reach = align(lr, hr), plan.reach
    channels = plan.motion.channels(hr) if plan.motion else []
    result, vectors = result_bytes(alignment, error=error), _vector_bytes(hr, channels)
    # Frames whose pixels live: the one that is fused, its neighbours, and the next one to come.
    pixels = (2 * reach.renders + 2) * sum(_pixel_bytes(render, features) for render in (lr, hr))
    averaged = _channels(hr, features) + (3 if lr is hr else 0)  # one render gets a variance by its frames
    waiting, averaging = memory_to_average(reach, hr.data_window, averaged, alignment.scale)
    waiting += _waiting_means(lr, hr, reach)
    held = result + waiting + averaging + other_views
    room = max_memory - FIXED_MEMORY - TILE_MEMORY - _pixel_bytes(lr, features) - result - held
    on_disk = reach.renders > 0 and (other_views > 0 or room - pixels < vectors)
    in_memory = 0 if on_disk else pixels
    fits = on_disk or room >= pixels
    vectors_ahead = channels if vectors <= room - in_memory else []
    if fits:
        held += in_memory + _vector_bytes(hr, vectors_ahead)
    # Renders that are averaged wait in temporary files, because several views are.
    waiting += 0 if reach.renders else pixels
    return ViewMemory(features, channels, fits, on_disk, vectors_ahead, held, waiting)


def _waiting_means(lr: MappedRender, hr: MappedRender, reach: Reach) -> int:
    """Return what averaged renders take that wait for their passes to be fused. Large ones wait in temporary files."""
    if not light_features(hr) or is_large(hr):
        return 0
    bytes_of_pair = sum(_pixel_bytes(render, [RGB, ALBEDO, NORMAL, *light_features(render)]) for render in (lr, hr))
    return (reach.results + 2) * bytes_of_pair


def memory_to_average(reach: Reach, window: Window, channels: int, scale: int) -> tuple[int, int]:
    """Return what waits to be averaged, without the pixels of renders that are in memory, and what averaging takes.

    ``window`` is the HRLS's data window, and ``channels`` are those of its features.
    """
    if not reach.frames:
        return 0, 0
    working = memory_to_average_results(window)
    if reach.renders:
        working = max(working, memory_to_average_renders(window, channels))
    pixels = window.width * window.height
    held = 2 * reach.results * FRAME_BYTES + 4 * reach.frames * VECTOR_BYTES
    if reach.renders:
        held += 4 * channels
    if has_many_pixels(window.height, window.width):  # what is large waits in temporary files
        held = 0
    both = COLOUR_BYTES * (2 * reach.renders + 2) + LUMINANCE_BYTES * (2 * reach.results + 2)
    return (held + RESULT_BYTES) * pixels + both * pixels // scale**2, working


def memory_to_write(alignment: Alignment, write: WriteOptions, layers: int) -> int:
    """Return what writing takes; ``layers`` are the bytes of other layers that it holds at once."""
    return FIXED_MEMORY + result_bytes(alignment, error=write.error_layer) + layers


def check_frame_memory(
    alignment: Alignment, session: Session, write: WriteOptions, max_memory: int, layers: int, held: int = 0
) -> None:
    """Refuse a pair that does not fit into memory, before its pixels are read or rendered.

    Args:
        layers: bytes of other layers that writing holds at once, see :func:`oiio_msspl.exr.writer.bytes_held`.
        held: bytes that other frames need.
    """
    to_fuse = memory_to_fuse(alignment, session.contract, error=write.error_layer)
    to_write = memory_to_write(alignment, write, layers)
    only_layout = write.layout == "multilayer" and to_fuse + held <= max_memory
    hint = ", or use --layout spec, which does not hold all layers at once" if only_layout else ""
    require_memory(max(to_fuse, to_write) + held, session.contract, max_memory, hint)


def light_features(render: MappedRender) -> list[str]:
    """Return the features of a render that are the light of passes."""
    return [name for name in render.features if is_light_of_pass(name)]


def _channels(render: MappedRender, features: Sequence[str]) -> int:
    return 3 * sum(name in features for name in render.features) + (render.alpha is not None)


def _vector_bytes(render: MappedRender, channels: Sequence[Channel]) -> int:
    return READ_VECTOR_BYTES * len(channels) * render.data_window.width * render.data_window.height


def _pixel_bytes(render: MappedRender, features: Sequence[str]) -> int:
    return render.data_window.width * render.data_window.height * _channels(render, features) * 4
