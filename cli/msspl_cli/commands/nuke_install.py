# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl nuke-install``."""

from __future__ import annotations

import shutil
import sysconfig
from pathlib import Path
from typing import Annotated

import typer

from msspl_cli import options
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import make_folder, replacing

EXAMPLES = """[bold]Examples[/bold]

  msspl nuke-install

  msspl nuke-install --dir /studio/nuke

  msspl nuke-install --uninstall
"""

#: Marks our line in the user's file.
MARKER = "# added by msspl nuke-install"


def nuke_install(
    folder: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="Use this Nuke folder, of a user or a site.")
    ] = Path("~/.nuke"),
    uninstall: Annotated[bool, typer.Option("--uninstall", help="Remove the line.")] = False,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
) -> None:
    """Add the gizmo MSSPLFuse to Nuke.

    It adds one line to DIR/init.py, which names the gizmo's folder and msspl-fuse.
    """
    package = Path(__file__).resolve().parents[1]
    gizmo = package / "nuke_gizmo"
    if not gizmo.is_dir():  # an editable installation has it in the source tree
        gizmo = package.parents[1] / "nuke_gizmo"
    target = folder.expanduser() / "init.py"
    # A program that the environment or a knob names has priority.
    program = find_msspl_fuse()
    environment = f'os.environ.setdefault("MSSPL_FUSE", {Path(program).as_posix()!r}); ' if program else ""
    line = f"import os, nuke; {environment}nuke.pluginAddPath({gizmo.as_posix()!r})  {MARKER}"
    changed = set_line(target, None if uninstall else line)
    if uninstall:
        print(f"{target}: {'the line is taken out' if changed else 'there was no line of ours'}")
    else:
        print(f"{target}: {'added' if changed else 'was already there'}: {line}")
        print("Start Nuke: the node is in the toolbar under MSSPL.")


def find_msspl_fuse() -> str | None:
    """Find msspl-fuse beside this Python, or else on the path: hosts seldom run in an activated environment."""
    return shutil.which("msspl-fuse", path=sysconfig.get_path("scripts")) or shutil.which("msspl-fuse")


def set_line(path: Path, line: str | None) -> bool:
    """Make ``line`` our only line in a file, at its end. All other bytes stay.

    The file need not exist. The line ends with ``MARKER``; None removes it. Return whether the file changed.
    """
    # Nuke makes ~/.nuke when it starts for the first time. Another folder may be a slip.
    if not path.parent.is_dir() and (path.parent.name != ".nuke" or not path.parent.parent.is_dir()):
        raise InputError(f"{path.parent}: no such folder; make it, or name another one with --dir")
    try:
        before = path.read_bytes() if path.exists() else b""
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror}); nothing was changed") from error
    newline = b"\r\n" if b"\r\n" in before else b"\n"
    kept = b"".join(row for row in before.splitlines(keepends=True) if not row.rstrip().endswith(MARKER.encode()))
    after = kept
    if line is not None:
        after += (newline if kept and not kept.endswith(b"\n") else b"") + line.encode() + newline
    if after == before:
        return False
    make_folder(path.parent)
    with replacing(path, overwrite=True) as temporary:
        temporary.write_bytes(after)
    return True
