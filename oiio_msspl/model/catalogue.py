# SPDX-License-Identifier: Apache-2.0
"""The models inside the package, and which one a name means."""

from __future__ import annotations

from pathlib import Path

from oiio_msspl.errors import InputError
from oiio_msspl.model.session import SPREAD, Session

#: Folder of the models: ``NAME.onnx`` for each.
WEIGHTS = Path(__file__).parent / "weights"
#: The name that lets the package choose; the family that it chooses; and the one for noise that a pixel filter has
#: spread over neighbouring pixels (:mod:`oiio_msspl.fusion.noise`).
AUTO, DEFAULT_FAMILY, SPREAD_NOISE_FAMILY = "auto", "joint", f"joint{SPREAD}"


def shipped_models() -> dict[str, Path]:
    """Name (``paper-x4``) -> ONNX file of each model inside the package."""
    return {path.stem: path for path in sorted(WEIGHTS.glob("*.onnx"))}


def find_model(scale: int, name: str | None = None) -> Path:
    """The ONNX file of a model.

    Args:
        scale: 2, 4 or 8.
        name: ``auto`` or None for the default family, a family (``paper``), a model (``paper-x4``), or an ONNX file.
            A model or a family may end in ``SPREAD``: the network is the same.

    Raises:
        InputError: there is no such model.
    """
    models = shipped_models()
    if name in (None, AUTO):
        name = DEFAULT_FAMILY
    network = name.removesuffix(SPREAD)
    for known in (network, f"{network}-x{scale}"):
        if known in models:
            return models[known]
    if Path(name).is_file():
        return Path(name)
    families = dict.fromkeys(known.rpartition("-x")[0] for known in models)
    raise InputError(f"no model {name!r}: neither a file nor one of {', '.join([*families, *models])}")


def load_model(scale: int, name: str | None = None, device: str = "cpu", threads: int = 0) -> Session:
    """Load a model.

    Args:
        scale, name: see :func:`find_model`. A name that ends in ``SPREAD`` is for pairs whose noise the pixel filter
            has spread.
        device, threads: see :class:`oiio_msspl.model.session.Session`.

    Raises:
        InputError: there is no such model, or it can't run on this device.
    """
    path = find_model(scale, name)
    return Session(path, device, threads, spread=name is not None and path != Path(name) and name.endswith(SPREAD))
