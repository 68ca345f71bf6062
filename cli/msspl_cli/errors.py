# SPDX-License-Identifier: Apache-2.0
"""Turns an exception into one sentence and an exit code: 2 for the caller's mistake, 1 for any other failure."""

from __future__ import annotations

import signal
import sys

import typer

from oiio_msspl.errors import explain, printable


def run(app: typer.Typer) -> None:
    """Run a program and exit. Typer itself ends wrong usage with exit code 2. ``--debug`` shows the traceback."""
    # A farm ends a job with SIGTERM. Exit as on an exception, so that temporary files are removed.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        app()
    except Exception as error:
        if "--debug" in sys.argv:
            raise
        message, code = explain(error)
        print(f"error: {printable(message)}", file=sys.stderr)
        sys.exit(code)
