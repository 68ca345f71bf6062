# SPDX-License-Identifier: Apache-2.0
"""Holds the options that several commands share, and turns them into values of the library.

``--help`` shows the options of everyday work. Those marked ``hidden`` appear in ``--help-all``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from oiio_msspl import __version__
from oiio_msspl.errors import InputError, printable

if TYPE_CHECKING:
    from oiio_msspl.exr.write_options import WriteOptions
    from oiio_msspl.jobs.inputs import InputOptions

#: Groups of options in the help text.
INPUT, MODEL, OUTPUT, SHOT = "Input", "Model", "Output", "Shot"


def option(
    group: str | None, text: str, *names: str, metavar: str | None = None, hidden: bool = False, **more: Any
) -> Any:
    """Describe an option, and its group in the help text. Without names, it is called as its parameter."""
    return typer.Option(*names, help=text, metavar=metavar, hidden=hidden, rich_help_panel=group, **more)


def _show_all(context: typer.Context, wanted: bool) -> None:
    """Print the help text with its hidden options, and exit."""
    if wanted:
        for parameter in context.command.params:
            parameter.hidden = False  # type: ignore[attr-defined]
        typer.echo(context.get_help())
        raise typer.Exit


def _show_version(wanted: bool) -> None:
    """Print the version, and exit."""
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


_RENDERS = (
    "One render, or two of the same frame: a low-resolution, high-spp render LR and a high-resolution, low-spp render "
    "HR, or two of the same size. Each is an EXR. For a shot: a folder, or a pattern such as hr.####.exr."
)
Renders = Annotated[list[Path], typer.Argument(metavar="[LR] HR", help=_RENDERS, show_default=False)]

_MAP = (
    "Read a feature (rgb, albedo or normal; for the model paper also diffuse, specular or variance) from this layer, "
    "from a sum of layers (lighting+GI) or from another EXR. rgb takes a single layer. May be repeated."
)
Map = Annotated[list[str], option(INPUT, _MAP, "--map", metavar="FEATURE=LAYER")]
_MAP_FILE = "Read mappings (see --map) from a file."
MapFile = Annotated[Path | None, option(INPUT, _MAP_FILE, "--map-file", metavar="TOML", hidden=True)]
_VIEW_LAYER = "Read only this view (left) or view layer. \\[default: all]"
ViewLayer = Annotated[str | None, option(INPUT, _VIEW_LAYER, "--view-layer", metavar="NAME")]
_COLOURSPACE = (
    "Read both renders in this linear RGB space instead of that of their headers: lin_rec709, acescg, aces2065-1, "
    "lin_rec2020 or lin_p3d65. \\[default: as their headers say, or lin_rec709]"
)
Colourspace = Annotated[str | None, option(INPUT, _COLOURSPACE, "--colorspace", metavar="NAME", hidden=True)]
_SUM = "Fuse layers of HR that sum to the beauty under unusual names. May be repeated."
Sum = Annotated[list[str], option(INPUT, _SUM, "--sum", metavar="NAME=A+B+C*D", hidden=True)]
_MOTION_FORMAT = (
    "Read motion vectors in this format, if the pixels can't tell it: layer=NAME, and any of channels=XY, "
    "to=next|previous, x=right|left, y=down|up, unit=pixels|ndc|screen|width, scale=2, offset=0.5, premultiplied. A "
    "second layer follows after +."
)
MotionFormat = Annotated[str | None, option(INPUT, _MOTION_FORMAT, "--motion-format", metavar="FORMAT", hidden=True)]

_QUALITY = "Choose fast for previews, best for final frames that can wait, or balanced. \\[default: balanced]"
Quality = Annotated[str | None, option(MODEL, _QUALITY, metavar="NAME")]
_MODEL = "Choose a family (paper), a shipped model (see msspl models) or an ONNX file instead of a quality."
Model = Annotated[str, option(MODEL, _MODEL, metavar="NAME", hidden=True)]
_DEVICE = "Run the model on cpu, cuda, tensorrt, openvino, coreml or directml."
Device = Annotated[str, option(MODEL, _DEVICE, metavar="NAME")]
_MAX_MEMORY = "Stay below this memory. The result does not depend on it."
MaxMemory = Annotated[str, option(MODEL, _MAX_MEMORY, metavar="SIZE")]

_LAYOUT = "Arrange parts for any program (spec), for Nuke (nuke) or as a single part (multilayer)."
Layout = Annotated[str, option(OUTPUT, _LAYOUT, metavar="NAME")]
_PASSES = "Fuse these passes with the beauty: auto (all that sum to it), none, or names of sets or layers (light*)."
Passes = Annotated[list[str], option(OUTPUT, _PASSES, metavar="PATTERN")]
ErrorLayer = Annotated[
    bool, option(OUTPUT, "Add a layer 'error': the error that the model expects in each pixel.", "--error-layer")
]
_TRUST = "Put back what both renders show and the network has removed (on), or keep the network's picture (off)."
Trust = Annotated[str, option(OUTPUT, _TRUST, "--trust", metavar="on|off", hidden=True)]
_TRUST_LAYER = "Add a layer 'trust': how much of what the network removed was put back, from 0 to 1."
TrustLayer = Annotated[bool, option(OUTPUT, _TRUST_LAYER, "--trust-layer", hidden=True)]
_DATA_PASSES = "Add the layers 'denoised_albedo' and 'denoised_normal'. It needs --quality best."
DataPasses = Annotated[bool, option(OUTPUT, _DATA_PASSES, "--data-passes", hidden=True)]
Overwrite = Annotated[bool, option(OUTPUT, "Replace existing files.", "--overwrite")]
Strict = Annotated[
    bool, option(OUTPUT, "Take a warning for an error: do not write that frame.", "--strict", hidden=True)
]
Json = Annotated[bool, option(OUTPUT, "Print a report as JSON on standard output.", "--json")]

_FRAMES = "Take only these frames: 1001-1100x2 or 1001,1005-1010. \\[default: all]"
Frames = Annotated[str | None, option(SHOT, _FRAMES, metavar="RANGE")]
_TEMPORAL = "Remove flicker: average each frame with N frames before and after, along motion; or off. auto: 4"
_WHERE_KNOWN = " where motion is known, 6 with --quality best."
Temporal = Annotated[str, option(SHOT, _TEMPORAL + _WHERE_KNOWN, "--temporal", metavar="N")]
_BLURRED = ", or off where motion blur is on."
RenderedTemporal = Annotated[str, option(SHOT, _TEMPORAL + _BLURRED, "--temporal", metavar="N")]
_FRAMES_LAYER = "Add a layer 'frames': the number of frames that each pixel is the average of."
FramesLayer = Annotated[bool, option(SHOT, _FRAMES_LAYER, "--frames-layer", hidden=True)]
SkipExisting = Annotated[bool, option(SHOT, "Skip frames that exist, to resume a run.", "--skip-existing")]

Verbose = Annotated[
    int, typer.Option("--verbose", "-v", count=True, metavar="", help="Print more; -vv prints all.", hidden=True)
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.", hidden=True)]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.", hidden=True)]
HelpAll = Annotated[
    bool, typer.Option("--help-all", help="Show all options and exit.", is_eager=True, callback=_show_all)
]
Version = Annotated[
    bool, typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=_show_version)
]


class _OneLine(logging.Formatter):
    """A format that keeps a message on one line, whatever names it contains. A traceback follows on further lines.

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
    """Return the options that describe the input files. ``--map`` wins over ``--map-file``."""
    from oiio_msspl.aovs.mapping import parse_map_options, read_map_file
    from oiio_msspl.jobs.inputs import InputOptions

    layers: dict[str, Any] = read_map_file(map_file) if map_file else {}
    mapped = layers | parse_map_options(mapping)
    return InputOptions(mapped, view_layer, lr_spp, hr_spp, colourspace, tuple(sums or ()), map_file)


