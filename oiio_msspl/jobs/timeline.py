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
        self._wanted = list(wanted)
        self._read: set[int] = set()
        self._fused: set[Key] = set()
        most = max(own.frames for own in reach.values())
        pictures = [{n for w in wanted for n in (w, *neighbours(w, own.results, shot))} for own in reach.values()]
        numbers = dict.fromkeys(wanted) if most == 0 else sorted(set().union(*pictures))
        self._unfused: list[Key] = [
            (n, view) for n in numbers for view, own in zip(reach, pictures, strict=True) if n in own
        ]
        self.order = list(numbers)
        """The frames to read, in this order: those to write, and all that these depend on."""
        if most:
            self.order = sorted({n for w in wanted for n in (w, *neighbours(w, most, shot))})

    def around(self, key: Key, kind: str) -> list[int]:
        """Return the neighbours of a frame whose ``"renders"`` or ``"results"`` are averaged with its own."""
        number, view = key
        return neighbours(number, getattr(self._reach[view], kind), self._shot)

    def sides(self, key: Key, kind: str) -> tuple[list[int], list[int]]:
        """Return these neighbours before and after a frame, the nearest first."""
        numbers = self.around(key, kind)
        return [n for n in numbers if n < key[0]][::-1], [n for n in numbers if n > key[0]]

    def waits(self, number: int) -> bool:
        """Return whether a frame is still to be settled."""
        return number in self._wanted

    def fusable(self, number: int) -> Iterator[Key]:
        """Take a frame that is read, and yield what can be fused now."""
        self._read.add(number)
        for key in list(self._unfused):
            if self._read.issuperset((key[0], *self.around(key, "renders"))):
                yield key

    def fused(self, key: Key) -> None:
        """Take a frame that is fused, or that has failed."""
        self._unfused.remove(key)
        self._fused.add(key)

    def settled(self) -> Iterator[int]:
        """Yield the frames to write whose views and neighbours are fused, each once."""
        for number in list(self._wanted):
            keys = [(number, view) for view in self._reach]
            if all(self._fused.issuperset((key, *self._pictures_of(key))) for key in keys):
                self._wanted.remove(number)
                yield number

    def _pictures_of(self, key: Key) -> list[Key]:
        return [(number, key[1]) for number in self.around(key, "results")]

    def needs_renders(self) -> set[Key]:
        """Return the frames whose renders a frame needs that is still to be fused."""
        return {(n, key[1]) for key in self._unfused for n in (key[0], *self.around(key, "renders"))}

    def needs_pictures(self) -> set[Key]:
        """Return the frames whose fused pictures a frame needs that is still to be written."""
        keys = [(number, view) for number in self._wanted for view in self._reach]
        return {needed for key in keys for needed in (key, *self._pictures_of(key))}
