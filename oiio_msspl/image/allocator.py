# SPDX-License-Identifier: Apache-2.0
"""Tells the C library of Linux what to do with memory that is freed. Other C libraries have no such settings."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

#: Options of ``mallopt``, and their values: one place for the memory of all threads, from which even arrays of 1 GiB
#: come; and free memory that is kept at its end, in bytes.
M_ARENA_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -8, -3, -1
KEEPING = {M_ARENA_MAX: 1, M_MMAP_THRESHOLD: 1 << 30, M_TRIM_THRESHOLD: 1 << 29}


def keep_memory() -> None:
    """Let the memory of large arrays wait for the next ones. This holds for the whole process.

    By default it goes back to the system, which has to clear new pages for the next array.
    """
    for option, value in KEEPING.items():
        _call("mallopt", option, value)


def give_back_memory() -> None:
    """Give free memory back to the system."""
    _call("malloc_trim", 0)


def _call(name: str, *arguments: int) -> None:
    function: Any = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    if function is not None:  # glibc
        function(*arguments)