def low_and_high(renders: list[Path]) -> tuple[Path | None, Path]:
    """Return the paths of the LRHS and of the HRLS; None and that of the only render. More than two are refused."""
    if len(renders) > 2:
        raise InputError(f"{renders[2]}: is a third render; give one, or two of the same frame")
    return renders[0] if len(renders) == 2 else None, renders[-1]


def choose_model(model: str, quality: str | None) -> str:
    """Return the model that ``--model`` or ``--quality`` names. Raise InputError if both do."""
    from oiio_msspl.model.catalogue import AUTO, QUALITIES

    if quality is None:
        return model
    if quality not in QUALITIES:
        raise InputError(f"--quality {quality!r}: use one of {', '.join(QUALITIES)}")
    if model != AUTO:
        raise InputError("--quality and --model: give one of them, because a model has its quality")
    return quality


def make_write_options(
    passes: list[str], trust: str, *, layers: Sequence[str] = (), half: bool | None = None, **others: Any
) -> WriteOptions:
    """Return the options that describe the result; ``others`` are fields of :class:`WriteOptions`."""
    from oiio_msspl.exr.write_options import WriteOptions

    pixel_type = None if half is None else "half" if half else "float"
    if "auto" in passes and len(passes) > 1:
        raise InputError(f"--passes {', '.join(passes)}: auto fuses all sets; leave it out, or the others")
    patterns = () if passes == ["auto"] else tuple(passes)
    if trust not in ("on", "off"):
        raise InputError(f"--trust {trust!r}: use on or off")
    kept = tuple(layers)
    return WriteOptions(pixel_type=pixel_type, layers=kept, passes=patterns, trust=trust == "on", **others)
