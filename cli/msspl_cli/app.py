# SPDX-License-Identifier: Apache-2.0
"""Builds the programs. Commands import heavy modules when they run, so that ``--help`` answers at once."""

from __future__ import annotations

from typing import Any

import typer

from msspl_cli.commands import blender_install, check, compare, fuse, inspect, models, nuke_install, render, submit
from msspl_cli.errors import run
from oiio_msspl._version import full_version

_SETTINGS: dict[str, Any] = {
    "add_completion": False,
    "rich_markup_mode": "rich",
    "pretty_exceptions_enable": False,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}

fuse_app = typer.Typer(**_SETTINGS)
fuse_app.command(epilog=fuse.EXAMPLES)(fuse.fuse)

render_app = typer.Typer(**_SETTINGS)
render_app.command(epilog=render.EXAMPLES)(render.render)

app = typer.Typer(no_args_is_help=True, **_SETTINGS)


@app.callback(invoke_without_command=True)
def _main(version: bool = typer.Option(False, "--version", help="Print the version and exit.")) -> None:
    """Inspect renders, list models and compare results. To fuse a pair, see [bold]msspl-fuse --help[/bold]."""
    if version:
        print(full_version())
        raise typer.Exit


app.command(epilog=inspect.EXAMPLES)(inspect.inspect)
app.command(epilog=check.EXAMPLES)(check.check)
app.command(epilog=models.EXAMPLES)(models.models)
app.command(epilog=compare.EXAMPLES)(compare.compare)
app.command(epilog=fuse.EXAMPLES)(fuse.fuse)
app.command(epilog=submit.EXAMPLES)(submit.submit)
app.command("blender-install", epilog=blender_install.EXAMPLES)(blender_install.blender_install)
app.command("nuke-install", epilog=nuke_install.EXAMPLES)(nuke_install.nuke_install)


def msspl_fuse() -> None:
    run(fuse_app)


def msspl_render() -> None:
    run(render_app)


def msspl() -> None:
    run(app)
