# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and how they become values of the library.

``--help`` shows the options of everyday work. Those marked ``hidden`` appear in ``--help-all``.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from oiio_msspl.errors import InputError, printable

if TYPE_CHECKING:
    from oiio_msspl.exr.write_options import WriteOptions
    from oiio_msspl.jobs.inputs import InputOptions
    from oiio_msspl.jobs.plan import TemporalOptions

#: Bytes above which a size is a slip. Larger numbers are infinite as floats.
LARGEST_MEMORY = 1 << 62

#: Groups of options in the help text.
INPUT, MODEL, OUTPUT, SHOT = "Input", "Model", "Output", "Shot"


def _show_all(context: typer.Context, wanted: bool) -> None:
    """Print the help text with its hidden options, and exit."""
    if wanted:
        for parameter in context.command.params:
            parameter.hidden = False  # type: ignore[attr-defined]
        typer.echo(context.get_help())
        raise typer.Exit


LowRender = Annotated[
    Path,
    typer.Argument(
        metavar="LR",
        help="Low-resolution, high-spp render: an EXR. For a shot: a folder, or a pattern such as lr.####.exr.",
        show_default=False,
    ),
]
HighRender = Annotated[
    Path, typer.Argument(metavar="HR", help="High-resolution, low-spp render, in the same form.", show_default=False)
]
Map = Annotated[
    list[str],
    typer.Option(
        "--map",
        metavar="FEATURE=LAYER",
        help="Read a feature (rgb, albedo, normal, diffuse, specular, variance) from this layer, from a sum of layers "
        "(lighting+GI) or from another EXR. rgb takes a single layer. May be repeated.",
        rich_help_panel=INPUT,
    ),
]
MapFile = Annotated[
    Path | None,
    typer.Option(
        "--map-file",
        metavar="TOML",
        help="Read mappings (see --map) from a file.",
        rich_help_panel=INPUT,
        hidden=True,
    ),
]
ViewLayer = Annotated[
    str | None,
    typer.Option(
        "--view-layer",
        metavar="NAME",
        help="Only this view (left) or view layer. \\[default: all]",
        rich_help_panel=INPUT,
    ),
]
Quality = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="fast, balanced or best. \\[default: balanced]",
        rich_help_panel=MODEL,
    ),
]
Model = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="Instead of a quality: a family (paper), a shipped model (see msspl models) or an ONNX file.",
        rich_help_panel=MODEL,
        hidden=True,
    ),
]
Device = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="cpu, cuda, tensorrt, openvino, coreml or directml.",
        rich_help_panel=MODEL,
    ),
]
Layout = Annotated[str, typer.Option(metavar="NAME", help="spec, nuke or multilayer.", rich_help_panel=OUTPUT)]
ErrorLayer = Annotated[
    bool,
    typer.Option(
        "--error-layer",
        help="Add a layer 'error': the error that the model expects.",
        rich_help_panel=OUTPUT,
    ),
]
DataPasses = Annotated[
    bool,
    typer.Option(
        "--data-passes",
        help="Add the layers 'denoised_albedo' and 'denoised_normal'. For --quality best.",
        rich_help_panel=OUTPUT,
        hidden=True,
    ),
]
Frames = Annotated[
    str | None,
    typer.Option(metavar="RANGE", help="1001-1100x2 or 1001,1005-1010. \\[default: all]", rich_help_panel=SHOT),
]
SkipExisting = Annotated[
    bool,
    typer.Option("--skip-existing", help="Skip frames that exist. This resumes a run.", rich_help_panel=SHOT),
]
Colourspace = Annotated[
    str | None,
    typer.Option(
        "--colorspace",
        metavar="NAME",
        help="Linear RGB space of both renders: lin_rec709, acescg, aces2065-1, lin_rec2020 or lin_p3d65. "
        "\\[default: as their headers say, or lin_rec709]",
        rich_help_panel=INPUT,
        hidden=True,
    ),
]
Verbose = Annotated[
    int, typer.Option("--verbose", "-v", count=True, metavar="", help="Print more; -vv prints all.", hidden=True)
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.", hidden=True)]
Json = Annotated[
    bool, typer.Option("--json", help="Print a report as JSON on standard output.", rich_help_panel=OUTPUT)
]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.", hidden=True)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.", rich_help_panel=OUTPUT)]
HelpAll = Annotated[
    bool,
    typer.Option("--help-all", help="Show all options and exit.", is_eager=True, callback=_show_all),
]


Passes = Annotated[
    list[str],
    typer.Option(
        metavar="PATTERN",
        help="Passes to fuse with the beauty: auto (all that sum to it), none, or names of sets or layers (light*).",
        rich_help_panel=OUTPUT,
    ),
]
Sum = Annotated[
    list[str],
    typer.Option(
        "--sum",
        metavar="NAME=A+B+C*D",
        help="Layers of HR that sum to the beauty, if their names are not known. May be repeated.",
        rich_help_panel=INPUT,
        hidden=True,
    ),
]


