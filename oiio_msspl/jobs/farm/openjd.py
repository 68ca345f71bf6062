# SPDX-License-Identifier: Apache-2.0
"""Describes a shot as an Open Job Description job: a bundle of the job's template and the values of its parameters.

Each task runs ``msspl-fuse`` on a chunk of the frames. Its arguments are a list that no shell reads, so names may
contain spaces and quotes. Paths are job parameters, which a farm can map to its own folders or copy.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_encodable, check_folder, replacing
from oiio_msspl.exr.preview import check_view
from oiio_msspl.jobs.checks import check_no_file, check_no_input, model_of_shot
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.sequence import Shot, find_shot, format_frames, is_sequence
from oiio_msspl.model.catalogue import find_model, shipped_models
from oiio_msspl.model.contract import ONE_SIZE, SCALES, Contract
from oiio_msspl.model.devices import PROVIDERS

#: Seconds between SIGTERM and SIGKILL, in which msspl-fuse finishes the frame that it is writing.
GRACE = 120

#: The most characters that a job parameter may have (Open Job Description 2023-09).
_LONGEST = 1024

#: Files of a bundle. Deadline Cloud prescribes the first two names; ``openjd run`` reads the values from the third.
TEMPLATE, VALUES, OPENJD_VALUES = "template.json", "parameter_values.json", "openjd_values.json"


#: Job parameters of the renders, and what they are. One render is the last one.
_RENDERS = (("LR", "Low-resolution, high-spp renders"), ("HR", "High-resolution, low-spp renders"))


@dataclass(frozen=True)
class Job:
    """A shot described as a job."""

    shot: Shot
    template: dict[str, Any]
    """The Open Job Description template."""
    values: dict[str, Any]
    """The value of each job parameter."""

    @property
    def missing(self) -> list[tuple[str, list[int]]]:
        """The patterns that lack files of the shot, and the frames. Their tasks fail unless the files appear."""
        low = sorted(frame.number for frame in self.shot.frames if frame.lr is None)
        high = sorted(frame.number for frame in self.shot.frames if frame.hr is None)
        sides = {str(self.shot.lr.pattern): low, str(self.shot.hr.pattern): high}
        return [(pattern, numbers) for pattern, numbers in sides.items() if numbers]

    @property
    def existing(self) -> int:
        """Number of frames that have a result already. Their tasks skip them."""
        return sum(frame.output.exists() for frame in self.shot.frames)


def make_job(
    lr: Path | None,
    hr: Path,
    output: Path,
    *,
    frames: str | Iterable[int] | None = None,
    inputs: InputOptions = InputOptions(),
    model: str | None = None,
    map_file: Path | None = None,
    device: str = "cpu",
    view: str | None = None,
    options: Sequence[str] = (),
    chunk: int = 10,
    timeout: int = 1800,
) -> Job:
    """Describe a shot as a job. A mistake that would fail every task is found here.

    Args:
        lr, hr, output, frames: as in :func:`oiio_msspl.jobs.sequence.find_shot`. Frames without a partner are part of
            the job, because the partner may exist when their task runs.
        inputs: the options about the files, to read the first pair.
        model: as in :func:`oiio_msspl.fuse_files`. None and ``auto`` are a family that suits the noise of the first
            pair. The job names it, because all frames of a shot need the same model.
        map_file: TOML file with the user's mapping.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`. It need not be usable on this machine.
        view: None, or the OpenColorIO view of the previews.
        options: more arguments of ``msspl-fuse``, for all frames. They are not checked.
        chunk: frames per task.
        timeout: seconds per frame.

    Returns:
        The shot and its job.

    Raises:
        InputError: a path, a file or an option can't be used, no frame has both renders, or a job can't contain it.
    """
    renders = [path for path in (lr, hr) if path is not None]
    for path in (*renders, output, *([map_file] if map_file else [])):
        check_encodable(path)
    if not any(is_sequence(path) for path in renders):
        raise InputError(f"{renders[0]}: a job is for a shot: give folders, or patterns such as lr.####.exr")
    if device not in PROVIDERS:
        raise InputError(f"--device {device!r}: use one of {', '.join(PROVIDERS)}")
    if view is not None:
        check_view(view)
    options = [*(["--device", device] if device != "cpu" else []), *(["--ocio-view", view] if view else []), *options]
    files = {"--map-file": map_file} if map_file else {}
    shot = find_shot(lr, hr, output, frames)
    # The job names its model: a worker with another version, which would choose another family, then refuses the frame.
    name = model_of_shot(shot, inputs, model)
    if shipped_models().keys() & {name, *(f"{name}-x{scale}" for scale in (ONE_SIZE, *SCALES))}:
        options += ["--model", name]
    else:
        files["--model"] = find_model(SCALES[0], name)
        Contract.of_file(files["--model"])

    if not any(frame.lr and frame.hr for frame in shot.frames):
        raise InputError(f"no frame is in both {shot.lr.pattern} and {shot.hr.pattern}; nothing to submit")
    check_no_input(shot, InputOptions(map_file=map_file), model)
    check_no_file(shot.output.folder)
    folder = shot.output.folder if shot.output.folder.exists() else shot.output.folder.parent
    if not folder.is_dir():
        raise InputError(f"{output}: the folder {folder} does not exist; create it first")
    return _describe(shot, renders, output, options, files, chunk, timeout)


def _describe(
    shot: Shot,
    renders: Sequence[Path],
    output: Path,
    options: Sequence[str],
    files: dict[str, Path],
    chunk: int,
    timeout: int,
) -> Job:
    """Write the job of a shot that was checked. ``files`` are options of ``msspl-fuse`` that name a file."""
    parameters: list[dict[str, Any]] = []
    values: dict[str, Any] = {}

    def add(name: str, value: str | int, description: str, **definition: Any) -> str:
        """Define a job parameter and return the text that stands for its value."""
        if len(str(value)) > _LONGEST:
            raise InputError(f"{name} has more than the {_LONGEST} characters that a job parameter may have: {value}")
        parameters.append({"name": name, "description": description, **definition})
        values[name] = value
        return f"{{{{Param.{name}}}}}"

    def add_sequence(name: str, path: Path, is_folder: bool, what: str, flow: str) -> str:
        """Define two parameters, folder and pattern: a farm can copy a folder, but not a pattern."""
        folder = str((path if is_folder else path.parent).absolute())
        directory = add(f"{name}Folder", folder, what, type="PATH", objectType="DIRECTORY", dataFlow=flow)
        pattern = add(
            f"{name}Name", "" if is_folder else path.name, "Pattern in the folder; empty for all of it", type="STRING"
        )
        return f"{directory}/{pattern}"

    arguments = [
        *(
            add_sequence(name, path, path.is_dir(), what, "IN")
            for (name, what), path in zip(_RENDERS[-len(renders) :], renders, strict=True)
        ),
        "--output",
        add_sequence("Out", output, shot.output.folder == output, "Fused frames", "OUT"),
    ]
    # Open Job Description writes ranges in rising order, and their step with a colon.
    numbers = format_frames(sorted(frame.number for frame in shot.frames)).replace("x", ":")
    frame_range = add("Frames", numbers, "Frames of the shot: 1001-1100 or 1001-1099:2,1200", type="STRING")
    # The time limit of a task is written for so many frames.
    size = add("FramesPerTask", chunk, "Frames per task", type="INT", minValue=1, maxValue=chunk)
    for option, path in files.items():
        name = option.removeprefix("--").title().replace("-", "")
        file = add(name, str(path.absolute()), f"{option} of msspl-fuse", type="PATH", objectType="FILE", dataFlow="IN")
        arguments += [option, file]
    arguments += ["--frames", "{{Task.Param.Frame}}", "--skip-existing", "--progress", "openjd"]
    arguments += map(_literal, options)
    task_frames = {
        "name": "Frame",
        "type": "CHUNK[INT]",
        "range": frame_range,
        "chunks": {"defaultTaskCount": size, "rangeConstraint": "NONCONTIGUOUS"},
    }
    command = {
        "command": "msspl-fuse",
        "args": arguments,
        "timeout": chunk * timeout,
        "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": GRACE},
    }
    step = {
        "name": "Fuse",
        "parameterSpace": {"taskParameterDefinitions": [task_frames]},
        "script": {"actions": {"onRun": command}},
    }
    template = {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": _literal(f"msspl-fuse {shot.hr.pattern.base}")[:128],
        "parameterDefinitions": parameters,
        "steps": [step],
    }
    return Job(shot, template, values)


def write_bundle(folder: Path, job: Job) -> None:
    """Write a new folder from which ``openjd run`` and Deadline Cloud read the job.

    Raises:
        InputError: the folder exists, or its parent is missing or read-only.
        MssplError: the file system refused.
    """
    check_folder(folder)
    try:
        folder.mkdir()
    except FileExistsError as error:
        raise InputError(f"{folder}: exists; name a new folder for the bundle") from error
    except OSError as error:
        raise MssplError(f"{folder}: can't be made ({error.strerror})") from error
    for_deadline = {"parameterValues": [{"name": name, "value": value} for name, value in job.values.items()]}
    try:
        for name, content in ((VALUES, for_deadline), (OPENJD_VALUES, job.values), (TEMPLATE, job.template)):
            with replacing(folder / name) as temporary:
                temporary.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _literal(text: str) -> str:
    """Return text that a template takes as it is. Two braces are refused, because they can't be escaped in it."""
    if "{{" in text:
        raise InputError(f"{text!r}: a job template takes '{{{{' for the start of a parameter")
    return text
