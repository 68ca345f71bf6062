# SPDX-License-Identifier: Apache-2.0
"""Finds msspl-fuse and msspl, and builds their command lines and their environment."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from msspl_bridge import FuseError
from msspl_bridge.frame_files import FrameFile, with_slashes

#: Variables that the host sets for its own Python. Another Python may not start with them.
_PYTHON_VARIABLES = ("PYTHONHOME", "PYTHONPATH", "PYTHONEXECUTABLE", "PYTHONPLATLIBDIR", "__PYVENV_LAUNCHER__")
#: Search paths to which the host may add its own libraries.
_LIBRARY_PATHS = (
    *("LD_LIBRARY_PATH", "LD_PRELOAD"),
    *("DYLD_LIBRARY_PATH", "DYLD_FRAMEWORK_PATH", "DYLD_INSERT_LIBRARIES"),
)


@dataclass(frozen=True)
class Settings:
    """The values of the knobs, as text."""

    quality: str = "balanced"
    model: str = ""
    """A model, or an ONNX file, instead of a quality."""
    device: str = "cpu"
    mapping: str = ""
    """One ``feature=layer`` per line, such as ``albedo=my_albedo``."""
    layers: str = ""
    """Layer patterns, separated by commas."""
    passes: str = ""
    """Patterns of the passes to fuse, separated by commas."""
    temporal: str = "auto"
    """Neighbours that a frame is averaged with: ``auto``, ``off``, or the number of frames before and after it."""
    options: str = ""
    """Further options, quoted as in a shell."""
    chunk: str = "10"
    """Frames that a task of a farm fuses."""
    overwrite: bool = True


def build_command(
    program: str,
    files: Sequence[FrameFile],
    settings: Settings,
    numbers: tuple[int, int] | None = None,
    bundle: str = "",
) -> list[str]:
    """Build the command line for one frame or, given the first and last file number, for a range.

    A single frame is averaged with its neighbours, too, so that it has the pixels that a range would give it. It is
    fused alone if its files have no numbers, or different ones: msspl-fuse pairs the files of neighbours by number.

    Args:
        program: the path of msspl-fuse. msspl lies beside it.
        files: the LRHS if there is one, the HRLS, and the result.
        bundle: write the range as a job for a farm into this new folder, instead of fusing it.

    Raises:
        FuseError: the mapping or the options cannot be parsed, or there is no msspl.
    """
    number = files[-1].number
    first, last = numbers or (number, number)
    in_shot = numbers is not None or all(file.number == number is not None for file in files)
    *renders, result = (file.pattern if in_shot else file.path for file in files)
    msspl = shutil.which("msspl", path=os.path.dirname(program)) if bundle else ""
    if msspl is None:
        raise FuseError(f"there is no msspl beside {program}; name msspl-fuse where the package is installed")
    command = [*([msspl, "submit"] if bundle else [program]), *renders, "-o", result]
    if in_shot:
        command += ["--frames", f"{first}" if first == last else f"{first}-{last}", "--temporal", settings.temporal]
    if bundle:
        # Tasks skip what exists; with --update only what is newer than its renders.
        command += ["--bundle", bundle, "--chunk", settings.chunk, *(["--update"] if settings.overwrite else [])]
    else:
        command += ["--progress", "json"] if in_shot else []
        command += ["--overwrite"] if settings.overwrite else ["--skip-existing"] if numbers else []
    return command + _options(settings)


def _options(settings: Settings) -> list[str]:
    """Return the options that do not depend on the files."""
    choice = ["--model", settings.model] if settings.model else ["--quality", settings.quality]
    # The layout of Nuke's own Write: one part per layer, named after the layer.
    options = [*choice, "--device", settings.device, "--layout", "nuke", "--no-preview"]
    for line in filter(None, map(str.strip, settings.mapping.splitlines())):
        feature, equals, layer = line.partition("=")
        if not (feature.strip() and equals and layer.strip()):
            raise FuseError(f"mapping {line!r}: write one feature=layer per line, such as albedo=my_albedo")
        options += ["--map", f"{feature.strip()}={layer.strip()}"]
    for option, patterns in (("--layers", settings.layers), ("--passes", settings.passes)):
        for pattern in filter(None, map(str.strip, patterns.split(","))):
            options += [option, pattern]
    return options + split_words("options", settings.options)


def split_words(knob: str, text: str) -> list[str]:
    """Split the value of a knob as a shell does."""
    try:
        return shlex.split(with_slashes(text))  # shlex would remove the backslashes of Windows paths
    except ValueError as error:
        raise FuseError(f"{knob} {text!r}: {error}; quote them as in a shell") from error


def find_program(chosen: str, environment: Mapping[str, str]) -> str:
    """Find msspl-fuse: the chosen one, otherwise ``MSSPL_FUSE``, otherwise the first on ``PATH``."""
    variable = environment.get("MSSPL_FUSE", "")
    for source, name in (("the program knob", chosen), ("MSSPL_FUSE", variable), ("", "msspl-fuse")):
        program = shutil.which(os.path.expanduser(name), path=environment.get("PATH")) if name else None
        if program is not None:
            return program
        if name and source:
            raise FuseError(f"{source} names {name}, but there is no such program; give the path of msspl-fuse")
    raise FuseError(
        "msspl-fuse was not found; install oiio_msspl, and put the path of msspl-fuse into the program knob or "
        "into the environment variable MSSPL_FUSE"
    )


def clean_environment(environment: Mapping[str, str], host_folder: str) -> dict[str, str]:
    """Remove the host's Python and libraries from an environment, because they would break another Python.

    Library folders outside the host's folder stay, because drivers and the site's libraries may be found through them.
    """
    clean = {key: value for key, value in environment.items() if key not in _PYTHON_VARIABLES}
    folder = os.path.join(os.path.realpath(host_folder), "")
    for key in _LIBRARY_PATHS:
        paths = clean.pop(key, "").split(os.pathsep)
        if kept := [p for p in paths if p and not os.path.join(os.path.realpath(p), "").startswith(folder)]:
            clean[key] = os.pathsep.join(kept)
    # Messages arrive in UTF-8 on every platform, without delay, and each in a line of its own.
    return {**clean, "PYTHONUTF8": "1", "PYTHONUNBUFFERED": "1", "TERMINAL_WIDTH": "10000"}
