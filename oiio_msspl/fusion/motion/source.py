# SPDX-License-Identifier: Apache-2.0
"""Where do the surfaces of a frame lie in the next and in the previous one?

:func:`find_motion` decides once for a shot, on two frames, how that is known. :meth:`MotionSource.read` then reads it
for any frame and neighbour. The best source comes first:

1. motion vectors whose format two frames have verified;
2. none needed: the camera stands still;
3. the camera's matrices with world-space positions or depth: exact for what does not move itself;
4. optical flow, computed on the fused pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.motion import MotionField, user_fields
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.fusion.motion.camera import Projection, camera_vectors, find_projection
from oiio_msspl.fusion.motion.flow import flow_vectors, has_optical_flow
from oiio_msspl.fusion.motion.formats import FEWEST, MARGIN, FieldCheck, check_field, is_silent
from oiio_msspl.fusion.motion.guides import FramePair, has_guide, open_pair, still_and_moved
from oiio_msspl.fusion.motion.surfaces import other_surfaces
from oiio_msspl.fusion.motion.vectors import channels_to_read, invert, judged_vectors
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.parallel import in_parallel

#: Kinds of sources.
VECTORS, STATIC, CAMERA, FLOW, NONE = "vectors", "static", "camera", "flow", "none"
#: The camera stands still if of all tiles that tell, at most this share has moved: a thing or two may move before it.
STILL = 0.25
#: Rows that are looked at in every frame, to see whether the camera still stands.
LOOK = 256


@dataclass(frozen=True)
class MotionFrame:
    """A frame whose surfaces are followed."""

    hr: MappedRender
    rgb: Array | None = None
    """Fused beauty (h, w, 3) over the data window; only optical flow needs it."""
    vectors: Mapping[int, tuple[Array, Mask]] = field(default_factory=dict)
    """What :meth:`MotionSource.vectors_of` returns, if the frame is in memory."""
    pixels: ReadableRender | None = None
    """Features of the HRLS, if they are in memory, with albedo and normal where it has them."""
    number: int = 0
    """Of the frame in its shot."""
    lr: MappedRender | None = None
    """The LRHS; only :func:`oiio_msspl.fusion.neighbours.hops.find_hops` needs it."""


@dataclass(frozen=True)
class MotionSource:
    """How the movement in a shot is known. :func:`find_motion` makes it."""

    kind: str
    """``vectors``, ``static``, ``camera``, ``flow`` or ``none``."""
    text: str
    """One sentence for the user."""
    fields: tuple[MotionField, ...] = ()
    """``vectors``: verified layers. ``static``: all layers of vectors; a pixel where one is not 0 is not followed."""
    projection: Projection | None = None
    """``camera``: how the matrices are to be read."""
    silent: frozenset[str] = frozenset()
    """``vectors``: axes, ``x`` or ``y``, along which nothing moves in the frames that were looked at. Frames in which
    something does should be looked at, too, see :meth:`tells_more`."""

    def read(self, frame: MotionFrame, neighbour: MotionFrame, step: int) -> tuple[Array, Mask]:
        """Where the surfaces of a frame lie in a neighbour.

        Args:
            frame: frame t.
            neighbour: frame t + ``step``.
            step: 1 or -1.

        Returns:
            Vectors float32 (h, w, 2) over the data window of ``frame``: the surface that pixel (x, y) shows lies at
            (x, y) + vector in the neighbour. In HRLS pixels, x to the right, y down, in coordinates of the display
            window; the place may lie outside the neighbour. And a mask (h, w): where the vector can be believed. Other
            vectors are 0. The mask knows nothing of what hides the surface in the neighbour, unless the vectors were
            inverted.

        Raises:
            InputError: pixels can't be decoded.
            ValueError: the source is optical flow, and a frame has no ``rgb``.
        """
        if self.kind == VECTORS:
            return self._read_vectors(frame, neighbour, step)
        if self.kind == CAMERA and self.projection is not None:
            return camera_vectors(frame.hr, neighbour.hr, self.projection)
        if self.kind == FLOW:
            if frame.rgb is None or neighbour.rgb is None:
                raise ValueError("optical flow needs the fused beauty of both frames")
            return flow_vectors(frame.rgb, neighbour.rgb, frame.hr.data_window, neighbour.hr.data_window)
        vectors, known = _nothing(frame.hr)
        if self.kind == STATIC:
            known[:] = True
            for each in self.fields:  # the camera may move elsewhere in the shot, by vectors that nobody has verified
                if channels := frame.hr.motion.channels(each.layer, each.components):
                    stored = frame.hr.file.read(channels, frame.hr.data_window)
                    known &= (np.abs(stored - np.float32(each.format.offset)) <= 1e-3).all(axis=-1)
            # Vectors that are 0 everywhere may be missing ones: Cycles writes them if motion blur is on.
            if known.all() and not _camera_stands(*still_and_moved(open_pair(frame.hr, neighbour.hr, LOOK))):
                known[:] = False
        return vectors, known

    def zeros_are_right(self, frame: MotionFrame, neighbour: MotionFrame) -> bool:
        """Whether vectors that are 0 everywhere can be believed: False if the picture moves.

        Cycles writes such vectors if motion blur is on, also if other frames of the shot were rendered without it.
        """
        if self.kind != VECTORS:
            return True
        pair = open_pair(frame.hr, neighbour.hr, LOOK)
        return not pair.guides or _camera_stands(*still_and_moved(pair))

    def moved_objects(self, frame: MotionFrame, neighbour: MotionFrame, vectors: Array, known: Mask) -> Mask | None:
        """Where an object has moved that :meth:`read` does not follow, so that both frames show different surfaces.

        (h, w) over the data window of ``frame``. None if the source follows all objects.

        Args:
            vectors, known: what :meth:`read` returns.

        Raises:
            InputError: pixels can't be decoded.
        """
        if self.kind not in (STATIC, CAMERA):
            return None
        both, moves = (frame, neighbour), self.kind == CAMERA
        names = [name for name in (ALBEDO, NORMAL) if all(has_guide(each.hr, name, moves=moves) for each in both)]
        here, there = (each.pixels or each.hr for each in both)
        return other_surfaces(here, there, names, vectors if moves else None, known)

    def tells_more(self, hr: MappedRender) -> bool:
        """Whether something moves in a frame along an axis that is :attr:`silent`.

        Raises:
            InputError: pixels can't be decoded.
        """
        channels = self.channels(hr)
        if not channels:
            return False
        found = self.vectors_of(hr, hr, hr.file.read(channels, hr.data_window))
        for vectors, known in found.values():
            for axis in self.silent:
                lengths = np.sort(np.abs(vectors[..., "xy".index(axis)][known]))[-FEWEST:]
                if len(lengths) == FEWEST and not is_silent(lengths[0]):
                    return True
        return False

    @property
    def reads_one_frame(self) -> bool:
        """Whether :meth:`read` opens the file of ``frame`` alone, so that both ways can be read at the same time."""
        return self.kind == VECTORS and all(self._field(step) is not None for step in (-1, 1))

    def channels(self, hr: MappedRender) -> list[Channel]:
        """The channels of a frame that hold its motion vectors, each pair followed by the alpha if there is one; empty
        without vectors."""
        return [channel for _, channels in self._stored_in(hr) for channel in channels_to_read(hr, channels)]

    def vectors_of(self, hr: MappedRender, pixels: ReadableRender, stored: Array) -> dict[int, tuple[Array, Mask]]:
        """The motion vectors of a frame, for :class:`MotionFrame`, by the step to the frame that they lead to.

        Args:
            hr: the frame.
            pixels: its features.
            stored: its :meth:`channels` (h, w, n).
        """
        layers = self._stored_in(hr)
        parts = np.split(stored, len(layers), axis=-1) if layers else []
        return {
            each.format.step: judged_vectors(hr, part, channels, each.format, pixels)
            for (each, channels), part in zip(layers, parts, strict=True)
        }

    def _stored_in(self, hr: MappedRender) -> list[tuple[MotionField, tuple[Channel, Channel]]]:
        """The verified layers that a frame has, and their channels in it."""
        fields = self.fields if self.kind == VECTORS else ()
        found = [(each, hr.motion.channels(each.layer, each.components)) for each in fields]
        return [(each, channels) for each, channels in found if channels]

    def _read_vectors(self, frame: MotionFrame, neighbour: MotionFrame, step: int) -> tuple[Array, Mask]:
        if self._field(step) is not None:
            return self._vectors(frame, step)
        own, _ = self._vectors(frame, -step)
        other, known = self._vectors(neighbour, -step)
        return invert(own, other, known, frame.hr.data_window, neighbour.hr.data_window)

    def _field(self, step: int) -> MotionField | None:
        return next((each for each in self.fields if each.format.step == step), None)

    def _vectors(self, frame: MotionFrame, step: int) -> tuple[Array, Mask]:
        """The vectors of a frame in one direction."""
        if step in frame.vectors:
            return frame.vectors[step]
        hr = frame.hr
        for each, channels in self._stored_in(hr):
            if each.format.step == step:
                stored = hr.file.read(channels_to_read(hr, channels), hr.data_window)
                return judged_vectors(hr, stored, channels, each.format, hr)
        return _nothing(hr)


def _nothing(render: MappedRender) -> tuple[Array, Mask]:
    window = render.data_window
    return np.zeros((window.height, window.width, 2), np.float32), np.zeros((window.height, window.width), np.bool_)


def find_motion(
    first: MappedRender,
    second: MappedRender,
    wanted: str | None = None,
    verified: Sequence[MotionField] = (),
    *,
    required: bool = False,
) -> MotionSource:
    """Find out how the movement in a shot is known.

    Args:
        first, second: consecutive frames t and t + 1, in which something moves if anything does in the shot.
        wanted: the user's ``--motion-format``, see :func:`oiio_msspl.aovs.motion.user_fields`.
        verified: layers whose format other frames of the shot have shown.
        required: the user wants several frames to be fused, so not to know the movement is an error.

    Raises:
        InputError: pixels can't be decoded; ``wanted`` can't be read or does not fit; or, if ``required``, nothing is
            known of the movement.
    """
    source = _find(first, second, wanted, {each.name: each for each in verified})
    if required and source.kind == NONE:
        raise InputError(f"{first.name}: {source.text}")
    return source


def _find(
    first: MappedRender, second: MappedRender, wanted: str | None, verified: Mapping[str, MotionField]
) -> MotionSource:
    pair = open_pair(first, second)
    if not pair.window.width or not pair.window.height:
        return MotionSource(NONE, f"its data window and that of {second.name} have no common part")
    fields = first.motion.fields if wanted is None else user_fields(first.motion, wanted, first.name)
    both = in_parallel(*(partial(_stored, pair, frame, fields) for frame in (0, 1)))
    checks = []
    for each in fields:
        known = verified.get(each.name)
        stored = both[0].get(each.name), both[1].get(each.name)
        each = replace(each, format=known.format) if known else each
        checks.append(_check(pair, each, stored, verified=known is not None))
    if found := _one_each_way(checks):
        return _vectors(found)
    source = _without_vectors(pair, checks)
    if wanted is not None and source.kind != STATIC:
        raise InputError(f"--motion-format {wanted!r} does not fit {first.name}: {_problems(checks)}")
    return source


def _check(
    pair: FramePair, each: MotionField, stored: tuple[Array | None, Array | None], *, verified: bool
) -> FieldCheck:
    """Verify a layer, or believe the user who has described it completely, unless the pixels contradict.

    Args:
        stored: its vectors in both frames, see :func:`_stored`.
    """
    if stored[0] is None or stored[1] is None:
        return FieldCheck(each, f"{pair.second.name} lacks it")
    check = check_field(pair, each, (stored[0], stored[1]), verified=verified)
    if check.zero or not {"to", "x", "y", "unit"} <= each.fixed:
        return check
    other = check_field(pair, replace(each, fixed=frozenset({"to"})), (stored[0], stored[1]))
    if not other.problem and other.fit * MARGIN < check.fit:
        fits = f"'{other.field.format}' explains {1 - other.fit:.0%} of what changes"
        return replace(check, problem=f"{fits}, and this {max(1 - check.fit, 0):.0%}")
    return replace(check, problem="", by_user=True) if check.problem and check.fit <= 1 else check


def _stored(pair: FramePair, frame: int, fields: Sequence[MotionField]) -> dict[str, Array]:
    """Stored vectors (h, w, 2) of a frame by the name of their layer, not multiplied by alpha. Layers that the frame
    lacks are left out."""
    render = (pair.first, pair.second)[frame]
    found = {each: render.motion.channels(each.layer, each.components) for each in fields}
    layers = {each: channels for each, channels in found.items() if channels is not None}
    alpha = [render.alpha] if render.alpha and any(each.format.premultiplied for each in layers) else []
    every = [*dict.fromkeys(channel for channels in layers.values() for channel in channels), *alpha]
    if not layers:
        return {}
    pixels = pair.read(frame, every)  # one read, because layers of a part are decoded together
    result = {}
    for each, channels in layers.items():
        stored = np.stack([pixels[..., every.index(channel)] for channel in channels], axis=-1)
        if each.format.premultiplied and alpha:
            cover = pixels[..., -1:]
            stored = np.where(cover > 0, stored / np.where(cover > 0, cover, 1), 0).astype(np.float32)
        result[each.name] = stored
    return result


def _one_each_way(checks: Sequence[FieldCheck]) -> list[FieldCheck]:
    """The verified layers: the first to the next frame, and the first to the previous one."""
    found = {check.field.format.step: check for check in reversed(checks) if not check.problem}
    return [check for check in checks if check in found.values()]


def _vectors(verified: Sequence[FieldCheck]) -> MotionSource:
    texts = " and ".join(check.text for check in verified)
    if len(verified) == 1:
        opposite = "previous" if verified[0].field.format.step == 1 else "next"
        texts += f"; vectors to the {opposite} frame are computed by inverting these"
    fields, silent = tuple(check.field for check in verified), frozenset[str]().union(*(c.silent for c in verified))
    return MotionSource(VECTORS, f"motion vectors of {texts}", fields, silent=silent)


def _without_vectors(pair: FramePair, checks: Sequence[FieldCheck]) -> MotionSource:
    """The best source that needs no vectors."""
    still, moved = still_and_moved(pair)
    if _camera_stands(still, moved):
        share = np.count_nonzero(moved) / moved.size
        rest = f"; {share:.0%} of the picture moves or is noisy, and is not followed" if share else ""
        if unclear := [check for check in checks if not check.zero]:
            rest = f"; what moves is not followed: {_problems(unclear)} (describe it with --motion-format)"
        return MotionSource(STATIC, f"the camera stands still{rest}", tuple(check.field for check in checks))
    seen = f"{_problems(checks)}; " if checks else "no motion vectors; "
    if checks and all(check.zero for check in checks) and moved.any():
        seen = f"{_problems(checks)}, though the picture moves (Cycles writes zeros if motion blur is on); "
    if projection := find_projection(pair):
        places = "depth" if projection.depth else "positions"
        text = (
            f"{seen}the camera's matrix {projection.attribute} and {places} say where everything goes that stands still"
        )
        return MotionSource(CAMERA, text, projection=projection)
    if any(not check.zero for check in checks):
        return MotionSource(
            NONE, f"{seen}describe them with --motion-format layer=NAME,to=next,x=right,y=up,unit=pixels"
        )
    if has_optical_flow():
        return MotionSource(FLOW, f"{seen}optical flow is computed on the fused pictures, which is less exact")
    if not pair.guides:
        seen += "no albedo, world-space normal or position that shows whether anything moves; "
    return MotionSource(
        NONE, f"{seen}render motion vectors, or install opencv-python-headless and use --temporal 2 for optical flow"
    )


def _camera_stands(still: Mask, moved: Mask) -> bool:
    count = np.count_nonzero(moved)
    return bool(still.any() and count <= STILL * (count + np.count_nonzero(still)))


def _problems(checks: Sequence[FieldCheck]) -> str:
    return "; ".join(check.text for check in checks)
