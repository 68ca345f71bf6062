# SPDX-License-Identifier: Apache-2.0
"""The models inside the package, and which one a name means."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from oiio_msspl.errors import InputError
from oiio_msspl.model.oidn import quantised_networks_work

#: Folder of the models: ``NAME.onnx`` for each.
WEIGHTS = Path(__file__).parent / "weights"
#: The name that lets :func:`find_model` choose.
AUTO = "auto"
#: Families that ``auto`` chooses from: the best one needs OIDN's weights and a processor that computes 8-bit networks
#: correctly, the second any pyoidn, the third nothing.
BEST, WITH_OIDN, WITHOUT_OIDN = "joint", "mix", "pyramid"


def shipped_models() -> dict[str, Path]:
    """Name (``paper-x4``) -> ONNX file of each model inside the package."""
    return {path.stem: path for path in sorted(WEIGHTS.glob("*.onnx"))}


def find_model(scale: int, name: str | None = None) -> Path:
    """The ONNX file of a model.

    Args:
        scale: 2, 4 or 8.
        name: ``auto`` or None for the best family that runs here, a family (``paper``), a model (``paper-x4``), or an
            ONNX file.

    Raises:
        InputError: there is no such model.
    """
    models = shipped_models()
    if name in (None, AUTO):
        name = (BEST if quantised_networks_work() else WITH_OIDN) if find_spec("pyoidn") else WITHOUT_OIDN
    for known in (name, f"{name}-x{scale}"):
        if known in models:
            return models[known]
    if Path(name).is_file():
        return Path(name)
    families = dict.fromkeys(known.rpartition("-x")[0] for known in models)
    raise InputError(f"no model {name!r}: neither a file nor one of {', '.join([*families, *models])}")
