# SPDX-License-Identifier: Apache-2.0
"""A shot as an Open Job Description job: its template, and the values of its parameters, in the files of a job bundle.

A task is ``msspl-fuse`` on a chunk of the frames. Arguments are a list that no shell reads, so that names may hold
spaces and quotes. Paths are parameters, so that a farm can map and copy them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_folder, replacing
from oiio_msspl.jobs.sequence import Shot, format_frames

#: Seconds that msspl-fuse gets between SIGTERM and SIGKILL, to end the frame that is being written.
GRACE = 120

#: What a job parameter may hold (Open Job Description 2023-09).
_LONGEST = 1024

#: Of the files of a bundle: Deadline Cloud's names, and the values again as ``openjd run`` reads them.
TEMPLATE, VALUES, OPENJD_VALUES = "template.json", "parameter_values.json", "openjd_values.json"


def make_job(
    lr: Path,
    hr: Path,
    output: Path,
    shot: Shot,
    *,
    options: Sequence[str] = (),
    files: dict[str, Path] | None = None,
    chunk: int = 10,
    timeout: int = 1800,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Describe a shot as a job.

    Args:
        lr, hr, output: the folders or patterns that ``shot`` was found by.
        shot: which frames; those without a partner are left in, since it may come before their task does.
        options: more arguments of ``msspl-fuse``, the same for all frames.
        files: options of ``msspl-fuse`` (``--model``) that name a file.
        chunk: frames a task.
        timeout: seconds a frame.

    Returns:
        The template, and the value of each job parameter.

    Raises:
        InputError: something that a job can't hold.
    """
    parameters: list[dict[str, Any]] = []
    values: dict[str, Any] = {}

    def add(name: str, value: str | int, description: str, **definition: Any) -> str:
        if len(str(value)) > _LONGEST:
            raise InputError(f"{name} has more than the {_LONGEST} characters that a job parameter may: {value}")
        parameters.append({"name": name, "description": description, **definition})
        values[name] = value
        return f"{{{{Param.{name}}}}}"

    def add_sequence(name: str, path: Path, is_folder: bool, what: str, flow: str) -> str:
        # A pattern is no file that a farm could copy; its folder is.
        folder = str((path if is_folder else path.parent).absolute())
        directory = add(f"{name}Folder", folder, what, type="PATH", objectType="DIRECTORY", dataFlow=flow)
        pattern = add(f"{name}Name", "" if is_folder else path.name, "Pattern in it; empty: all of it", type="STRING")
        return f"{directory}/{pattern}"

    arguments = [
        add_sequence("LR", lr, lr.is_dir(), "Low-resolution, high-spp renders", "IN"),
        add_sequence("HR", hr, hr.is_dir(), "High-resolution, low-spp renders", "IN"),
        "--output",
        add_sequence("Out", output, shot.output.folder == output, "Fused frames", "OUT"),
    ]
    # Sorted, because ranges of Open Job Description are; their step is a colon.
    numbers = format_frames(sorted(frame.number for frame in shot.frames)).replace("x", ":")
    frames = add("Frames", numbers, "Frames of the shot: 1001-1100 or 1001-1099:2,1200", type="STRING")
    size = add("FramesPerTask", chunk, "Frames of a chunk, which is a task", type="INT", minValue=1)
    for option, path in (files or {}).items():
        name = option.removeprefix("--").title().replace("-", "")
        file = add(name, str(path.absolute()), f"{option} of msspl-fuse", type="PATH", objectType="FILE", dataFlow="IN")
        arguments += [option, file]
    arguments += ["--frames", "{{Task.Param.Frame}}", "--skip-existing", "--progress", "openjd"]
    arguments += [_literal(option) for option in options]
    step = {
        "name": "Fuse",
        "parameterSpace": {
            "taskParameterDefinitions": [
                {
                    "name": "Frame",
                    "type": "CHUNK[INT]",
                    "range": frames,
                    "chunks": {"defaultTaskCount": size, "rangeConstraint": "NONCONTIGUOUS"},
                }
            ]
        },
        "script": {
            "actions": {
                "onRun": {
                    "command": "msspl-fuse",
                    "args": arguments,
                    "timeout": chunk * timeout,
                    "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": GRACE},
                }
            }
        },
    }
    template = {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": _literal(f"msspl-fuse {shot.hr.pattern.base}")[:128],
        "parameterDefinitions": parameters,
        "steps": [step],
    }
    return template, values


def write_bundle(folder: Path, template: dict[str, Any], values: dict[str, Any]) -> None:
    """Write a folder that ``openjd run`` and Deadline Cloud take a job from.

    Raises:
        InputError: it exists already, or can't be made here.
        MssplError: the file system refused.
    """
    check_folder(folder)
    try:
        folder.mkdir()
    except FileExistsError as error:
        raise InputError(f"{folder}: exists; name a new folder for the bundle") from error
    except OSError as error:
        raise MssplError(f"{folder}: can't be made ({error.strerror})") from error
    for_deadline = {"parameterValues": [{"name": name, "value": value} for name, value in values.items()]}
    for name, content in ((VALUES, for_deadline), (OPENJD_VALUES, values), (TEMPLATE, template)):
        with replacing(folder / name) as temporary:
            temporary.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def _literal(text: str) -> str:
    """Text of the template itself; there is no other way to write two braces there."""
    if "{{" in text:
        raise InputError(f"{text!r}: a job template takes '{{{{' for the start of a parameter")
    return text
