# SPDX-License-Identifier: Apache-2.0
"""Devices: their execution providers, the settings of these, and the file of a network that a device runs.

A network has a file for CPUs and may have one for GPUs. Convolutions in the first compute in 8 bits, for which GPUs
have no operators, and in half floats in the second. The rest of both is float32.
"""

from __future__ import annotations

import os
from importlib.metadata import distributions
from pathlib import Path

from oiio_msspl.errors import InputError
from oiio_msspl.model.runtime import CPU, Provider, available_providers

#: ``--device`` name -> onnxruntime execution provider.
PROVIDERS = {
    "cpu": CPU,
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "directml": "DmlExecutionProvider",
}
#: The package with the execution provider of a device.
PACKAGES = {
    "cuda": "onnxruntime-gpu",
    "tensorrt": "onnxruntime-gpu",
    "openvino": "onnxruntime-openvino",
    "coreml": "onnxruntime",
    "directml": "onnxruntime-directml",
}
#: Devices that have an operator for every convolution in half floats. A convolution that stays on the CPU is an error.
COMPLETE = ("cuda", "tensorrt")
#: Folder of the files for GPUs, beside the files for CPUs and with the same names.
GPU_FOLDER = "gpu"


def usable_devices() -> list[str]:
    """Return the keys of ``PROVIDERS`` that the installed onnxruntime was built for."""
    available = available_providers()
    return [device for device, provider in PROVIDERS.items() if provider in available]


def require_device(device: str) -> None:
    """Raise InputError if there is no such device, or the installed onnxruntime was not built for it."""
    if device not in PROVIDERS:
        raise InputError(f"--device {device!r}: use one of {', '.join(PROVIDERS)}")
    usable = usable_devices()
    if device in usable:
        return
    package, installed = PACKAGES[device], {each.name for each in distributions()}
    if package != "onnxruntime" and {package, "onnxruntime"} <= installed:
        raise InputError(
            f"--device {device}: the package onnxruntime has overwritten {package}; uninstall both with pip, then "
            f"install {package} again"
        )
    raise InputError(
        f"--device {device}: the installed onnxruntime has no {PROVIDERS[device]}; usable here: {', '.join(usable)}; "
        f"to add {device}, install {package} in its place"
    )


def providers(device: str) -> list[Provider]:
    """Return the execution providers of a device with their settings. The first that supports an operator runs it."""
    settings = {
        # Without these, OpenVINO uses the CPU, and GPUs compute the log curve in half floats, which overflow.
        "openvino": {"device_type": "AUTO:GPU,CPU", "precision": "ACCURACY"},
        # The older format, NeuralNetwork, has fewer operators.
        "coreml": {"ModelFormat": "MLProgram"},
    }
    if device == "tensorrt":
        # Building an engine takes minutes, so it is stored for the next run.
        base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
        folder = Path(base, "oiio_msspl", "tensorrt")
        folder.mkdir(parents=True, exist_ok=True)
        settings[device] = {"trt_engine_cache_enable": "1", "trt_timing_cache_enable": "1"}
        settings[device]["trt_engine_cache_path"] = str(folder)
    names = {"tensorrt": ["tensorrt", "cuda"], "cpu": []}.get(device, [device])
    return [*((PROVIDERS[name], settings.get(name, {})) for name in names), (CPU, {})]


def gpu_file(path: Path) -> Path | None:
    """Return the file for GPUs of a network, given its file for CPUs; None if it has none."""
    file = path.parent / GPU_FOLDER / path.name
    return file if file.is_file() else None


def file_for(path: Path, device: str) -> Path:
    """Return the file of a network that a device runs, given its file for CPUs."""
    return path if device == "cpu" else gpu_file(path) or path
