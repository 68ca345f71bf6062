# SPDX-License-Identifier: Apache-2.0
"""A frame of a shot on its way from its files to its result, one record for each view."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import IntEnum

from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.errors import InputError, MssplError, explain
from oiio_msspl.exr.render import Render
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.motion.source import MotionFrame
from oiio_msspl.fusion.neighbours.renders import RenderPair
from oiio_msspl.fusion.passes.layers import is_large, layer_names, lrhs_names, with_light
from oiio_msspl.image.arrays import Array, Mask, kept
from oiio_msspl.jobs.memory import ViewMemory
from oiio_msspl.jobs.passes import Progress, sets_to_fuse
from oiio_msspl.jobs.plan import ViewPlan
from oiio_msspl.jobs.report import FrameReport
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.timeline import Key
from oiio_msspl.model.session import Session


class State(IntEnum):
    """How far a frame has come."""

    FOUND = 0
    """Its files are known."""
    READ = 1
    """Its pair is open and mapped. Its pixels are in memory, if there is room."""
    AVERAGED = 2
    """Its renders are averaged with those of its neighbours."""
    FUSED = 3
    """The network has fused it."""
    SETTLED = 4
    """Its picture is averaged with those of its neighbours, and its passes are fused."""
    WRITTEN = 5
    """Its EXR is on the disk."""


class NoSuchView(InputError):
    """A frame lacks a view that other frames of the shot have."""


@dataclass(eq=False)
class ShotFrame:
    """One view of a frame. ``state`` says which of its attributes are set."""

    files: FrameFiles
    view: str | None = None
    """The name of a view beside the first one; None for the first one, whose name may differ from frame to frame."""
    plan: ViewPlan = field(default_factory=ViewPlan)
    state: State = State.FOUND
    error: Exception | None = None
    """Why it did not come further."""
    warnings: list[Finding] = field(default_factory=list)
    """What is wrong with its neighbours, one sentence each."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time by what it was spent on: ``read`` and ``fuse``."""

    # From READ on
    lr: MappedRender = field(init=False)
    hr: MappedRender = field(init=False)
    stored: tuple[MappedRender, MappedRender] = field(init=False)
    """The pair as files, with the light of its passes if renders are averaged with those of neighbours."""
    renders: RenderPair = field(init=False)
    """What is averaged and fused: pixels in memory, or ``stored``."""
    write: WriteOptions = field(init=False)
    """What is written of this view."""
    memory: ViewMemory | None = None
    """The budget of this view's frames; None if there is only one frame."""
    vectors: Mapping[int, tuple[Array, Mask]] = field(default_factory=dict)
    """Motion vectors that were read with the pixels, see :class:`oiio_msspl.fusion.motion.source.MotionFrame`."""
    others: list[ShotFrame] = field(default_factory=list)
    """Of the first view: the views without neighbours, which are fused before it."""
    passed_on: tuple[str, ...] = ()
    """Of the first view: why further views are not fused, one sentence each."""

    # From AVERAGED on
    averaged: RenderPair = field(init=False)
    """The means over neighbours; ``renders`` if there are none. Given up when the frame is fused."""
    means: tuple[Render, Render] | None = None
    """What passes are fused from of both means; None if there are no neighbours, or no passes to fuse."""
    frame_counts: Array | None = None
    """(h, w, 1): how many frames each pixel is the mean of; None if there are no neighbours."""

    session: Session = field(init=False)
    """The model for the scale of the pair."""

    # From FUSED on
    fused: FusedFrame | None = None
    """As the network fused it, for as long as a frame needs it."""
    replaced: ReplacedChannels | None = None
    """Of the first view: the channels of other views, fused."""

    progress: Progress | None = None
    """Joins the progress of the parts of the work, if somebody wants to know it."""

    # From SETTLED on
    picture: FusedFrame | None = None
    """What is written, until it is."""
    report: FrameReport = field(init=False)
    """On this view; that of the first view is about all views."""

    @property
    def number(self) -> int:
        """The frame number."""
        return self.files.number

    @property
    def key(self) -> Key:
        """What a timeline knows this frame by."""
        return self.files.number, self.view

    @property
    def held_bytes(self) -> int:
        """Memory of other frames while this one is fused."""
        return self.memory.held if self.memory else 0

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """Keep an exception of the block as the frame's error, so that other frames go on."""
        try:
            yield
        except Exception as error:
            traceback.clear_frames(error.__traceback__)  # or they would keep pixels
            self.error = error

    def require(self) -> None:
        """Raise what went wrong with this frame."""
        if self.error is not None:
            raise self.error

    def require_state(self, state: State) -> None:
        """Raise why this frame has not come so far that a neighbour can be averaged with it.

        Raises:
            InputError: its files can't be used, so it is left out in every run.
            MssplError: it has failed otherwise, such as for a full disk. Without it, the neighbour would have other
                pixels than in another run.
        """
        if self.state >= state:
            return
        assert self.error is not None
        if isinstance(self.error, InputError):
            raise self.error
        raise MssplError(f"frame {self.number}, its neighbour, has failed: {explain(self.error)[0]}") from self.error

    def read_if_small(self) -> RenderPair:
        """Return the renders. Those of a small frame are decoded once, with the passes to fuse, into memory.

        Raises:
            InputError: pixels can't be decoded.
        """
        if self.renders.hr is self.stored[1] and not is_large(self.hr):
            sets = sets_to_fuse(self.hr, self.write)
            high = _loaded(with_light(self.hr, layer_names(sets)))
            low = high if self.lr is self.hr else _loaded(with_light(self.lr, lrhs_names(self.lr, sets)))
            self.renders = RenderPair(low, high)
        return self.renders

    def motion_frame(self) -> MotionFrame:
        """Return what is needed to follow its surfaces."""
        rgb = None if self.fused is None else self.fused.rgb
        return MotionFrame(self.hr, rgb, self.vectors, self.renders.hr, self.number, self.lr)

    def keep_result(self) -> None:
        """Let the fused picture wait for its neighbours, in a temporary file if it is large."""
        fused = self.fused
        assert fused is not None
        fused.rgb = kept(fused.rgb)
        fused.alpha = None if fused.alpha is None else kept(fused.alpha)
        fused.error = None if fused.error is None else kept(fused.error)

    def forget_pixels(self) -> None:
        """Give up the pixels of the renders. The files can still be read."""
        self.renders = RenderPair(*self.stored)

    def forget_all_but_picture(self) -> None:
        """Give up what only this frame's own result needs."""
        self.means = self.frame_counts = None
        if self.fused is not None:
            self.fused = replace(self.fused, clean_aovs={}, error=None, frames=None)


def _loaded(render: MappedRender) -> Render:
    """Read the features of a render, with its alpha."""
    return render.load([*render.features, "alpha"])
