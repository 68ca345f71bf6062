# SPDX-License-Identifier: Apache-2.0
"""Exceptions whose message is one sentence for the user: what was seen, where, and what to do."""

from __future__ import annotations


class MssplError(Exception):
    """Something failed that the caller could not have avoided (exit code 1)."""

    exit_code = 1


class InputError(MssplError):
    """The caller's mistake: a file, an option or a pair that can't be used (exit code 2)."""

    exit_code = 2


def explain(error: Exception) -> tuple[str, int]:
    """One sentence and an exit code for anything that can go wrong."""
    if isinstance(error, MssplError):
        return str(error), error.exit_code
    if isinstance(error, MemoryError):
        return "out of memory; try a smaller --max-memory", 1
    return f"unexpected {type(error).__name__}: {error} (--debug shows where)", 1
