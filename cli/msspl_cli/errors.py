# SPDX-License-Identifier: Apache-2.0
"""Turns an exception into one sentence and an exit code: 2 for the caller's mistake, 1 for any other failure."""

from __future__ import annotations

import io
import os
import signal
import sys
import traceback

import typer

from oiio_msspl.errors import explain, printable
from oiio_msspl.image.parallel import end_pools


def run(app: typer.Typer) -> None:
    """Run a program and exit. Typer itself ends wrong usage with exit code 2. ``--debug`` shows the traceback."""
    _exit_on_signals()
    _make_streams_usable()
    try:
        app()
    except Exception as error:
        if "--debug" in sys.argv:
            traceback.print_exc()
        message, code = explain(error)
        print(f"error: {printable(message)}", file=sys.stderr)
        sys.exit(code)
    finally:
        end_pools()


def _make_streams_usable() -> None:
    """Escape characters that a stream's encoding lacks, and discard what goes to a closed stream (daemons have one)."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - it lives as long as the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _exit_on_signals() -> None:
    """Exit on a signal as on an exception, so that temporary files are removed and a shot's report is written.

    A farm ends a job with SIGTERM, a terminal that closes sends SIGHUP. Further signals are ignored: they would
    interrupt the clean-up.
    """
    ending = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

    def leave(number: int, _frame: object) -> None:
        for other in ending:
            signal.signal(other, signal.SIG_IGN)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)

    for number in ending:
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, leave)
