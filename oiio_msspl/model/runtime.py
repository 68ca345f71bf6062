# SPDX-License-Identifier: Apache-2.0
"""ONNX Runtime, set up for tiles of frames. No other module imports onnxruntime."""

from __future__ import annotations

import collections
import contextlib
import functools
import io
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from oiio_msspl.errors import InputError
from oiio_msspl.image.allocator import give_back_memory
from oiio_msspl.image.arrays import Array

log = logging.getLogger(__name__)

# ONNX Runtime sends data about its use to Microsoft, unless this is set before it is imported.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

CPU = "CPUExecutionProvider"
#: A loaded network: ``onnxruntime.InferenceSession``, which has no types.
Network = Any
#: An execution provider and its settings.
Provider = tuple[str, dict[str, str]]


def available_providers() -> list[str]:
    """Return the execution providers that the installed onnxruntime was built for."""
    import onnxruntime

    return list(onnxruntime.get_available_providers())


def load_network(
    path: str | Path, threads: int = 0, providers: Sequence[Provider] = ((CPU, {}),), *, optimise: bool = True
) -> Network:
    """Load an ONNX file, or raise InputError.

    Args:
        threads: CPU threads; 0 for one a core.
        providers: each operator goes to the first one that supports it.
        optimise: transform the graph for speed. False loads faster, for a network that does not run.
    """
    import onnxruntime

    if any("CUDA" in name for name, _ in providers):
        _load_cuda()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    # The models of the beauty and of its passes take turns, so both use the same memory.
    _share_memory()
    options.add_session_config_entry("session.use_env_allocators", "1")
    # A memory pattern allocates one block for each tile size, which holds all buffers side by side. The arena reuses
    # buffers within a run: it needs less memory, and the system has no new pages to clear for each tile.
    options.enable_mem_pattern = False
    # Threads that spin while they wait take cores from NumPy and Open Image Denoise.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.record_ep_graph_assignment_info", "1")  # for convolutions()
    if not optimise:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        # With its fallback, onnxruntime would go on without a provider that fails.
        return onnxruntime.InferenceSession(str(path), options, providers=list(providers), enable_fallback=False)
    except Exception as error:
        raise InputError(f"{path}: onnxruntime can't load it ({error})") from error


@functools.cache
def _share_memory() -> None:
    """Make the arena from which all networks of this process allocate memory on the CPU."""
    import onnxruntime

    # A request that fits into no free block gets a block of its own size. In larger blocks, weights of a network that
    # is loaded later would lie beside intermediate results, and such a block is never given back.
    arena = onnxruntime.OrtArenaCfg({"arena_extend_strategy": 1})
    kind = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR
    place = onnxruntime.OrtMemoryInfo("Cpu", kind, 0, onnxruntime.OrtMemType.DEFAULT)
    onnxruntime.create_and_register_allocator(place, arena)


def release_memory(network: Network, feed: Mapping[str, Array], *, to_system: bool) -> None:
    """Run a network on small inputs on the CPU, and give the memory of all networks back.

    Without ``to_system``, the C library may keep it for other arrays, which saves time.
    """
    import onnxruntime

    options = onnxruntime.RunOptions()
    options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
    network.run(None, dict(feed), options)
    if to_system:
        give_back_memory()


def _load_cuda() -> None:
    """Load the CUDA libraries that pip installs. They are in no folder that the system searches."""
    import onnxruntime

    if hasattr(onnxruntime, "preload_dlls"):  # since 1.21
        # It prints the libraries that it does not find. They may be elsewhere.
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            onnxruntime.preload_dlls()
        log.debug("preload_dlls: %s", printed.getvalue())


def convolutions(network: Network) -> dict[str, int]:
    """Return the number of convolutions on each execution provider; empty if the onnxruntime is too old to say."""
    if not hasattr(network, "get_provider_graph_assignment_info"):
        return {}
    counts: collections.Counter[str] = collections.Counter()
    for part in network.get_provider_graph_assignment_info():
        counts[part.ep_name] += sum("Conv" in node.op_type for node in part.get_nodes())
    return {provider: count for provider, count in counts.items() if count}
