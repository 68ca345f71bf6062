# SPDX-License-Identifier: Apache-2.0
"""Checks a job before its first pixel is read: whether its results can be written, and its layers are there."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.mapping import split_exr
from oiio_msspl.aovs.renderers import file_names
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_folder, check_separate
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.exr.writer import bytes_held
from oiio_msspl.fusion.fuse import check_model
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.jobs.fitting import check_files
from oiio_msspl.jobs.inputs import InputOptions, find_views, map_pair
from oiio_msspl.jobs.memory import check_frame_memory
from oiio_msspl.jobs.passes import check_layers, sets_to_fuse
from oiio_msspl.jobs.sequence import FrameFiles, Shot, frame_in_name
from oiio_msspl.jobs.settings import Settings, choose_model
from oiio_msspl.model.catalogue import family_of, find_model, for_spread_noise
from oiio_msspl.model.contract import Contract

log = logging.getLogger(__name__)


def check_mapped_sequences(frames: Sequence[FrameFiles], inputs: InputOptions) -> None:
    """Raise InputError if a mapping names one file of a sequence for all frames of a shot."""
    numbers = {frame.number for frame in frames}
    for name in file_names(inputs.mapping):
        path = Path(split_exr(name)[0])
        if not path.is_file() or (numbered := frame_in_name(path)) is None:
            continue
        pattern = numbered[0]
        if sum(pattern.path(number).is_file() for number in numbers) > 1:
            raise InputError(
                f"{path}: is one frame of a sequence, and would be read for all frames of the shot; write {pattern}"
            )


def check_output(shot: Shot, *, writable: bool = True) -> None:
    """Raise InputError if the output folder is not there and can't be made, or if files can't be written in it."""
    check_folder(shot.output.path(0) if shot.output.folder.exists() else shot.output.folder, writable=writable)


def model_of_shot(shot: Shot, inputs: InputOptions, model: str | None, *, error: bool = False) -> str:
    """Return the model of all frames. A quality, ``auto`` and None are a family that suits the shot's first pair.

    A warning is logged if a model that is named does not suit the noise. With ``error``, it must predict its error.

    All frames need the same model, also those of other runs and machines. So the first pair is that of the shot, not of
    the frames that are to be fused. A pair that can't be used is passed over, because the run says so when its turn
    comes. So is a pair without noise, such as a black frame.
    """
    family = family_of(model)
    if family is None:
        assert model is not None
        family = model
        if for_spread_noise(model) is None:
            return model  # it suits any noise, or is the user's own
    without_noise: str | None = None
    for number in sorted(shot.lr.files.keys() & shot.hr.files.keys()):
        try:
            lr, hr = map_pair(shot.lr.files[number], shot.hr.files[number], inputs)
            count = len(hr.notes)
            suitable, has_noise = choose_model(lr, hr, model, error=error)
        except MssplError as failure:
            log.debug("frame %d: %s", number, failure)
            continue
        if has_noise:
            for note in hr.notes[count:]:
                log.warning("frame %d: %s", number, note)
            return suitable
        without_noise = without_noise or suitable
    return without_noise or family


def check_no_input(
    shot: Shot, inputs: InputOptions, model: str | None = None, more_targets: Iterable[Path] = ()
) -> None:
    """Raise InputError if a file that is written is one of the shot's inputs, is written twice, or lies among the LRHS.

    The next run would take results in the LRHS's folder for renders.

    All files of both sequences are inputs, whichever frames are to be fused: neighbours and the plan over time are read
    from other frames, and no run may replace the render of a frame.
    """
    pairs = {*shot.lr.files.values(), *shot.hr.files.values()}
    others = [inputs.files(path, model) for path in shot.hr.files.values()]
    folder, low = shot.output.folder, shot.lr.pattern.folder
    if shot.named_as_hr and folder.is_dir() and folder.samefile(low):
        raise InputError(f"{folder}: holds renders that this run reads; name another folder for the results")
    check_separate(pairs.union(*others), [*(path for frame in shot.frames for path in frame.targets), *more_targets])


def check_first_pair(frames: Sequence[FrameFiles], inputs: InputOptions) -> list[str]:
    """Check the first frame that has both renders, before a farm or cluster is asked to fuse all of them.

    Return doubts about it, one sentence each. A pair that can't be read here is a doubt and not an error, because files
    that an option names may exist on the workers only.
    """
    for frame in frames:
        if frame.lr is not None and frame.hr is not None:
            check = check_files(None if frame.lr == frame.hr else frame.lr, frame.hr, inputs)
            problems = [f"can't be checked here: {check.problem}"] if check.problem else []
            return [f"frame {frame.number}: {text}" for text in [*problems, *check.warnings, *check.passed_on]]
    return []


def look_ahead(frames: Sequence[FrameFiles], settings: Settings) -> dict[str, Any] | None:
    """Describe the first pair that can be read by its headers, see :attr:`.ShotReport.found`.

    Raises:
        InputError: there is no such model.
    """
    for frame in frames:
        if frame.lr is None or frame.hr is None:
            continue
        try:
            lr, hr = map_pair(frame.lr, frame.hr, settings.inputs)
            scale = align(lr, hr).scale
            views = [view.hr for view in find_views(lr, hr, settings.inputs, settings.write)[0]]
            sets = {
                additive.name: additive.layer_names for view in views for additive in sets_to_fuse(view, settings.write)
            }
        except InputError as error:  # the run says so when its turn comes
            log.debug("frame %d: %s", frame.number, error)
            continue
        contract = Contract.of_file(find_model(scale, settings.model))
        hr = hr.for_model(contract.hrls)
        found = {"frame": frame.number, "renderer": hr.renderer, "scale": contract.scale, "model": contract.name}
        names = [name_of(view.view) for view in views] if hr.other_views else []
        return found | {"aovs": hr.table(contract.hrls), "notes": hr.notes, "views": names, "sets": sets}
    return None


def check_wanted_outputs(
    frames: Sequence[FrameFiles], inputs: InputOptions, write: WriteOptions, model: str | None, max_memory: int
) -> None:
    """Check on the first pair that can be read that the outputs can be written, before a farm is asked for them."""
    check_mapped_sequences(frames, inputs)
    problem: InputError | None = None
    for frame in frames:
        if frame.lr is None or frame.hr is None:
            continue
        try:
            lr, hr = map_pair(frame.lr, frame.hr, inputs)
            scale = align(lr, hr).scale
            views, _ = find_views(lr, hr, inputs, write)
        except InputError as error:
            if all(path.exists() for path in inputs.files(frame.hr, None)):  # others may exist on the workers only
                problem = problem or error
            continue
        check_layers([view.hr for view in views], write)
        session = Settings(write=write, model=model).session(scale)
        check_model(session, scale, error=write.error_layer)
        layers = bytes_held(hr.file, hr.beauty_channels, write)
        check_frame_memory(align(lr, hr), session, write, max_memory, layers)
        return
    if problem is not None:
        raise problem
