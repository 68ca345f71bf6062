# SPDX-License-Identifier: Apache-2.0
"""Describes a shot as an Open Job Description job: a bundle of the job's template and the values of its parameters.

Each task runs ``msspl-fuse`` on a chunk of the frames. Its arguments are a list that no shell reads, so names may
contain spaces and quotes. Paths are job parameters, which a farm can map to its own folders or copy. A task that runs
again keeps the frames that are newer than their inputs, and fuses the others.
"""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_encodable, check_folder, make_folder, replacing
from oiio_msspl.exr.preview import check_view
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY
from oiio_msspl.jobs.checks import check_no_input, check_output, model_of_shot
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.sequence import Shot, find_shot, format_frames, is_sequence
from oiio_msspl.jobs.settings import bytes_of
from oiio_msspl.model.catalogue import find_model, shipped_models
from oiio_msspl.model.contract import ONE_SIZE, SCALES, Contract
from oiio_msspl.model.devices import PROVIDERS

#: Seconds between SIGTERM and SIGKILL, in which msspl-fuse finishes the frame that it is writing.
GRACE = 120

#: Devices that a farm counts as GPUs.
GPUS = ("cuda", "tensorrt", "directml")
#: Names of the job parameters by which the environments of a farm's queue install packages, by option.
PACKAGES = {"conda": "CondaPackages", "rez": "RezPackages"}
#: The most characters that the name of a job, and a job parameter, may have (Open Job Description 2023-09).
_LONGEST_NAME, _LONGEST = 128, 1024
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
        """Number of frames that have a result already. Their tasks skip them, unless an input is newer."""
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
    previews: bool = False,
    max_memory: int | str = MAX_MEMORY,
    options: Sequence[str] = (),
    chunk: int = 10,
    timeout: int = 1800,
    name: str | None = None,
    command: str = "msspl-fuse",
    packages: Mapping[str, str] = {},
) -> Job:
    """Describe a shot as a job. A mistake that would fail every task is found here.

    Args:
        lr, hr, output, frames: as in :func:`oiio_msspl.jobs.sequence.find_shot`. Frames without a partner are part of
            the job, because the partner may exist when their task runs.
        inputs: the options about the files, to read the first pair.
        model: as in :func:`oiio_msspl.fuse_files`. None and ``auto`` are a family that suits the noise of the first
            pair. The job names it, because all frames of a shot need the same model.
        map_file: TOML file with the user's mapping.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`. It need not be usable on this machine. A worker
            needs a GPU for one of ``GPUS``.
        view: None, or the OpenColorIO view of the previews.
        previews: write a PNG beside each EXR.
        max_memory: bytes that a task should stay below, also as ``4G``. A worker needs as much.
        options: more arguments of ``msspl-fuse``, for all frames. They are not checked.
        chunk: frames per task.
        timeout: seconds per frame.
        name: the job's name; None for the last folders and the name of the renders, and the frames.
        command: the program on the workers, or a launcher with its arguments: ``rez env oiio_msspl -- msspl-fuse``.
        packages: ``conda`` or ``rez`` and the packages that the environment of a farm's queue installs.

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
    memory = bytes_of(max_memory)
    common = ["--device", device] if device != "cpu" else []
    common += ["--ocio-view", view] if view else []
    common += [] if previews else ["--no-preview"]
    common += [] if memory == MAX_MEMORY else ["--max-memory", str(max_memory)]
    options = [*common, *options]
    files = {"--map-file": map_file} if map_file else {}
    shot = find_shot(lr, hr, output, frames)
    # The job names its model: a worker with another version, which would choose another family, then refuses the frame.
    family = model_of_shot(shot, inputs, model, error="--error-layer" in options)
    if shipped_models().keys() & {family, *(f"{family}-x{scale}" for scale in (ONE_SIZE, *SCALES))}:
        options += ["--model", family]
    else:
        files["--model"] = find_model(SCALES[0], family)
        Contract.of_file(files["--model"])

    if not any(frame.lr and frame.hr for frame in shot.frames):
        raise InputError(f"no frame is in both {shot.lr.pattern} and {shot.hr.pattern}; nothing to submit")
    check_no_input(shot, InputOptions(map_file=map_file), model)
    check_output(shot, writable=False)
    job = Job(shot, {"parameterDefinitions": []}, {})
    arguments = [
        _add_sequence(job, name, path, path.is_dir(), what, "IN")
        for (name, what), path in zip(_RENDERS[-len(renders) :], renders, strict=True)
    ]
    arguments += ["--output", _add_sequence(job, "Out", output, shot.named_as_hr, "Fused frames", "OUT")]
    # Open Job Description writes ranges in rising order, and their step with a colon.
    numbers = format_frames(sorted(frame.number for frame in shot.frames))
    said = "Frames of the shot: 1001-1100 or 1001-1099:2,1200"
    frame_range = _add(job, "Frames", numbers.replace("x", ":"), said, "LINE_EDIT", "Frames", type="STRING")
    # The time limit of a task is written for so many frames.
    limits = {"type": "INT", "minValue": 1, "maxValue": chunk}
    size = _add(job, "FramesPerTask", chunk, "Frames per task", "SPIN_BOX", "Frames per task", **limits)
    for option, path in files.items():
        label = option.removeprefix("--")
        title, said, choose = label.title().replace("-", ""), f"{option} of msspl-fuse", _path("FILE", "IN")
        arguments += [option, _add(job, title, str(path.absolute()), said, "CHOOSE_INPUT_FILE", label, **choose)]
    arguments += ["--frames", "{{Task.Param.Frame}}", "--update", "--progress", "openjd", *map(_literal, options)]
    for manager, wanted in packages.items():
        if manager not in PACKAGES:
            raise InputError(f"packages of {manager!r}: use one of {', '.join(PACKAGES)}")
        said = "Packages that the environment of the queue installs"
        _add(job, PACKAGES[manager], wanted, said, "LINE_EDIT", f"{manager.title()} packages", type="STRING")
    chunks = {"defaultTaskCount": size, "rangeConstraint": "NONCONTIGUOUS"}
    task_frames = {"name": "Frame", "type": "CHUNK[INT]", "range": frame_range, "chunks": chunks}
    amounts = [{"name": "amount.worker.memory", "min": -(-memory // 2**20)}]  # MiB, as much as a task may take
    if device in GPUS:
        amounts.append({"name": "amount.worker.gpu", "min": 1})
    job.template.update(
        specificationVersion="jobtemplate-2023-09",
        extensions=["TASK_CHUNKING"],
        name=_literal(name or _name_of(shot))[:_LONGEST_NAME],
        steps=[_step([*_words_of(command), *arguments], chunk * timeout, task_frames, amounts)],
    )
    return job


def _step(
    words: Sequence[str], seconds: int, task_frames: dict[str, Any], amounts: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Describe the step that fuses the frames of a task by a program and its arguments, in so many seconds."""
    action = {
        "command": words[0],
        "args": list(words[1:]),
        "timeout": seconds,
        "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": GRACE},
    }
    return {
        "name": "Fuse",
        "parameterSpace": {"taskParameterDefinitions": [task_frames]},
        "hostRequirements": {"amounts": amounts},
        "script": {"actions": {"onRun": action}},
    }


