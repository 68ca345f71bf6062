# SPDX-License-Identifier: Apache-2.0
"""Holds the command lines ``msspl-fuse``, ``msspl-render`` and ``msspl``.

A command parses, calls one library function, and prints.
"""

import ctypes
import os
import sys

# The threads of NumPy's linear algebra keep a core busy for 0.2 s after each use. Nothing here is large enough to gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _keep_memory() -> None:
    """Let the C library keep the memory of large arrays for the next ones, in one place for all threads.

    By default it gives each back to the system, which has to clear new pages for the next one.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:  # musl has none
        threads, from_system, to_system = -8, -3, -1  # M_ARENA_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD
        for option, value in ((threads, 1), (from_system, 1 << 30), (to_system, 1 << 29)):
            mallopt(option, value)


_keep_memory()
