# SPDX-License-Identifier: Apache-2.0
"""Budgets memory: how many frames of a shot live at once, where their pixels wait, and what is left for a tile.

All of it follows from the headers, so a frame that can't fit is refused before its pixels are read. Sizes are in bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL, RGB, is_light_of_pass
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
    """The memory of a view of a shot whose frames are all like this one."""

    lr: MappedRender
    hr: MappedRender
    """The pair, with the light of its passes if renders are averaged with those of neighbours."""
    features: Sequence[str]
    """The features to read, where the pair has them."""
    plan: ViewPlan
    error: bool
    """Whether the expected error is computed."""
    max_memory: int
    """What the process should stay below."""
    other_views: int = 0
    """What frames of other views take while this one is fused."""

    @cached_property
    def fits(self) -> bool:
        """Whether there is room for the pixels of all frames that live, beside a tile and two results."""
        return self._room(self._frames_in_memory) >= 0

    @cached_property
    def on_disk(self) -> bool:
        """Whether waiting renders are spilled to temporary files: always when several views are averaged, otherwise
        only if a large frame and its motion vectors do not fit into memory."""
        if not self.plan.reach.renders:
            return False
        if self.other_views:
            return True
        return is_large(self.hr) and self._room(self._frames_alive) < _vector_bytes(self.hr, self.motion_channels)

    @cached_property
    def vectors_ahead(self) -> list[Channel]:
        """The motion vectors to read with the pixels. If they do not fit beside these, they are read later."""
        channels = self.motion_channels
        return channels if _vector_bytes(self.hr, channels) <= self._room(self._frames_in_memory) else []

    @cached_property
    def held(self) -> int:
        """Memory of other frames while one is fused: the pixels of the next one, the result of the previous one, and
        neighbours."""
        held = self._result + self._averaging + self.other_views
        if self.fits:
            held += self._frames_in_memory * self._pair + _vector_bytes(self.hr, self.vectors_ahead)
        return held

    @cached_property
    def waiting(self) -> int:
        """The most memory that the frames of this view take while another view is fused."""
        waiting = self._to_average[0] + self._waiting_means
        # Renders that are averaged wait in temporary files, because several views are.
        return waiting if self.plan.reach.renders else waiting + self._frames_alive * self._pair

    @cached_property
    def motion_channels(self) -> list[Channel]:
        """The channels of the motion vectors; none if the motion is known otherwise."""
        return self.plan.motion.channels(self.hr) if self.plan.motion else []

    def _room(self, frames: int) -> int:
        """Memory that is left beside the pixels of ``frames`` frames; negative if they don't fit."""
        rest = FIXED_MEMORY + TILE_MEMORY + 2 * self._result + _pixel_bytes(self.lr, self.features)
        return self.max_memory - rest - self._averaging - self.other_views - frames * self._pair

    @property
    def _frames_alive(self) -> int:
        """Frames whose pixels live: the one that is fused, its neighbours, and the next one to come."""
        return 2 * self.plan.reach.renders + 2

    @property
    def _frames_in_memory(self) -> int:
        return 0 if self.on_disk else self._frames_alive

    @cached_property
    def _alignment(self) -> Alignment:
        return align(self.lr, self.hr)

    @cached_property
    def _result(self) -> int:
        return result_bytes(self._alignment, error=self.error)

    @cached_property
    def _pair(self) -> int:
        return sum(_pixel_bytes(render, self.features) for render in (self.lr, self.hr))

    @property
    def _averaging(self) -> int:
        """Memory of averaging, and of means that wait for their passes to be fused."""
        return sum(self._to_average) + self._waiting_means

    @cached_property
    def _to_average(self) -> tuple[int, int]:
        channels = _channels(self.hr, self.features)
        return memory_to_average(self.plan.reach, self.hr.data_window, channels, self._alignment.scale)

    @cached_property
    def _waiting_means(self) -> int:
        """Memory of averaged renders that wait for their passes to be fused. Large ones wait in temporary files."""
        if not light_features(self.hr) or is_large(self.hr):
            return 0
        renders = (self.lr, self.hr)
        bytes_of_pair = sum(_pixel_bytes(render, [RGB, ALBEDO, NORMAL, *light_features(render)]) for render in renders)
        return (self.plan.reach.results + 2) * bytes_of_pair


def memory_to_average(reach: Reach, window: Window, channels: int, scale: int) -> tuple[int, int]:
    """Return what waits to be averaged, without the pixels of renders that are in memory, and what averaging takes.

    Args:
        reach: neighbours of a frame.
        window: the HRLS's data window.
        channels: of its features.
        scale: of the pair.
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

    Raises:
        InputError: it does not fit. The message says how much does.
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
    counts = [HRLS_FEATURES.get(name, 3) for name in render.features if name in features]
    return sum(counts) + (render.alpha is not None)


def _vector_bytes(render: MappedRender, channels: Sequence[Channel]) -> int:
    return READ_VECTOR_BYTES * len(channels) * render.data_window.width * render.data_window.height


def _pixel_bytes(render: MappedRender, features: Sequence[str]) -> int:
    return render.data_window.width * render.data_window.height * _channels(render, features) * 4
