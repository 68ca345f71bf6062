# SPDX-License-Identifier: Apache-2.0
"""Finds out how the motion in a shot is known, and reads it.

:func:`find_motion` decides once for a shot, on two frames. :meth:`MotionSource.read` then reads the motion from any
frame to its neighbour. ``docs/guide/shots.md`` lists the sources, the best one first.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender, ReadableRender
from oiio_msspl.aovs.motion import MotionField, MotionFormat, user_fields
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.motion.camera import Projection, camera_vectors, find_projection
from oiio_msspl.fusion.motion.flow import flow_vectors, has_optical_flow
from oiio_msspl.fusion.motion.formats import FEWEST, MARGIN, FieldCheck, check_field, is_silent
from oiio_msspl.fusion.motion.guides import TwoFrames, has_guide, open_frames, still_and_moved
from oiio_msspl.fusion.motion.surfaces import misleads, other_surfaces
from oiio_msspl.fusion.motion.vectors import invert, judged_vectors, no_vectors
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.parallel import in_parallel

#: Kinds of sources.
VECTORS, STATIC, CAMERA, FLOW, NONE = "vectors", "static", "camera", "flow", "none"
#: The camera stands still if at most this share of the tiles has moved: a thing or two may move before it.
STILL = 0.25
#: Rows that are looked at in every frame, to see whether the camera still stands.
LOOK = 256


@dataclass(frozen=True)
class MotionFrame:
    """A frame whose surfaces are followed."""

    hr: MappedRender
    rgb: Array | None = None
    """Fused beauty (h, w, 3) over the data window; only optical flow needs it."""
    vectors: Mapping[int, tuple[Array, Mask]] = dataclasses.field(default_factory=dict)
    """What :meth:`MotionSource.vectors_of` returns, if the frame is in memory."""
    pixels: ReadableRender | None = None
    """Features of the HRLS, if they are in memory, with albedo and normal where it has them."""
    number: int = 0
    """The frame number."""
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

    def read(self, frame: MotionFrame, neighbour: MotionFrame, hop: int) -> tuple[Array, Mask]:
        """Read where the surfaces of a frame are in a neighbour.

        Args:
            frame, neighbour: frames t and t + ``hop``.
            hop: 1 or -1.

        Returns:
            Vectors float32 (h, w, 2) over the data window of ``frame``, in HRLS pixels, x to the right, y down: the
            surface of pixel (x, y) lies at (x, y) + vector in the neighbour, or outside of it. And a mask (h, w): where
            the vector can be believed. Other vectors are 0. Unless the vectors were inverted, the mask does not know
            what hides a surface in the neighbour.

        Raises:
            InputError: pixels can't be decoded.
            ValueError: the source is optical flow, and a frame has no ``rgb``.
        """
        if self.kind == VECTORS:
            if any(field.format.hop == hop for field in self.fields):
                return self._vectors(frame, hop)
            vectors, _ = self._vectors(frame, -hop)
            back, known = self._vectors(neighbour, -hop)
            return invert(vectors, back, known, frame.hr.data_window, neighbour.hr.data_window)
        if self.projection:
            return camera_vectors(frame.hr, neighbour.hr, self.projection)
        if self.kind == FLOW:
            if frame.rgb is None or neighbour.rgb is None:
                raise ValueError("optical flow needs the fused beauty of both frames")
            return flow_vectors(frame.rgb, neighbour.rgb, frame.hr.data_window, neighbour.hr.data_window)
        vectors, known = no_vectors(frame.hr)
        if self.kind == STATIC:
            known[:] = True
            for field in self.fields:  # the camera may move elsewhere in the shot, by vectors that nobody has verified
                if channels := frame.hr.motion.channels(field.layer, field.components):
                    stored = frame.hr.file.read(channels, frame.hr.data_window)
                    known &= (np.abs(stored - np.float32(field.format.offset)) <= 1e-3).all(axis=-1)
            # Vectors that are 0 everywhere may be missing ones: Cycles writes them if motion blur is on.
            if known.all() and not _camera_stands(*still_and_moved(open_frames(frame.hr, neighbour.hr, LOOK))):
                known[:] = False
        return vectors, known

    def zeros_are_right(self, frame: MotionFrame, neighbour: MotionFrame) -> bool:
        """Return whether vectors that are 0 everywhere can be believed: not if the picture moves.

        Cycles writes such vectors if motion blur is on, even if other frames of the shot were rendered without it.
        """
        if self.kind != VECTORS:
            return True
        frames = open_frames(frame.hr, neighbour.hr, LOOK)
        return not frames.guides or _camera_stands(*still_and_moved(frames))

    def misleads(self, frame: MotionFrame, neighbour: MotionFrame, vectors: Array, known: Mask) -> bool:
        """Return whether stored vectors contradict the albedo and the normals of two frames, see :func:`misleads`."""
        return self.kind == VECTORS and misleads(*self._compared(frame, neighbour), vectors, known)

    def moved_objects(self, frame: MotionFrame, neighbour: MotionFrame, vectors: Array, known: Mask) -> Mask | None:
        """Find where an object has moved that :meth:`read` does not follow, so that the frames show other surfaces.

        Return (h, w) over the data window of ``frame``; None if all motion is estimated from the pixels themselves.
        """
        if self.kind == FLOW:
            return None
        return other_surfaces(*self._compared(frame, neighbour), vectors, known, turns=self.kind == VECTORS)

    def _compared(self, frame: MotionFrame, neighbour: MotionFrame) -> tuple[ReadableRender, ReadableRender, list[str]]:
        """Return the features of two frames, and the names of those that a surface keeps."""
        frames, moves = (frame, neighbour), self.kind != STATIC
        names = [name for name in (ALBEDO, NORMAL) if all(has_guide(f.hr, name, moves=moves) for f in frames)]
        here, there = (f.pixels or f.hr for f in frames)
        averaged = [render for render in (here, there) if isinstance(render, Render)]
        return here, there, [name for name in names if all(name in render.layers for render in averaged)]

    def tells_more(self, hr: MappedRender) -> bool:
        """Return whether something moves in a frame along an axis that is :attr:`silent`.

        Raises:
            InputError: pixels can't be decoded.
        """
        lengths = (
            np.abs(vectors[..., "xy".index(axis)][known])
            for vectors, known in self._read_stored(hr).values()
            for axis in self.silent
        )
        return any(len(way) >= FEWEST and not is_silent(np.partition(way, -FEWEST)[-FEWEST]) for way in lengths)

    def channels(self, hr: MappedRender) -> list[Channel]:
        """Return the channels of a frame with its motion vectors, two for each layer and the alpha if there is one."""
        alpha = [hr.alpha] if hr.alpha else []
        return [channel for _, channels in self._stored_in(hr) for channel in (*channels, *alpha)]

    def vectors_of(self, hr: MappedRender, pixels: ReadableRender, stored: Array) -> dict[int, tuple[Array, Mask]]:
        """Return the motion vectors of a frame, for :class:`MotionFrame`: by 1 to the next frame, -1 to the previous.

        Args:
            hr, pixels: the frame and its features.
            stored: its :meth:`channels` (h, w, n).
        """
        layers = self._stored_in(hr)
        return {
            field.format.hop: judged_vectors(hr, part, channels, field.format, pixels)
            for (field, channels), part in zip(layers, np.split(stored, len(layers), axis=-1), strict=True)
        }

    def _stored_in(self, hr: MappedRender) -> list[tuple[MotionField, tuple[Channel, Channel]]]:
        """Return the verified layers that a frame has, and their channels in it."""
        fields = self.fields if self.kind == VECTORS else ()
        layers = [(field, hr.motion.channels(field.layer, field.components)) for field in fields]
        return [(field, channels) for field, channels in layers if channels]

    def _vectors(self, frame: MotionFrame, hop: int) -> tuple[Array, Mask]:
        """Return the vectors that a frame stores in one direction."""
        if hop in frame.vectors:
            return frame.vectors[hop]
        one_way = replace(self, fields=tuple(field for field in self.fields if field.format.hop == hop))
        return one_way._read_stored(frame.hr).get(hop) or no_vectors(frame.hr)

    def _read_stored(self, hr: MappedRender) -> dict[int, tuple[Array, Mask]]:
        channels = self.channels(hr)
        return self.vectors_of(hr, hr, hr.file.read(channels, hr.data_window)) if channels else {}


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
    frames = open_frames(first, second)
    source = MotionSource(NONE, f"its data window and that of {second.name} have no common part")
    if frames.window.width and frames.window.height:
        source = _by_pixels(frames, wanted, {field.name: field.format for field in verified})
    if required and source.kind == NONE:
        raise InputError(f"{first.name}: {source.text}")
    return source


def _by_pixels(frames: TwoFrames, wanted: str | None, verified: Mapping[str, MotionFormat]) -> MotionSource:
    """Find out by the pixels that frames share. Layers are ``verified`` by name."""
    first = frames.renders[0]
    fields = first.motion.fields if wanted is None else user_fields(first.motion, wanted, first.name)
    checks = _checks(frames, fields, verified)
    # Layers of which nothing is known count only if the pixels show that they are vectors.
    for tried in (checks, *([_checks(frames, first.motion.guesses, verified)] if wanted is None else ())):
        # To the next frame, and to the previous one.
        each_way = {check.field.format.hop: check for check in reversed(tried) if not check.problem}
        if each_way:
            return _by_vectors([check for check in tried if check in each_way.values()])
    source = _without_vectors(frames, checks)
    if wanted is not None and source.kind != STATIC:
        raise InputError(f"--motion-format {wanted!r} does not fit {first.name}: {_problems(checks)}")
    return source


def _checks(frames: TwoFrames, fields: Sequence[MotionField], verified: Mapping[str, MotionFormat]) -> list[FieldCheck]:
    """Verify layers by the pixels of both frames."""
    fields = [replace(field, format=verified.get(field.name, field.format)) for field in fields]
    first, second = in_parallel(*(partial(_stored, frames, index, fields) for index in (0, 1)))
    checks = []
    for field in fields:
        if field.name in first and field.name in second:
            stored = first[field.name], second[field.name]
            check = _check(frames, field, stored, verified=field.name in verified)
            checks.append(_try_premultiplied(frames, check, stored))
        else:
            checks.append(FieldCheck(field, f"{frames.renders[1].name} lacks it"))
    return checks


def _check(frames: TwoFrames, field: MotionField, stored: tuple[Array, Array], *, verified: bool) -> FieldCheck:
    """Verify a layer, or believe the user who has described it completely, unless the pixels contradict."""
    check = check_field(frames, field, stored, verified=verified)
    if check.zero or not {"to", "x", "y", "unit"} <= field.fixed:
        return check
    other = check_field(frames, replace(field, fixed=frozenset({"to"})), stored)
    if not other.problem and other.fit * MARGIN < check.fit:
        fits = f"'{other.field.format}' explains {1 - other.fit:.0%} of what changes"
        return replace(check, problem=f"{fits}, and this {max(1 - check.fit, 0):.0%}")
    return replace(check, problem="", by_user=True) if check.problem and check.fit <= 1 else check


def _try_premultiplied(frames: TwoFrames, check: FieldCheck, stored: tuple[Array, Array]) -> FieldCheck:
    """Return the verdict on vectors that are multiplied by alpha, if they fit better where alpha is neither 0 nor 1."""
    field, alphas = check.field, [render.alpha for render in frames.renders if render.alpha]
    if check.zero or field.format.premultiplied or len(alphas) < 2:
        return check
    first, second = (frames.read(index, [alpha]) for index, alpha in enumerate(alphas))
    part, other_part = ((cover > 0) & (cover < 1) for cover in (first, second))
    if min(np.count_nonzero(part), np.count_nonzero(other_part)) < FEWEST:
        return check
    multiplied = replace(field, format=replace(field.format, premultiplied=True))
    divided = _divided(stored[0], first), _divided(stored[1], second)
    none = np.float32(np.nan)
    as_stored, as_divided = (
        check_field(frames, form, (np.where(part, one, none), np.where(other_part, two, none)))
        for form, (one, two) in ((field, stored), (multiplied, divided))
    )
    if as_divided.problem or (not as_stored.problem and as_divided.fit * MARGIN >= as_stored.fit):
        return check
    return check_field(frames, multiplied, divided)


def _divided(vectors: Array, alpha: Array) -> Array:
    """Divide vectors (h, w, 2) by alpha (h, w, 1); 0 where it is 0."""
    return np.where(alpha > 0, vectors / np.where(alpha > 0, alpha, 1), 0).astype(np.float32)


def _stored(frames: TwoFrames, index: int, fields: Sequence[MotionField]) -> dict[str, Array]:
    """Read the stored vectors (h, w, 2) of a frame, by layer, not multiplied by alpha. It may lack some layers."""
    render = frames.renders[index]
    found = ((field, render.motion.channels(field.layer, field.components)) for field in fields)
    layers = [(field, channels) for field, channels in found if channels]
    if not layers:
        return {}
    alpha = [render.alpha] if render.alpha and any(field.format.premultiplied for field, _ in layers) else []
    names = [*dict.fromkeys(channel for _, channels in layers for channel in channels), *alpha]
    pixels = frames.read(index, names)  # one read, because layers of a part are decoded together
    result = {}
    for field, channels in layers:
        result[field.name] = np.stack([pixels[..., names.index(channel)] for channel in channels], axis=-1)
        if field.format.premultiplied and alpha:
            result[field.name] = _divided(result[field.name], pixels[..., -1:])
    return result


def _by_vectors(verified: Sequence[FieldCheck]) -> MotionSource:
    texts = " and ".join(check.text for check in verified)
    if len(verified) == 1:
        opposite = "previous" if verified[0].field.format.hop == 1 else "next"
        texts += f"; vectors to the {opposite} frame are computed by inverting these"
    fields, silent = tuple(check.field for check in verified), frozenset[str]().union(*(c.silent for c in verified))
    return MotionSource(VECTORS, f"motion vectors of {texts}", fields, silent=silent)


def _without_vectors(frames: TwoFrames, checks: Sequence[FieldCheck]) -> MotionSource:
    """Find the best source that needs no vectors."""
    still, moved = still_and_moved(frames)
    if _camera_stands(still, moved):
        share = np.count_nonzero(moved) / moved.size
        rest = f"; {share:.0%} of the picture moves or is noisy, and is not followed" if share else ""
        if unclear := [check for check in checks if not check.zero]:
            rest = f"; what moves is not followed: {_problems(unclear)} (describe it with --motion-format)"
        return MotionSource(STATIC, f"the camera stands still{rest}", tuple(check.field for check in checks))
    guesses = ", ".join(field.name for field in frames.renders[0].motion.guesses)
    unknown = f" (by the pixels {guesses} holds none)" if guesses else ""
    seen = f"{_problems(checks)}; " if checks else f"no motion vectors{unknown}; "
    if checks and all(check.zero for check in checks) and moved.any():
        seen = f"{_problems(checks)}, though the picture moves (Cycles writes zeros if motion blur is on); "
    if projection := find_projection(frames.renders[0]):
        seen += f"the camera's matrix {projection.attribute} and positions say where everything goes that stands still"
        return MotionSource(CAMERA, seen, projection=projection)
    if any(not check.zero for check in checks):
        seen += "describe them with --motion-format layer=NAME,to=next,x=right,y=up,unit=pixels"
        return MotionSource(NONE, seen)
    if has_optical_flow():
        return MotionSource(FLOW, f"{seen}optical flow is computed on the fused pictures, which is less exact")
    if not frames.guides:
        seen += "no albedo, world-space normal or position that shows whether anything moves; "
    seen += "render motion vectors, or install opencv-python-headless and use --temporal 2 for optical flow"
    return MotionSource(NONE, seen)


def _camera_stands(still: Mask, moved: Mask) -> bool:
    count = np.count_nonzero(moved)
    return bool(still.any() and count <= STILL * (count + np.count_nonzero(still)))


def _problems(checks: Sequence[FieldCheck]) -> str:
    return "; ".join(check.text for check in checks)