def _name_of(shot: Shot) -> str:
    """Name a job after its renders and frames: the last folders say the shot, and file names alone rarely do."""
    pattern = shot.hr.pattern
    names = [*pattern.folder.absolute().parts[1:][-3:], pattern.base.rstrip("._-")]
    frames = format_frames(sorted(frame.number for frame in shot.frames))
    return f"msspl-fuse {'/'.join(name for name in names if '{{' not in name)} {frames}"


def _words_of(command: str) -> list[str]:
    """Return the program and the arguments of a command, as a shell takes it apart."""
    try:
        words = [_literal(word) for word in shlex.split(command)]
    except ValueError as error:
        raise InputError(f"--command {command!r}: can't be read ({error}); quote it as for a shell") from error
    if not words:
        raise InputError("--command: is empty; name msspl-fuse, or what starts it")
    return words


def _add(job: Job, name: str, value: str | int, description: str, control: str, label: str, **definition: Any) -> str:
    """Define a job parameter with its widget and label, and return the text that stands for its value."""
    if len(str(value)) > _LONGEST:
        raise InputError(f"{name} has more than the {_LONGEST} characters that a job parameter may have: {value}")
    group = "Software" if name in ("Model", *PACKAGES.values()) else "Shot"
    widget = {"control": control, "label": label, "groupLabel": group}
    parameter = {"name": name, "description": description, **definition, "userInterface": widget}
    job.template["parameterDefinitions"].append(parameter)
    job.values[name] = value
    return f"{{{{Param.{name}}}}}"


def _add_sequence(job: Job, name: str, path: Path, is_folder: bool, what: str, flow: str) -> str:
    """Define two parameters, folder and pattern: a farm can copy a folder, but not a pattern."""
    folder, file = (path, "") if is_folder else (path.parent, path.name)
    place, choose = str(folder.absolute()), _path("DIRECTORY", flow)
    directory = _add(job, f"{name}Folder", place, what, "CHOOSE_DIRECTORY", f"{what}: folder", **choose)
    said = "Pattern in the folder; empty for all of it"
    return f"{directory}/{_add(job, f'{name}Name', file, said, 'LINE_EDIT', f'{what}: files', type='STRING')}"


def _path(kind: str, flow: str) -> dict[str, str]:
    return {"type": "PATH", "objectType": kind, "dataFlow": flow}


def write_bundle(folder: Path, job: Job) -> None:
    """Write a new folder from which ``openjd run`` and Deadline Cloud read the job.

    Raises:
        InputError: the folder exists, or its parent is missing or read-only.
        MssplError: the file system refused.
    """
    check_folder(folder)
    if folder.exists():
        raise InputError(f"{folder}: exists; name a new folder for the bundle")
    make_folder(folder, new=True)  # another submission may make it now
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
