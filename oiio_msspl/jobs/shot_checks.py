# SPDX-License-Identifier: Apache-2.0
"""Checks a shot before its first frame is read: whether results can be written, and which frames to skip."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_folder, check_separate, check_target, make_folder
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.fuse import check_model
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.jobs.frame_checks import check_frame_memory, check_written_layers, require_outputs
from oiio_msspl.jobs.frame_passes import check_passes
from oiio_msspl.jobs.inputs import InputOptions, map_pair
from oiio_msspl.jobs.model_choice import choose_model
from oiio_msspl.jobs.pair_check import check_files
from oiio_msspl.jobs.sequence import Frame, Shot
from oiio_msspl.jobs.shot_report import FAILED, MISSING, SKIPPED, FrameResult, older_than, result_of
from oiio_msspl.jobs.stages import Stages
from oiio_msspl.jobs.temporal import TemporalOptions, plan_temporal
from oiio_msspl.jobs.views import find_other_views
from oiio_msspl.model.catalogue import family_of, for_spread_noise, load_model

log = logging.getLogger(__name__)


def check_output(shot: Shot, inputs: InputOptions, model: str | None, more_targets: Iterable[Path]) -> None:
    """Check that results can be written. The output folder itself may be missing, see :func:`make_output`.

    Args:
        shot: the shot.
        inputs, model: what all frames are made from, beside their pairs.
        more_targets: what is written beside the frames.

    Raises:
        InputError: the folder can't be written to, or a result would replace an input.
    """
    folder = shot.output.folder
    check_no_file(folder)
    check_folder(shot.output.path(0) if folder.exists() else folder)
    check_no_input(shot, inputs, model, more_targets)


def make_output(shot: Shot) -> None:
    """Create the output folder if it is missing.

    Raises:
        InputError: it can't be created.
    """
    make_folder(shot.output.folder)
    check_folder(shot.output.path(0))


def check_no_file(folder: Path) -> None:
    """Raise InputError if an output folder, or the one that it is to be made in, is a file."""
    for each in (folder, folder.parent):
        if each.exists() and not each.is_dir():
            raise InputError(f"{each}: is a file, and the results of a shot need a folder; name another output")


def model_of_shot(shot: Shot, inputs: InputOptions, model: str | None) -> str:
    """The model of all frames: a quality, ``auto`` and None are a family that suits the shot's first pair. A warning is
    logged if a model that is named does not suit its noise.

    All frames need the same model, also those of other runs and machines. So the first pair is that of the shot, and
    not of the frames that are to be fused. A pair that can't be used is passed over, because the run says so when its
    turn comes. So is one without noise, such as a black frame.
    """
    family = family_of(model)
    if family is None:
        assert model is not None
        family = model
        if for_spread_noise(model) is None:
            return model  # it suits any noise, or is no model of ours
    without_noise: str | None = None
    for number in sorted(shot.lr.files.keys() & shot.hr.files.keys()):
        try:
            lr, hr = map_pair(shot.lr.files[number], shot.hr.files[number], inputs)
            known = len(hr.notes)
            suitable, told = choose_model(lr, hr, model)
            if not told:
                without_noise = without_noise or suitable
                continue
            for note in hr.notes[known:]:
                log.warning("frame %d: %s", number, note)
            return suitable
        except MssplError as error:
            log.debug("frame %d: %s", number, error)
    return without_noise or family


def check_no_input(
    shot: Shot, inputs: InputOptions, model: str | None = None, more_targets: Iterable[Path] = ()
) -> None:
    """Raise InputError if a file that is written is one of the shot's inputs, or is written twice.

    All files of both sequences are inputs, whichever frames are to be fused: their neighbours and the plan over time
    are read from others, and no run may replace the render of another frame.
    """
    pairs = {*shot.lr.files.values(), *shot.hr.files.values()}
    others = [inputs.files(path, model) for path in shot.hr.files.values()]
    check_separate(pairs.union(*others), [*(path for frame in shot.frames for path in frame.targets), *more_targets])


def check_first_pair(frames: Sequence[Frame], inputs: InputOptions) -> list[str]:
    """Check the first frame that has both renders, before a farm or cluster is asked to fuse all of them.

    Returns:
        Doubts about it, one sentence each. A pair that can't be read here is one of them, and no error, because files
        that an option names may exist on the workers only.
    """
    for frame in frames:
        if frame.lr is not None and frame.hr is not None:
            check = check_files(frame.lr, frame.hr, inputs)
            problems = [] if check.problem is None else [f"can't be checked here: {check.problem}"]
            return [f"frame {frame.number}: {text}" for text in [*problems, *check.warnings, *check.passed_on]]
    return []


def check_wanted_outputs(
    frames: Sequence[Frame], inputs: InputOptions, write: WriteOptions, model: str | None, max_memory: int
) -> None:
    """Check on the first pair that can be read whether what is to be written can be, before a farm is asked for it.

    Raises:
        InputError: no pair can be read, a layer or a set of passes that an option names is not there, the layout can't
            hold the layers, the model is for another scale or does not make a layer, or ``max_memory`` bytes are too
            few.
    """
    problem: InputError | None = None
    for frame in frames:
        if frame.lr is None or frame.hr is None:
            continue
        try:
            lr, hr = map_pair(frame.lr, frame.hr, inputs)
            scale = align(lr, hr).scale
            others = find_other_views(lr, hr, inputs, write)
        except InputError as error:
            if all(path.exists() for path in inputs.files(frame.hr, None)):  # or they may exist on the workers only
                problem = problem or error
            continue
        check_written_layers(hr, write)
        check_passes([hr, *others.hrls], write)
        session = load_model(scale, model)
        check_model(session, scale, error=write.error_layer)
        require_outputs(session, write)
        check_frame_memory(lr, hr, session, write, max_memory)
        return
    if problem is not None:
        raise problem


def check_temporal(
    shot: Shot, inputs: InputOptions, options: TemporalOptions, model: str | None, write: WriteOptions
) -> None:
    """Check whether the shot can be averaged over time as the user asks, before a farm is asked for it.

    If files of the mapping are not here, nothing is checked: they may exist on the workers only.

    Raises:
        InputError: see :func:`oiio_msspl.jobs.temporal.plan_temporal`.
    """
    if all(path.exists() for hr in shot.hr.files.values() for path in inputs.files(hr, None)):
        plan_temporal(shot, inputs, options, model, write)


def known_result(frame: Frame, shot: Shot, stages: Stages) -> FrameResult | None:
    """The result of a frame that need not or can't be fused; None for a frame to fuse.

    Args:
        frame: one of the shot's frames.
        shot: the shot.
        stages: their settings.
    """
    if stages.skips(frame):
        newer = stages.newer_inputs(frame.lr, frame.hr, frame.output)
        warnings = [older_than(newer[0])] if newer else []
        return result_of(frame, SKIPPED, warnings=warnings)
    sources = (("LRHS", frame.lr, shot.lr), ("HRLS", frame.hr, shot.hr))
    lacking = [f"{name} ({sequence.pattern})" for name, path, sequence in sources if path is None]
    if lacking:
        return result_of(frame, MISSING, f"no {' and no '.join(lacking)} of this number", 2)
    overwrite = stages.replaces(frame.lr, frame.hr, frame.output)
    if frame.output.is_symlink() and not frame.output.exists() and not overwrite:
        return result_of(frame, FAILED, "the output is a link to a file that does not exist; delete the link", 2)
    if frame.output.exists() and not frame.output.is_dir() and not overwrite:
        return result_of(frame, FAILED, "the output exists; pass --skip-existing or --overwrite", 2)
    try:
        check_target(frame.output, overwrite=overwrite)
        if frame.preview is not None:
            check_target(frame.preview, overwrite=stages.replaces_preview(frame.preview))
    except InputError as error:
        return result_of(frame, FAILED, str(error), error.exit_code)
    return None
