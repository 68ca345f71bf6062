# SPDX-License-Identifier: Apache-2.0
"""Holds the command lines ``msspl-fuse``, ``msspl-render`` and ``msspl``.

A command parses, calls one library function, and prints.
"""

import os

from oiio_msspl.image.allocator import keep_memory

# The threads of NumPy's linear algebra keep a core busy for 0.2 s after each use. Nothing here is large enough to gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

keep_memory()
