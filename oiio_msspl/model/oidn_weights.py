# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise on both renders, for models that read its results: the only module that imports pyoidn, which is
optional.

The HRLS is denoised as anyone would, with its albedo and normal. The LRHS has neither; but its light and the HRLS's are
independent samples of the same scene, so at the LRHS's resolution their mean has less noise than either, and the
HRLS's albedo and normal, averaged over s x s pixels, have hardly any: Open Image Denoise may be told that they are
clean, which is worth 0.8 to 1.5 dB (at x2, where but four pixels are averaged, the LRHS's own are, too, and the albedo
is denoised first, or nothing is told). What it makes of these is
better at that resolution than its result on the HRLS, for a fraction of the time. A network of ours that was made of
Open Image Denoise's does the same without its help.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    pass
import hashlib
import mmap
import struct


#: Names of these networks in the contracts of shipped models -> Open Image Denoise's own names.
LEGACY_NAMES = {"usual": "rt_hdr_alb_nrm", "large": "rt_hdr_calb_cnrm_large"}


def installed_library() -> Path | None:
    """The library of Open Image Denoise that has its weights."""
    import pyoidn

    return next(Path(pyoidn.__file__).parent.rglob("*OpenImageDenoise_core*"), None)


@functools.cache
def known_weights(network: str) -> dict[str, NDArray[np.float16]] | None:
    """Weights of a network of :mod:`oiio_msspl.model.quantised`, from the installed pyoidn; None if it has others."""
    library = installed_library()
    return read_weights(network, library) if library else None


def installed_weights(network: str) -> dict[str, NDArray[np.float16]]:
    """The same for a model that can't do without.

    Raises:
        InputError: pyoidn is not installed, or has others.
    """
    try:
        weights = known_weights(network)
    except (ImportError, OSError) as error:
        raise InputError(
            "this model is made of Open Image Denoise's weights: pip install pyoidn, or choose another --model"
        ) from error
    if weights is None:
        raise InputError(
            "this model is made of the weights of Open Image Denoise 2.5, and the installed pyoidn has others: "
            "install that version of pyoidn, or choose another --model"
        )
    return weights


#: Networks of Open Image Denoise 2.5, with size in bytes and SHA-256 of their weights:
#: HDR colour with albedo and normal (``rt_hdr_alb_nrm``); the larger one for when both of these are free of noise
#: (``rt_hdr_calb_cnrm_large``); and an albedo alone (``rt_alb``).
NETWORKS = {
    "rt_hdr_alb_nrm": (1841160, "e586ef2ff48d7fbb7611986405220ed8fc5c13ca79bfc40be4dc742fbf959e1a"),
    "rt_hdr_calb_cnrm_large": (7698439, "08130cdc4f33b7a513d0073757f089ac830f900613bb5bad72ca42c52b934465"),
    "rt_alb": (1830792, "752c9a8d57884d660ae375a7c853cad8a44f77d559bb282f0ef39f8e758601a4"),
}


def read_weights(name: str, library: Path) -> dict[str, NDArray[np.float16]] | None:
    """A network's weights in a library of Open Image Denoise, or None if it has others.

    The format is TZA 2: a magic number, the position of a table of names, shapes and positions, the tensors.
    """
    size, digest = NETWORKS[name]
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        start = content.find(b"\xd7\x41\x02")
        while start >= 0:
            blob = content[start : start + size]
            if hashlib.sha256(blob).hexdigest() == digest:
                return _tensors(blob)
            start = content.find(b"\xd7\x41\x02", start + 1)
    return None


def _tensors(blob: bytes) -> dict[str, NDArray[np.float16]]:
    position = 0

    def take(form: str) -> tuple:
        nonlocal position
        values = struct.unpack_from(f"<{form}", blob, position)
        position += struct.calcsize(f"<{form}")
        return values

    *_, position = take("HBBQ")
    result = {}
    for _ in range(*take("I")):
        name = take(f"{take('H')[0]}s")[0].decode()
        dimensions = take("B")[0]
        shape = take(f"{dimensions}I")
        take(f"{dimensions + 1}s")  # their order, the type of the values
        (offset,) = take("Q")
        result[name] = np.frombuffer(blob, np.float16, int(np.prod(shape)), offset).reshape(shape)
    return result
