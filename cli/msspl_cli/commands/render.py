# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from msspl_cli import options, show
from msspl_cli.installed import find_msspl_fuse, shipped_folder
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_folder, check_target


EXAMPLES = """[bold]Examples[/bold]

  msspl-render scene.blend -s 4 --lr-spp 16 --hr-spp 1 -o frame.exr

  msspl-render scene.blend -o shot/frame.####.exr --frames 1001-1100 --skip-existing

  msspl-render scene.blend -o frame.exr --blender /opt/blender-5.0/blender

  msspl-render scene.blend -o frame.exr --keep --compare --json > times.json
"""

#: What Blender itself prints while it renders.
_SAMPLES = re.compile(r"Sample (\d+)/(\d+)")
_GRACE = 15  # seconds that Blender, and the msspl-fuse it runs, get to end


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A .blend that renders with Cycles.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="EXR to write, or a pattern.", show_default=False)
    ],
    scale: Annotated[int, typer.Option("--scale", "-s", help="2, 4 or 8: the LRHS has 1/scale of the size.")] = 4,
    lr_spp: Annotated[
        int | None,
        typer.Option(
            min=1, help="Samples a pixel of the LRHS; if not given, a third of the HRLS's in all.", show_default=False
        ),
    ] = None,
    hr_spp: Annotated[int, typer.Option(min=1, help="Samples a pixel of the HRLS.")] = 1,
    frames: Annotated[
        str | None,
        typer.Option(
            "--frames",
            "--frame",
            metavar="RANGE",
            help="7, 1001-1100x2 or 1001,1005-1010; the frame that the scene was saved at if not given.",
        ),
    ] = None,
    pixel_filter: Annotated[
        str, typer.Option("--filter", help="Pixel filter: box, which the network expects, or scene: its own.")
    ] = "box",
    view_layer: Annotated[
        str, typer.Option(metavar="NAME", help="View layer, if several are on.", show_default=False)
    ] = "",
    keep: Annotated[bool, typer.Option("--keep", help="Keep both renders beside OUT: OUT_lr.exr, OUT_hr.exr.")] = False,
    compare: Annotated[
        bool,
        typer.Option("--compare", help="Also render the ordinary way, with OIDN, in the same time: OUT_oidn.exr."),
    ] = False,
    blender: Annotated[
        str | None,
        typer.Option(
            metavar="PROGRAM",
            help="Blender 4.5 or later, or a Python that has bpy; MSSPL_BLENDER or blender on the path if not given.",
        ),
    ] = None,
    threads: Annotated[int, typer.Option(min=0, max=1024, help="CPU threads; 0: the scene's, one a core.")] = 0,
    overwrite: options.Overwrite = False,
    skip_existing: Annotated[
        bool, typer.Option("--skip-existing", help="Leave frames alone whose OUT is there; resumes a shot.")
    ] = False,
    verbose: options.Verbose = 0,
    quiet: options.Quiet = False,
    as_json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Render a Blender scene at low and at full resolution, and fuse the two.

    OUT gets the fused beauty and every pass of the scene. The time of each step is printed, and how many samples
    ordinary rendering would have taken in that time.
    """
    if not scene.is_file():
        raise InputError(f"{scene}: no such file")
    from oiio_msspl.model.contract import SCALES

    if scale not in SCALES:
        raise InputError(f"--scale {scale}: use one of {', '.join(map(str, SCALES))}")
    if pixel_filter not in ("box", "scene"):
        raise InputError(f"--filter {pixel_filter!r}: use one of box, scene")
    program = find_blender(blender)
    fuse = find_msspl_fuse()
    if fuse is None:
        raise MssplError("msspl-fuse is not installed beside this program; install oiio-msspl again")
    if overwrite and skip_existing:
        raise InputError("--overwrite and --skip-existing exclude each other: replace frames, or leave them")
    targets = name_targets(output, frames)
    folder = output.parent
    makes_folder = is_pattern(output) and not folder.exists()
    if makes_folder:
        check_folder(folder)
    suffixes = ["", *(["_lr", "_hr"] if keep else []), *(["_oidn"] if compare else [])]
    for _, target in targets:
        if target.suffix.lower() != ".exr":
            raise InputError(f"{target}: the result is an EXR; name it .exr")
    if skip_existing:
        targets = [(number, target) for number, target in targets if not target.exists()]
    for _, target in [] if makes_folder else targets:
        for suffix in suffixes:
            check_target(target.with_name(f"{target.stem}{suffix}.exr"), overwrite=overwrite)
    job = {
        "scene": str(scene.absolute()),
        "frames": [(number, str(target.absolute())) for number, target in targets],
        "program": fuse,
        "options": {
            "scale": scale,
            "hr_spp": hr_spp,
            "lr_spp": lr_spp or 0,
            "filter": pixel_filter.upper(),
            "view_layer": view_layer,
            "threads": threads,
        },
        "overwrite": overwrite,
        "keep": keep,
        "compare": compare,
    }
    if makes_folder:
        folder.mkdir(exist_ok=True)
    reports: list[dict[str, Any]] = []
    status = _Status(on=not quiet and not verbose and sys.stderr.isatty())
    try:
        if targets:
            _render(program, scene, job, folder, reports, status, verbose=bool(verbose), quiet=quiet)
    finally:
        # Of a shot that failed or was ended, too: its frames are there.
        status.clear()
        if as_json:
            print(json.dumps(reports, indent=2))
        elif reports and not quiet:
            _print(reports)
    if not (targets or as_json or quiet):
        print(f"{output}: all is there")


def _render(
    program: str,
    scene: Path,
    job: dict[str, Any],
    folder: Path,
    reports: list[dict[str, Any]],
    status: _Status,
    *,
    verbose: bool,
    quiet: bool,
) -> None:
    """Have a job done; ``reports`` gets a frame's as soon as it ends.

    Raises:
        InputError, MssplError: a frame failed, which the sentence names if there are several.
    """
    count, number = len(job["frames"]), None
    # Beside the results, so that what is kept only has to be renamed.
    with tempfile.TemporaryDirectory(prefix=".msspl-", dir=folder.absolute()) as work:
        path = Path(work, "job.json")
        path.write_text(json.dumps({**job, "work": work}), encoding="utf-8")
        try:
            for event in run_blender(command(program, scene, path), verbose=verbose):
                number = event.get("frame", number)
                if "report" in event:
                    reports.append(event["report"])
                    number = None
                    status.clear()
                    for warning in [] if quiet else reports[-1]["warnings"]:
                        print(f"warning: frame {reports[-1]['frame']}: {warning}", file=sys.stderr)
                else:
                    status.show(event)
        except MssplError as error:
            if number is None or count == 1:
                raise
            raise type(error)(f"frame {number}: {error}") from error
    if len(reports) < count:
        raise MssplError(f"{program}: ended after {len(reports)} of {count} frames (-v shows what it says)")


def is_pattern(output: Path) -> bool:
    from oiio_msspl.jobs.sequence import is_sequence

    return is_sequence(output) and not output.is_dir()


def name_targets(output: Path, frames: str | None) -> list[tuple[int | None, Path]]:
    """Frame numbers (None: the one that the scene was saved at) and the file of each.

    Raises:
        InputError: one name for several frames, or a pattern without frames.
    """
    from oiio_msspl.jobs.sequence import parse_frames, parse_pattern

    numbers = [] if frames is None else parse_frames(frames)
    if is_pattern(output):
        if not numbers:
            raise InputError(f"{output}: is a pattern; name the frames with --frames")
        pattern = parse_pattern(output)
        return [(number, pattern.path(number)) for number in numbers]
    if len(numbers) > 1:
        raise InputError(f"{output}: one name for {len(numbers)} frames; write {output.stem}.####.exr")
    return [(numbers[0] if numbers else None, output)]


# ---------------------------------------------------------------------------------------------- Blender


def find_blender(named: str | None) -> str:
    """Blender's program, or a Python that has bpy: as named, as MSSPL_BLENDER says, or from the path.

    Raises:
        InputError: it is not there.
    """
    for where, name in (("--blender", named), ("MSSPL_BLENDER", os.environ.get("MSSPL_BLENDER"))):
        if name:
            found = shutil.which(os.path.expanduser(name))
            if found is None:
                raise InputError(f"{where} {name}: no such program")
            return found
    found = shutil.which("blender")
    if found is None:
        raise InputError("blender is not on the path; name it with --blender or MSSPL_BLENDER")
    return found


def command(program: str, scene: Path, job: Path) -> list[str]:
    """How a Blender, or a Python that has bpy, is told to do a job."""
    script = str(shipped_folder("blender_addon") / "headless.py")
    if Path(program).name.lower().startswith("python"):
        return [program, "-P", script, str(job)]  # -P: what lies beside the script must not hide other modules
    return [program, "--background", str(scene.absolute()), "--python", script, "--", str(job)]


def run_blender(arguments: Sequence[str], *, verbose: bool = False) -> Iterator[dict[str, Any]]:
    """Run the add-on's headless.py and yield what it tells. Leaving the loop ends Blender and all that it started.

    Raises:
        InputError, MssplError: the job failed; the sentence is Blender's or msspl-fuse's.
    """
    posix = os.name == "posix"
    try:
        started = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=posix,  # a group of its own, which can be ended as a whole
        )
    except OSError as refused:
        raise InputError(
            f"{arguments[0]}: can't be started ({refused.strerror}); name Blender, or a Python that has bpy, with "
            "--blender or MSSPL_BLENDER"
        ) from refused
    with started as process:
        assert process.stdout is not None
        last: deque[str] = deque(maxlen=5)
        error = None
        try:
            for line in process.stdout:
                if line.startswith("MSSPL "):
                    event = json.loads(line.removeprefix("MSSPL "))
                    if "error" in event:
                        error = event
                    else:
                        yield event
                    continue
                if verbose:
                    print(line, end="", file=sys.stderr)
                if samples := _SAMPLES.search(line):
                    yield {"samples": int(samples[1]) / max(1, int(samples[2]))}
                elif line.strip():
                    last.append(line.strip())
            process.wait()
        finally:
            if process.poll() is None:
                _end(process, group=posix)
    if error is not None:
        raise (InputError if error["code"] == 2 else MssplError)(error["error"])
    if process.returncode:
        said = " | ".join(last)
        raise MssplError(f"{arguments[0]}: ended with code {process.returncode}" + (f": {said}" if said else ""))


def _end(process: subprocess.Popen[str], *, group: bool) -> None:
    for end in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)):
        if group:
            os.killpg(process.pid, end)
        else:
            process.send_signal(end)
        try:
            process.wait(_GRACE)
            return
        except subprocess.TimeoutExpired:
            continue


# ---------------------------------------------------------------------------------------------- what is said


@dataclass
class _Status:
    """One line on a terminal that says what is being done."""

    on: bool
    _text: str = field(default="", init=False)

    def show(self, event: dict[str, Any]) -> None:
        if "step" in event:
            self._text = f"frame {event['frame']}: {event['step']}"
        if self.on:
            samples = f" {event['samples']:.0%}" if "samples" in event else ""
            print(f"\r\033[K{self._text}{samples}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        if self.on:
            print("\r\033[K", end="", file=sys.stderr, flush=True)


def _print(reports: list[dict[str, Any]]) -> None:
    """The time of each step, and what the same time of ordinary rendering gives."""
    first = reports[0]
    for key, name in (("lrhs", "LRHS"), ("hrls", "HRLS")):
        print(f"{name} {first[key]['size'][0]}x{first[key]['size'][1]}, {first[key]['spp']} spp")
    rows: list[tuple[str, ...]] = [("frame", "LRHS s", "HRLS s", "fuse s", "all s", "plain rendering in that time")]
    for report in reports:
        oidn = report.get("oidn")
        plain = (
            f"{oidn['spp']} spp and OIDN, {oidn['seconds']:.2f} s: {oidn['file']}"
            if oidn
            else f"about {report['plain_spp']:.1f} spp"
        )
        seconds = report["lrhs"]["seconds"], report["hrls"]["seconds"], report["fuse_seconds"], report["seconds"]
        rows.append((str(report["frame"]), *(f"{value:.2f}" for value in seconds), plain))
    show.table(rows)
    print(f"wrote {reports[0]['output']}" + (f" to {reports[-1]['output']}" if len(reports) > 1 else ""))