MaxMemory = Annotated[
    str,
    typer.Option(
        metavar="SIZE",
        help="Memory to stay below; the result does not depend on it.",
        rich_help_panel=MODEL,
    ),
]
Temporal = Annotated[
    str,
    typer.Option(
        "--temporal",
        metavar="N",
        help="Average each frame with N frames before and after it, along their motion; or off. auto: 4 where motion "
        "is known, 6 with --quality best.",
        rich_help_panel=SHOT,
    ),
]
RenderedTemporal = Annotated[
    str,
    typer.Option(
        "--temporal",
        metavar="N",
        help="Average each frame with N frames before and after it, along their motion; or off. auto: 4, or off where "
        "motion blur is on.",
        rich_help_panel=SHOT,
    ),
]
FramesLayer = Annotated[
    bool,
    typer.Option(
        "--frames-layer",
        help="Add a layer 'frames': the number of frames that each pixel is the average of.",
        rich_help_panel=SHOT,
        hidden=True,
    ),
]
MotionFormat = Annotated[
    str | None,
    typer.Option(
        "--motion-format",
        metavar="FORMAT",
        help="How motion vectors are stored, if the pixels can't tell: layer=NAME, and any of channels=XY, "
        "to=next|previous, x=right|left, y=down|up, unit=pixels|ndc|screen|width, scale=2, offset=0.5, premultiplied. "
        "A second layer follows after +.",
        rich_help_panel=INPUT,
        hidden=True,
    ),
]


class _OneLine(logging.Formatter):
    """Prints a message on one line: it may contain names out of a file. A traceback follows on lines of its own.

    Nuke's node reads lines that begin with ``warning:`` and ``error:``, as the commands print them.
    """

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(f"{record.levelname.lower()}: {record.message}")


def set_up_logging(verbose: int, quiet: bool) -> None:
    """Send the library's log to standard error: warnings, with -v information, with -vv all."""
    level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    handler = logging.StreamHandler()
    handler.setFormatter(_OneLine())
    logging.basicConfig(level=level, handlers=[handler], force=True)


def make_inputs(
    mapping: list[str],
    map_file: Path | None,
    view_layer: str | None,
    lr_spp: float | None,
    hr_spp: float | None,
    colourspace: str | None = None,
    sums: list[str] | None = None,
) -> InputOptions:
    """The options that describe the input files. ``--map`` wins over ``--map-file``.

    Raises:
        InputError: a mapping can't be read.
    """
    from oiio_msspl.aovs.mapping import parse_map_options, read_map_file
    from oiio_msspl.jobs.inputs import InputOptions

    layers: dict[str, Any] = read_map_file(map_file) if map_file else {}
    mapped = layers | parse_map_options(mapping)
    return InputOptions(mapped, view_layer, lr_spp, hr_spp, colourspace, tuple(sums or ()), map_file)


def choose_model(model: str, quality: str | None) -> str:
    """The model that ``--model`` and ``--quality`` name.

    Raises:
        InputError: both are given, or there is no such quality.
    """
    from oiio_msspl.model.catalogue import AUTO, QUALITIES

    if quality is None:
        return model
    if quality not in QUALITIES:
        raise InputError(f"--quality {quality!r}: use one of {', '.join(QUALITIES)}")
    if model != AUTO:
        raise InputError("--quality and --model: give one of them, because a model has its quality")
    return quality


def make_write_options(
    layout: str,
    compression: str | None,
    half: bool | None,
    layers: list[str],
    error_layer: bool,
    passes: list[str] | None = None,
    frames_layer: bool = False,
    data_passes: bool = False,
) -> WriteOptions:
    """The options that describe the result.

    Raises:
        InputError: an unknown layout or compression.
    """
    from oiio_msspl.exr.write_options import WriteOptions

    pixel_type = None if half is None else "half" if half else "float"
    if passes and "auto" in passes and len(passes) > 1:
        raise InputError(f"--passes {', '.join(passes)}: auto fuses all sets; leave it out, or the others")
    patterns = () if passes == ["auto"] else tuple(passes or ())
    return WriteOptions(
        layout, compression, pixel_type, tuple(layers), patterns, error_layer, frames_layer, data_passes
    )


def make_temporal_options(frames: str, motion_format: str | None) -> TemporalOptions:
    """The options of a shot that is fused over time.

    Raises:
        InputError: no such number of frames.
    """
    from oiio_msspl.jobs.plan import TemporalOptions

    return TemporalOptions(frames, motion_format)


def parse_bytes(text: str) -> int:
    """The number of bytes that ``3G``, ``800M`` or a plain number means.

    Raises:
        InputError: the text can't be read, or no machine has so much memory.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?", text.strip(), re.IGNORECASE)
    if not match:
        raise InputError(f"--max-memory {text!r}: write it as 3G or 800M")
    number = float(match[1]) * 1024 ** " KMGT".index(match[2].upper() or " ")
    if number > LARGEST_MEMORY:
        raise InputError("--max-memory: the number is too large; write it as 3G or 800M")
    return int(number)
