# SPDX-License-Identifier: Apache-2.0
"""How much memory the frames of a shot take, and whether their pixels wait in memory, in temporary files, or are read
when their turn comes. All of it follows from the headers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL, RGB, is_light_of_pass
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.reader import Channel
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.tiling import FIXED_MEMORY, TILE_MEMORY, result_bytes
from oiio_msspl.image.arrays import has_many_pixels
from oiio_msspl.jobs.temporal import Temporal

#: Bytes of a pixel for each channel of motion vectors that is read: as stored, decoded, and compared with zero.
READ_VECTOR_BYTES = 12


@dataclass(frozen=True)
class FrameMemory:
    """The memory of a view of a shot, all of whose frames are like this one. All sizes are in bytes."""

    lr: MappedRender
    hr: MappedRender
    """The pair, with the features of its passes if renders are averaged with those of neighbours."""
    features: Sequence[str]
    """What is read of the pair, as far as it has it."""
    temporal: Temporal
    """Which neighbours a frame is averaged with."""
    error: bool
    """Whether the expected error is computed."""
    max_memory: int
    """What the process should stay below."""
    held_by_other_views: int
    """What frames of other views take."""

    @cached_property
    def fits(self) -> bool:
        """Whether there is room for the pixels of all frames that are held, beside a tile and two results."""
        return self._room(self._frames_in_memory) >= 0

    @cached_property
    def on_disk(self) -> bool:
        """Whether renders that wait for their neighbours lie in temporary files: those of large frames that do not fit
        into memory with their motion vectors, and all if other views are averaged, too."""
        if not self.temporal.renders:
            return False
        if self.held_by_other_views:
            return True
        return is_large(self.hr) and self._room(self._frames_held) < _vector_bytes(self.hr, self.motion_channels)

    @cached_property
    def vectors_ahead(self) -> list[Channel]:
        """The motion vectors that are read with the pixels, if they fit beside these. Otherwise they are read later."""
        channels = self.motion_channels
        return channels if _vector_bytes(self.hr, channels) <= self._room(self._frames_in_memory) else []

    @cached_property
    def held(self) -> int:
        """Memory of other frames while one is fused: pixels of the next one, the result of the previous one, and
        neighbours."""
        held = self._result + self._temporal + self.held_by_other_views
        if self.fits:
            held += self._frames_in_memory * self._pair + _vector_bytes(self.hr, self.vectors_ahead)
        return held

    @cached_property
    def waiting(self) -> int:
        """Most memory that the frames of this view take while another view is fused."""
        waiting = self.temporal.waiting(self.hr.data_window, self._hr_channels, self._alignment.scale) + self._averaged
        if self.temporal.renders:  # their pixels wait in temporary files
            return waiting
        return waiting + self._frames_held * self._pair

    def _room(self, frames: int) -> int:
        """Memory that is left beside the pixels of so many frames; negative if they don't fit."""
        other = FIXED_MEMORY + TILE_MEMORY + 2 * self._result + _pixel_bytes(self.lr, self.features)
        other += self._temporal + self.held_by_other_views
        return self.max_memory - other - frames * self._pair

    @property
    def _frames_held(self) -> int:
        """Frames whose pixels are held: the one that is fused, its neighbours, and the next one to come."""
        return 2 * self.temporal.renders + 2

    @property
    def _frames_in_memory(self) -> int:
        return 0 if self.on_disk else self._frames_held

    @cached_property
    def motion_channels(self) -> list[Channel]:
        """The channels of the motion vectors; none if the motion is known otherwise."""
        motion = self.temporal.motion
        return motion.channels(self.hr) if motion else []

    @cached_property
    def _alignment(self) -> Alignment:
        return align(self.lr, self.hr)

    @cached_property
    def _result(self) -> int:
        return result_bytes(self._alignment, error=self.error)

    @cached_property
    def _pair(self) -> int:
        """The pixels of a pair."""
        return sum(_pixel_bytes(render, self.features) for render in (self.lr, self.hr))

    @cached_property
    def _hr_channels(self) -> int:
        return _channels(self.hr, self.features)

    @cached_property
    def _temporal(self) -> int:
        """Averaging, and averaged renders that wait for their passes to be fused."""
        averaging = self.temporal.memory(self.hr.data_window, self._hr_channels, self._alignment.scale)
        return averaging + self._averaged

    @cached_property
    def _averaged(self) -> int:
        """Averaged renders that wait for their passes to be fused."""
        if not light_features(self.hr) or is_large(self.hr):  # large ones wait in temporary files
            return 0
        waiting = self.temporal.results + 2
        both = (self.lr, self.hr)
        return waiting * sum(_pixel_bytes(each, [RGB, ALBEDO, NORMAL, *light_features(each)]) for each in both)


def is_large(hr: MappedRender) -> bool:
    """Whether a frame has so many pixels that what waits of it may lie in temporary files."""
    return has_many_pixels(hr.data_window.height, hr.data_window.width)


def light_features(render: MappedRender) -> list[str]:
    """Features of a render that are the light of passes."""
    return [name for name in render.features if is_light_of_pass(name)]


def _channels(render: MappedRender, features: Sequence[str]) -> int:
    """Channels of the features that a render has of these. Light of passes has three."""
    counts = [HRLS_FEATURES.get(name, 3) for name in render.features if name in features]
    return sum(counts) + (render.alpha is not None)


def _vector_bytes(render: MappedRender, channels: Sequence[Channel]) -> int:
    """Memory of motion vectors while they are read."""
    return READ_VECTOR_BYTES * len(channels) * render.data_window.width * render.data_window.height


def _pixel_bytes(render: MappedRender, features: Sequence[str]) -> int:
    """Bytes of a render's features in memory, those that it has of these."""
    return render.data_window.width * render.data_window.height * _channels(render, features) * 4
