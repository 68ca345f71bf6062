# SPDX-License-Identifier: Apache-2.0
"""ONNX Runtime, set up for frames in tiles: the only module of the package that imports it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    import onnxruntime


CPU = "CPUExecutionProvider"


def available_providers() -> list[str]:
    """Execution providers that the installed onnxruntime was built for."""
    import onnxruntime

    return list(onnxruntime.get_available_providers())


def runtime_version() -> str:
    """Of the installed onnxruntime."""
    import onnxruntime

    return str(onnxruntime.__version__)


def load_network(
    path: str | Path,
    threads: int = 0,
    providers: Sequence[str] = (CPU,),
    initializers: Mapping[str, NDArray[Any]] | None = None,
) -> onnxruntime.InferenceSession:
    """A network, ready to run.

    Args:
        path: an ONNX file.
        threads: of the CPU; 0: one a core.
        providers: execution providers, the first one that can takes a node.
        initializers: by name, those that the file leaves open.

    Raises:
        InputError: it can't be loaded.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    # With a memory pattern, every size of tile gets a block of its own, which holds all its buffers side by side.
    # The arena alone reuses them within a run: less memory, and no pages that the system clears for every tile.
    options.enable_mem_pattern = False
    # Threads that spin while they wait for the next run would take the cores from Open Image Denoise and NumPy
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if initializers:
        values = [onnxruntime.OrtValue.ortvalue_from_numpy(array) for array in initializers.values()]
        options.add_external_initializers(list(initializers), values)
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=list(providers))
    except Exception as error:
        raise InputError(f"{path}: onnxruntime can't load it ({error})") from error
