# SPDX-License-Identifier: Apache-2.0
"""Finds the hops from a frame to its neighbours, and says which neighbours can't be averaged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.motion.shot import ShotMotion
from oiio_msspl.fusion.motion.source import MotionFrame
from oiio_msspl.fusion.neighbours.path import Hop
from oiio_msspl.fusion.neighbours.renders import RenderPair, lacking_passes, shared_noise

F = TypeVar("F", RenderPair, FusedFrame)

#: Frames have the same noise above this correlation. Independent ones stay below 0.1, with little noise below 0.4.
SAME_NOISE = 0.5
SAME_SEED = "have the same noise, which no average removes; let the renderer change its seed from frame to frame"


def find_hops(
    motion: ShotMotion,
    number: int,
    neighbours: Sequence[int],
    frame_of: Callable[[int], tuple[MotionFrame, F]],
    warnings: list[Finding],
) -> list[Hop[F]]:
    """Find the hops from a frame to its neighbours on one side, up to the first that can't be averaged.

    Args:
        motion: between the frames.
        number, neighbours: the frame's number and those of its neighbours, the nearest first.
        frame_of: returns a frame, and its renders or fused picture. If it raises an InputError, the hops end with a
            warning, because the files are the reason, in every run. Any other error is passed on: it may not occur
            again, and the pixels would depend on it.
        warnings: gets a sentence for each problem.
    """
    hops: list[Hop[F]] = []
    own, picture = frame_of(number)
    nearer = own
    for other in neighbours:
        try:
            neighbour, neighbour_picture = frame_of(other)
            _check_alike(own, picture, neighbour, neighbour_picture)
            there, back = motion.between(nearer, neighbour)
            if isinstance(picture, RenderPair) and isinstance(neighbour_picture, RenderPair):
                if nearer is own and shared_noise(picture, neighbour_picture) > SAME_NOISE:
                    text = f"frames {min(number, other)} and {max(number, other)} {SAME_SEED}"
                    warnings.append(Finding("same_seed", text))
                if lacking := " and ".join(lacking_passes(picture, neighbour_picture)):
                    text = f"frame {other} has no set of passes with {lacking}, so passes are not averaged"
                    warnings.append(Finding("passes", text))
        except InputError as error:
            warnings.append(Finding("missing_neighbour", f"frame {other} is not averaged: {error}"))
            break
        hops.append(Hop(neighbour_picture, there, back))
        nearer = neighbour
    return hops


def _check_alike(frame: MotionFrame, picture: F, neighbour: MotionFrame, neighbour_picture: F) -> None:
    """Raise InputError if two frames can't be averaged."""
    scale = neighbour_picture.alignment.scale
    if picture.alignment.scale != scale:
        raise InputError(f"its pair is x{scale}")
    if frame.hr.view != neighbour.hr.view:
        raise InputError(f"its first view is {name_of(neighbour.hr.view)}")
    if frame.hr.display_window.size != neighbour.hr.display_window.size:
        raise InputError(f"its size is {neighbour.hr.display_window.size}")
    if not isinstance(picture, RenderPair):
        return
    for name, own, other in (("LRHS", frame.lr, neighbour.lr), ("HRLS", frame.hr, neighbour.hr)):
        if lacking := _features(own) - _features(other):
            raise InputError(f"its {name} lacks {', '.join(sorted(lacking))}")


def _features(render: MappedRender | None) -> set[str]:
    return set() if render is None else {*render.features, *(["alpha"] if render.alpha else [])}
