# SPDX-License-Identifier: Apache-2.0
"""Weights of Open Image Denoise's networks, read from the library that the user has installed.

Training of the `joint` network begins from these weights, and its checkpoints store the difference to them. So it
needs exactly these: a digest identifies them.
"""

from __future__ import annotations

import functools
import hashlib
import mmap
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.errors import InputError

#: Networks of Open Image Denoise 2.5 by its own names, with the size in bytes and the SHA-256 of their weights: HDR
#: colour with albedo and normal, in two sizes; with noise-free albedo and normal, in two sizes; albedo alone; normal
#: alone.
NETWORKS = {
    "rt_hdr_alb_nrm": (1841160, "e586ef2ff48d7fbb7611986405220ed8fc5c13ca79bfc40be4dc742fbf959e1a"),
    "rt_hdr_alb_nrm_small": (641480, "980ea307e7825cae23ed8b1addf8de62ece84b61094795a5631ebf1c91b2e1a7"),
    "rt_hdr_calb_cnrm_small": (641480, "a6c43bfdbff01bdd8a9c777e139720f9e58b872a50c8db07079bddd007482dc5"),
    "rt_hdr_calb_cnrm_large": (7698439, "08130cdc4f33b7a513d0073757f089ac830f900613bb5bad72ca42c52b934465"),
    "rt_alb": (1830792, "752c9a8d57884d660ae375a7c853cad8a44f77d559bb282f0ef39f8e758601a4"),
    "rt_nrm": (1830792, "fb8f7f5571332b602406f88a0b570d809dd3c06aebb530f5d048828f57490bc7"),
}

_TZA_MAGIC = b"\xd7\x41\x02"

Weights = dict[str, NDArray[np.float16]]


@functools.cache
def require_weights(network: str) -> Weights:
    """Read the weights of a key of ``NETWORKS`` by tensor name.

    Raises:
        InputError: pyoidn is not installed, or has other weights.
    """
    try:
        import pyoidn
    except (ImportError, OSError) as error:
        raise InputError(
            "the joint network begins from the weights of Open Image Denoise: pip install pyoidn==2.5.1"
        ) from error
    library = next(Path(pyoidn.__file__).parent.rglob("*OpenImageDenoise_core*"), None)
    weights = read_weights(network, library) if library else None
    if weights is None:
        raise InputError(
            "the joint network begins from the weights of Open Image Denoise 2.5, and the installed pyoidn has others: "
            "pip install pyoidn==2.5.1"
        )
    return weights


def read_weights(network: str, library: Path) -> Weights | None:
    """Find a network's weights in a library file by their digest; None if they are not in it."""
    size, digest = NETWORKS[network]
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        start = content.find(_TZA_MAGIC)
        while start >= 0:
            blob = content[start : start + size]
            if hashlib.sha256(blob).hexdigest() == digest:
                return _read_tza(blob)
            start = content.find(_TZA_MAGIC, start + 1)
    return None


def _read_tza(blob: bytes) -> Weights:
    """Read tensors in Open Image Denoise's TZA 2 format.

    A header with the position of a table; the table has a name, a shape, a layout, a type and a position for each
    tensor.
    """
    position = 0

    def take(form: str) -> tuple[Any, ...]:
        nonlocal position
        values = struct.unpack_from(f"<{form}", blob, position)
        position += struct.calcsize(f"<{form}")
        return values

    *_, position = take("HBBQ")
    tensors = {}
    for _ in range(*take("I")):
        name = take(f"{take('H')[0]}s")[0].decode()
        dimensions = take("B")[0]
        shape = take(f"{dimensions}I")
        take(f"{dimensions + 1}s")  # layout and type: always contiguous half floats
        (offset,) = take("Q")
        tensors[name] = np.frombuffer(blob, np.float16, int(np.prod(shape)), offset).reshape(shape)
    return tensors
