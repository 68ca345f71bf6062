# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl blender-install``."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Annotated

import typer

from msspl_cli import options
from msspl_cli.blender_process import find_blender
from msspl_cli.extension import unpack_extension
from oiio_msspl.errors import InputError, MssplError

EXAMPLES = """[bold]Examples[/bold]

  msspl blender-install msspl-blender-1.0.0.zip

  msspl blender-install msspl-blender-1.0.0.zip --blender /opt/blender-5.0/blender
"""


def blender_install(
    zip_file: Annotated[Path, typer.Argument(metavar="ZIP", help="The extension of this version.", show_default=False)],
    blender: Annotated[
        str | None,
        typer.Option(metavar="PROGRAM", help="Add the buttons to this Blender. \\[default: MSSPL_BLENDER or blender]"),
    ] = None,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
) -> None:
    """Install the extension for Blender, which is a package of its own under GPL-3.0-or-later.

    msspl-render needs it, and it adds buttons to Blender.
    """
    folder = unpack_extension(zip_file)
    print(f"{folder}: unpacked for msspl-render")
    try:
        program = find_blender(blender)
    except InputError as error:
        if blender is not None:
            raise
        print(f"No buttons were added, because {error}.")
        return
    if Path(program).name.lower().startswith("python"):
        print("No buttons were added, because a Python has no window.")
        return
    command = [program, "--command", "extension", "install-file", "-r", "user_default", "-e", str(zip_file.absolute())]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise MssplError(
            f"{program}: can't install the extension ({(done.stderr or done.stdout).strip()[-200:]}); in Blender, "
            f"use Preferences > Get Extensions > Install from Disk with {zip_file}"
        )
    print(f"{program}: the buttons are in Properties > Render > MSSPL Fuse")
