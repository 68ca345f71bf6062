# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and what they do to the process."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    from oiio_msspl.exr.write_options import WriteOptions
    from oiio_msspl.jobs.frame import InputOptions

Map = Annotated[
    list[str],
    typer.Option(
        "--map",
        metavar="FEATURE=LAYER",
        help="Take a feature (rgb, albedo, normal, diffuse, specular, variance) from this layer, a sum of layers "
        "(lighting+GI) or another EXR; rgb takes a single layer. May be repeated.",
    ),
]
MapFile = Annotated[
    Path | None, typer.Option("--map-file", metavar="TOML", help="A mapping as a file: feature = candidate lines.")
]
ViewLayer = Annotated[
    str | None, typer.Option("--view-layer", metavar="NAME", help="View (left) or view layer, if there are several.")
]
HrSpp = Annotated[
    float | None, typer.Option("--hr-spp", min=0, help="Samples per pixel of the HRLS, if its header does not say.")
]
LrSpp = Annotated[float | None, typer.Option("--lr-spp", min=0, help="Samples per pixel of the LRHS, likewise.")]
Verbose = Annotated[int, typer.Option("--verbose", "-v", count=True, help="Say more; twice for everything.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Json = Annotated[bool, typer.Option("--json", help="Print a report for machines on standard output.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")]


def set_up_logging(verbose: int, quiet: bool) -> None:
    level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.basicConfig(level=level, format="%(levelname)s: %(message)s", force=True)


def make_inputs(
    mapping: list[str], map_file: Path | None, view_layer: str | None, lr_spp: float | None, hr_spp: float | None
) -> InputOptions:
    """The shared options as the library's :class:`~oiio_msspl.jobs.frame.InputOptions`; ``--map`` wins over the file."""
    from oiio_msspl.aovs.mapping import parse_map_options, read_map_file
    from oiio_msspl.jobs.frame import InputOptions

    layers: dict[str, Any] = read_map_file(map_file) if map_file else {}
    return InputOptions(layers | parse_map_options(mapping), view_layer, lr_spp, hr_spp)


def make_write_options(
    layout: str, compression: str | None, half: bool | None, layers: list[str], error_layer: bool
) -> WriteOptions:
    from oiio_msspl.exr.write_options import WriteOptions

    pixel_type = None if half is None else "half" if half else "float"
    return WriteOptions(layout, compression, pixel_type, tuple(layers), error_layer)


def parse_bytes(text: str) -> int:
    """``3G``, ``800M`` or plain bytes.

    Raises:
        InputError: it is none of these.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?", text.strip(), re.IGNORECASE)
    if not match:
        raise InputError(f"--max-memory {text!r}: write it as 3G or 800M")
    return int(float(match[1]) * 1024 ** " KMGT".index(match[2].upper() or " "))
