# SPDX-License-Identifier: Apache-2.0
"""Checks a shot before its first frame is read: whether results can be written, and which frames to skip."""

from __future__ import annotations

import os

from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_folder, check_target
from oiio_msspl.jobs.sequence import Frame, Shot
from oiio_msspl.jobs.shot_report import FAILED, MISSING, SKIPPED, FrameResult, result_of
from oiio_msspl.jobs.stages import is_left_over


def prepare_output(shot: Shot) -> None:
    """Create the output folder if only the folder itself is missing.

    Raises:
        InputError: the folder can't be created or written to, or a result would replace an input.
    """
    folder = shot.output.folder
    if not folder.exists():
        check_folder(folder)
        folder.mkdir(exist_ok=True)
    check_folder(shot.output.path(0))
    check_no_input(shot)


def check_no_input(shot: Shot) -> None:
    """Raise InputError if a result would replace one of its inputs."""
    for frame in shot.frames:
        for source in (frame.lr, frame.hr):
            if source is not None and source.exists() and frame.output.exists() and frame.output.samefile(source):
                raise InputError(f"{frame.output}: is one of the inputs; write the results elsewhere")


def known_result(frame: Frame, shot: Shot, previews: bool, overwrite: bool, skip_existing: bool) -> FrameResult | None:
    """The result of a frame that need not or can't be fused; None for a frame to fuse.

    Args:
        frame: one of the shot's frames.
        shot: the shot.
        previews, overwrite, skip_existing: as in :func:`oiio_msspl.jobs.shot.fuse_shot`.
    """
    if skip_existing and frame.output.exists():
        return result_of(frame, SKIPPED)
    sources = (("LRHS", frame.lr, shot.lr), ("HRLS", frame.hr, shot.hr))
    lacking = [f"{name} ({sequence.pattern})" for name, path, sequence in sources if path is None]
    if lacking:
        return result_of(frame, MISSING, f"no {' and no '.join(lacking)} of this number", 2)
    if os.path.lexists(frame.output) and not frame.output.is_dir() and not overwrite:
        return result_of(frame, FAILED, "the output exists; pass --skip-existing or --overwrite", 2)
    try:
        check_target(frame.output, overwrite=overwrite)
        if previews:
            png = frame.output.with_suffix(".png")
            check_target(png, overwrite=overwrite or (skip_existing and is_left_over(png)))
    except InputError as error:
        return result_of(frame, FAILED, str(error), error.exit_code)
    return None
