# SPDX-License-Identifier: Apache-2.0
"""Exceptions whose message is one sentence for the user: the value seen, where, and what to do."""

from __future__ import annotations

import errno
import os
import unicodedata


class MssplError(Exception):
    """A failure that the caller could not have avoided (exit code 1)."""

    exit_code = 1


class InputError(MssplError):
    """A mistake of the caller: a file, an option or a pair that can't be used (exit code 2)."""

    exit_code = 2


#: Unicode categories that control a terminal or can't be encoded: control characters, separators of lines and
#: paragraphs, and lone surrogates, which Python reads for bytes that are not UTF-8.
_UNSAFE = {"Cc", "Zl", "Zp", "Cs"}
#: Characters that reverse the direction of the text after them.
_DIRECTIONS = frozenset("\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def printable(text: str) -> str:
    """Return text on one line, with control characters as escapes such as ``\\x1b``.

    Names in a file may hold line breaks that forge a line of the farm's protocol, or terminal commands. So all messages
    pass through here before they are printed.
    """
    if text.isprintable():
        return text
    return "".join(
        char.encode("unicode_escape").decode() if unicodedata.category(char) in _UNSAFE or char in _DIRECTIONS else char
        for char in text
    )


#: Errors of the file system for a path that the caller can change.
_REFUSED = {errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOENT, errno.ENOTDIR}
#: The disk, or the user's share of it, is full.
_FULL = {errno.ENOSPC, errno.EDQUOT}


def explain(error: Exception) -> tuple[str, int]:
    """Return one sentence and an exit code for any exception."""
    if isinstance(error, MssplError):
        return str(error), error.exit_code
    if isinstance(error, MemoryError):
        return "out of memory; try a smaller --max-memory", 1
    if isinstance(error, OSError):
        path = error.filename2 or error.filename
        name = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        if name and error.errno in _REFUSED:
            return f"{name}: can't be used ({error.strerror})", InputError.exit_code
        if error.errno in _FULL:
            name = name or "standard output or a temporary file"
            return f"{name}: can't be written ({error.strerror}); free space", 1
        if "temporary directory" in str(error.strerror):  # tempfile has tried all folders that it knows
            reason = f"no folder for temporary files can be used ({error.strerror})"
            return f"{reason}; free space, or export TMPDIR=/another/folder", 1
    return f"unexpected {type(error).__name__}: {error} (--debug shows where)", 1
