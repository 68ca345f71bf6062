# SPDX-License-Identifier: Apache-2.0
"""Training views rendered with Mitsuba 3 from procedural scenes, see :mod:`research.datagen.views` for the files.

    python -m research.datagen.mitsuba --out VIEWS --seeds 0:400

``scenes`` builds the scene of a seed from ``materials`` and ``assets``. ``trace`` is a path tracer that returns every
sample on its own. ``render`` chooses cameras and renders views.
"""

from __future__ import annotations

import ctypes.util
import os
from typing import Any

VARIANT = "llvm_ad_rgb"


def start(threads: int = 1, variant: str = VARIANT) -> Any:
    """Import Mitsuba, set its variant and number of threads, and return the module.

    Dr.Jit uses the LLVM of `DRJIT_LIBLLVM_PATH`, else Debian's LLVM 19 if it is installed, else the one that it finds.

    Raises:
        ImportError: Mitsuba is not installed.
    """
    # Debian has no plain "libLLVM.so", which is what Dr.Jit looks for
    if "DRJIT_LIBLLVM_PATH" not in os.environ and (llvm := ctypes.util.find_library("LLVM-19")):
        os.environ["DRJIT_LIBLLVM_PATH"] = llvm
    import drjit
    import mitsuba

    mitsuba.set_variant(variant)
    drjit.set_thread_count(threads)
    return mitsuba
