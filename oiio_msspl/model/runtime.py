# SPDX-License-Identifier: Apache-2.0
"""ONNX Runtime, set up for tiles of frames. No other module imports onnxruntime."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    import onnxruntime

CPU = "CPUExecutionProvider"


def available_providers() -> list[str]:
    """Execution providers that the installed onnxruntime was built for."""
    import onnxruntime

    return list(onnxruntime.get_available_providers())


def runtime_version() -> str:
    """Version of the installed onnxruntime."""
    import onnxruntime

    return str(onnxruntime.__version__)


def load_network(
    path: str | Path, threads: int = 0, providers: Sequence[str] = (CPU,), *, optimise: bool = True
) -> onnxruntime.InferenceSession:
    """Load a network.

    Args:
        path: an ONNX file.
        threads: CPU threads; 0 for one a core.
        providers: execution providers; each node goes to the first one that supports it.
        optimise: transform the graph for speed. Loading is faster without it, for a network that does not run.

    Raises:
        InputError: it cannot be loaded.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    # A memory pattern allocates one block for each tile size, which holds all buffers side by side. The arena reuses
    # buffers within a run: it needs less memory, and the system has no new pages to clear for each tile.
    options.enable_mem_pattern = False
    # Threads that spin while they wait take cores from NumPy and Open Image Denoise.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Processors without VNNI add two products of 8 bits in 16 bits, which overflows. This lets them use other, slower
    # instructions that do not; other processors ignore it.
    options.add_session_config_entry("session.x64quantprecision", "1")
    if not optimise:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=list(providers))
    except Exception as error:
        raise InputError(f"{path}: onnxruntime can't load it ({error})") from error
