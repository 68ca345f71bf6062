# SPDX-License-Identifier: Apache-2.0
"""The models inside the package, and which one a name means."""

from __future__ import annotations

import csv
from pathlib import Path

from oiio_msspl.errors import InputError
from oiio_msspl.model.contract import SCALES, SPREAD
from oiio_msspl.model.session import Session

#: Folder of the models: ``NAME.onnx`` for each.
WEIGHTS = Path(__file__).parent / "weights"
#: Table of :func:`measured`.
MEASURED = WEIGHTS / "measured.csv"
#: The family of models of each quality. From the first to the last, pictures get better and take more time.
QUALITIES = {"fast": "joint-small", "balanced": "joint", "best": "joint-large"}
#: The model that fuses two renders of one size, for passes at half of the frame's resolution. ``-spread`` may follow.
MEAN_MODEL = "mean"
#: The name that stands for the default quality.
AUTO, DEFAULT_QUALITY = "auto", "balanced"


def shipped_models() -> dict[str, Path]:
    """Name (``paper-x4``) -> ONNX file of each model for pairs inside the package."""
    return {path.stem: path for path in sorted(WEIGHTS.glob("*.onnx")) if not path.stem.endswith("-x1")}


def measured() -> dict[str, dict[str, float]]:
    """Accuracy and time of the shipped models, by name, as ``research.benchmarks.tables`` wrote them.

    PSNR in dB and RelMSE are means of the development scenes. The time is a multiple of Open Image Denoise's. What was
    not measured is absent.
    """
    with MEASURED.open(newline="") as file:
        return {
            row.pop("model"): {name: float(value) for name, value in row.items() if value}
            for row in csv.DictReader(file)
        }


def family_of(name: str | None) -> str | None:
    """The family that a quality, ``auto`` or None stands for; None for any other name, which is a model already."""
    return QUALITIES.get(DEFAULT_QUALITY if name in (None, AUTO) else name)


def for_spread_noise(name: str) -> str | None:
    """The family that was trained for noise that a pixel filter has spread, and is otherwise as a family or a shipped
    model; None if there is none, or if the model itself was."""
    models = shipped_models()
    family = name.rpartition("-x")[0] if name in models else name
    return family + SPREAD if any(known.startswith(f"{family}{SPREAD}-x") for known in models) else None


def find_model(scale: int, name: str | None = None) -> Path:
    """The ONNX file of a model.

    Args:
        scale: 2, 4 or 8.
        name: a quality, ``auto`` or None for the default quality, a family (``paper``), a model (``paper-x4``), or an
            ONNX file.

    Raises:
        InputError: there is no such model.
    """
    models = shipped_models()
    name = family_of(name) or name
    assert name is not None
    for known in (name, f"{name}-x{scale}"):
        if known in models:
            return models[known]
    if Path(name).is_file():
        return Path(name)
    if scale not in SCALES:
        raise InputError(f"there is no model for x{scale}; the scales are {', '.join(f'x{each}' for each in SCALES)}")
    families = dict.fromkeys(known.rpartition("-x")[0] for known in models)
    raise InputError(f"no model {name!r}: neither a file nor one of {', '.join([*families, *models])}")


def load_model(scale: int, name: str | None = None, device: str = "cpu", threads: int = 0) -> Session:
    """Load a model.

    Args:
        scale, name: see :func:`find_model`.
        device, threads: see :class:`oiio_msspl.model.session.Session`.

    Raises:
        InputError: there is no such model, or it can't run on this device.
    """
    path = find_model(scale, name)
    # The best models would take too long for every layer
    of_layers = {WEIGHTS / f"{QUALITIES['best']}{noise}-x{scale}.onnx": noise for noise in ("", SPREAD)}
    if path not in of_layers:
        return Session(path, device, threads)
    family = QUALITIES["fast"] + of_layers[path]
    half = WEIGHTS / f"{MEAN_MODEL}{of_layers[path]}-x1.onnx" if scale == 2 else None
    return Session(path, device, threads, layers=find_model(scale, family), half_layers=half)
