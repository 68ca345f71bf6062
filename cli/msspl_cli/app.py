# SPDX-License-Identifier: Apache-2.0
"""Builds the programs. Commands import heavy modules when they run, so that ``--help`` answers at once."""

from __future__ import annotations

from functools import partial
from typing import Any

import typer

from msspl_cli import options
from msspl_cli.commands import blender_install, check, compare, fuse, inspect, models, nuke_install, render, submit
from msspl_cli.errors import run

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
def _main(version: options.Version = False) -> None:
    """Inspect renders, list models and compare results. To fuse a pair, see [bold]msspl-fuse --help[/bold]."""


for module in (inspect, check, models, compare, fuse, submit, blender_install, nuke_install):
    name = module.__name__.rpartition(".")[2]
    app.command(name.replace("_", "-"), epilog=module.EXAMPLES)(getattr(module, name))


#: The programs.
msspl_fuse, msspl_render, msspl = (partial(run, each) for each in (fuse_app, render_app, app))
