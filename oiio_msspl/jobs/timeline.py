# SPDX-License-Identifier: Apache-2.0
"""Who needs whom in a shot, what can be fused now, and what can be forgotten. Only numbers: no files and no pixels.

The renders of a frame are averaged with those of its neighbours, then it is fused. Its fused picture is averaged with
those of its neighbours, then the frame is settled and can be written.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

#: A frame number and a view. The first view of a file is None.
Key = tuple[int, str | None]


class Reach(NamedTuple):
    """How many neighbours a view is averaged with, on each side of a frame."""

    renders: int = 0
    """Neighbours whose renders are averaged before fusing."""
    results: int = 0
    """Neighbours whose fused pictures are averaged after fusing."""

    @property
    def frames(self) -> int:
        """Frames on each side that a frame depends on."""
        return self.renders + self.results


ALONE = Reach()


def neighbours(number: int, count: int, shot: Collection[int]) -> list[int]:
    """Return the frames up to ``count`` before and after a frame, in order, without those behind a missing frame."""
    numbers: list[int] = []
    for direction in (-1, 1):
        for offset in range(1, count + 1):
            if number + direction * offset not in shot:
                break
            numbers.append(number + direction * offset)
    return sorted(numbers)


class Timeline:
    """The frames of a shot on their way from being read to being written.

    Args:
        shot: all frames that have both renders.
        wanted: the frames to write. Frames without neighbours are read in this order, others by their numbers.
        reach: neighbours of each view that is fused by itself; the first view is None. The views of a frame that
            depend on the most frames decide when it is read.
    """

    def __init__(self, shot: Collection[int], wanted: Sequence[int], reach: Mapping[str | None, Reach]) -> None:
        self._shot, self._reach = shot, reach
        self._read: set[int] = set()
        self._fused: set[Key] = set()
        #: The frames to write, each with the frames whose fused pictures it needs: its views and their neighbours.
        self._unsettled = {
            number: {(n, view) for view, own in reach.items() for n in (number, *neighbours(number, own.results, shot))}
            for number in wanted
        }
        keys = self.needs_pictures()
        most = max(own.frames for own in reach.values())
        numbers = list(dict.fromkeys(wanted)) if most == 0 else sorted({number for number, _ in keys})
        #: The frames to fuse, each with the frames whose renders it needs: itself and its neighbours.
        self._unfused = {
            (number, view): {(n, view) for n in (number, *neighbours(number, own.renders, shot))}
            for number in numbers
            for view, own in reach.items()
            if (number, view) in keys
        }
        self.order = numbers
        """The frames to read, in this order: those to write, and all that these depend on."""
        if most:
            self.order = sorted({n for w in wanted for n in (w, *neighbours(w, most, shot))})

    def sides(self, key: Key, kind: str) -> tuple[list[int], list[int]]:
        """Return the neighbours before and after a frame whose "renders" or "results" are averaged with its own.

        The nearest comes first.
        """
        numbers = neighbours(key[0], getattr(self._reach[key[1]], kind), self._shot)
        return [n for n in numbers if n < key[0]][::-1], [n for n in numbers if n > key[0]]

    def waits(self, number: int) -> bool:
        """Return whether a frame is still to be settled."""
        return number in self._unsettled

    def fusable(self, number: int) -> Iterator[Key]:
        """Take a frame that is read, and yield what can be fused now."""
        self._read.add(number)
        for key, needed in list(self._unfused.items()):
            if self._read.issuperset(n for n, _ in needed):
                yield key

    def fused(self, key: Key) -> None:
        """Take a frame that is fused, or that has failed."""
        del self._unfused[key]
        self._fused.add(key)

    def settled(self) -> Iterator[int]:
        """Yield the frames to write whose views and neighbours are fused, each once."""
        for number, needed in list(self._unsettled.items()):
            if self._fused.issuperset(needed):
                del self._unsettled[number]
                yield number

    def needs_renders(self) -> set[Key]:
        """Return the frames whose renders a frame needs that is still to be fused."""
        return set().union(*self._unfused.values())

    def needs_pictures(self) -> set[Key]:
        """Return the frames whose fused pictures a frame needs that is still to be written."""
        return set().union(*self._unsettled.values())
