# SPDX-License-Identifier: Apache-2.0
"""Measure milliseconds a frame on an NVIDIA GPU: our models, and Open Image Denoise (OIDN) on its CUDA device.

    python -m research.benchmarks.gpu --table research/benchmarks/results/gpu.csv

Inputs and outputs lie in the GPU's memory, so no copies are timed; ``with_copies_ms`` has them for our models. OIDN is
called plainly, with the small networks ("fast"), and as its documentation recommends (albedo and normal prefiltered).
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import numpy as np

from research.benchmarks import results, timer
from research.benchmarks.results import Row

#: Height and width of the frames. The second is 1080p, padded to what the models take.
SIZES = ((1024, 1024), (1088, 1920))
MODELS = ("joint-small-x2", "joint-x2", "joint-large-x2", "joint-small-x4", "joint-x4", "joint-large-x4")
OIDN = {"OIDN fast": "fast", "OIDN": "high", "OIDN prefiltered": "high"}
REPEATS = 20


def median_ms(call: Callable[[], Any], wait: Callable[[], Any]) -> float:
    """Return the median time of a call, after three others."""
    return 1000 * statistics.median(timer.seconds_of(call, REPEATS, 3, wait))


def time_model(name: str, height: int, width: int) -> dict[str, float]:
    """Time one of our models for a frame."""
    import onnxruntime as ort
    import torch

    from oiio_msspl.model.catalogue import WEIGHTS
    from oiio_msspl.model.devices import GPU_FOLDER

    path = WEIGHTS / GPU_FOLDER / f"{name}.onnx"
    ort.preload_dlls()
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.enable_mem_pattern = False
    network = ort.InferenceSession(str(path), options, providers=["CUDAExecutionProvider", "CPUExecutionProvider"])
    if "CUDAExecutionProvider" not in network.get_providers():
        raise SystemExit(f"{name}: onnxruntime can't use CUDA: {network.get_providers()}")
    scale = int(name.rpartition("x")[2])
    sizes = {"H": height, "W": width, "h": height // scale, "w": width // scale}
    rng = np.random.default_rng(0)
    feed, binding = {}, network.io_binding()
    for given in network.get_inputs():
        shape = [sizes[side] if isinstance(side, str) else side for side in given.shape]
        scalar = 1.0 if given.name == "exposure" else 0.5
        feed[given.name] = rng.random(shape, np.float32) if shape else np.asarray(scalar, np.float32)
        value = ort.OrtValue.ortvalue_from_numpy(feed[given.name], "cuda" if shape else "cpu", 0)
        binding.bind_ortvalue_input(given.name, value)
    binding.bind_output("fused", "cuda")
    on_gpu = median_ms(lambda: network.run_with_iobinding(binding), torch.cuda.synchronize)
    copies = median_ms(lambda: network.run(["fused"], feed), torch.cuda.synchronize)
    return {"ms": on_gpu, "with_copies_ms": copies}


def time_oidn(name: str, height: int, width: int) -> dict[str, float]:
    """Time OIDN's filters for a frame."""
    import pyoidn

    device = pyoidn.Device(pyoidn.OIDN_DEVICE_TYPE_CUDA)
    device.commit()
    rng = np.random.default_rng(0)
    buffers = {}
    for key in ("color", "albedo", "normal", "clean albedo", "clean normal", "result"):
        pixels = rng.random((height, width, 3), np.float32)
        buffers[key] = pyoidn.Buffer(device, pixels.nbytes, storage=pyoidn.OIDN_STORAGE_DEVICE)
        buffers[key].write(0, pixels.nbytes, pixels)

    def built(inputs: dict[str, str], output: str, **flags: bool) -> Any:
        """Return a filter that reads and writes the named pictures."""
        oidn_filter = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
        oidn_filter.set_quality(getattr(pyoidn, f"OIDN_QUALITY_{OIDN[name].upper()}"))
        for role, key in {**inputs, "output": output}.items():
            oidn_filter.set_image(role, buffers[key], pyoidn.OIDN_FORMAT_FLOAT3, width, height)
        for flag, value in flags.items():
            oidn_filter.set_bool(flag, value)
        oidn_filter.set_float("inputScale", 1.0)
        oidn_filter.commit()
        return oidn_filter

    clean = "clean " if name == "OIDN prefiltered" else ""
    layers = {layer: clean + layer for layer in ("albedo", "normal")}
    filters = [built({layer: layer}, result) for layer, result in layers.items() if clean]
    filters.append(built({"color": "color", **layers}, "result", hdr=True, cleanAux=bool(clean)))

    def run() -> None:
        for oidn_filter in filters:
            oidn_filter.execute_async()

    elapsed = median_ms(run, device.wait)
    if error := device.get_error():
        raise SystemExit(f"{name}: {error}")
    return {"ms": elapsed}


def main() -> None:
    args = results.parser(__doc__).parse_args()
    import torch

    rows: list[Row] = []
    for height, width in SIZES:
        key = {"size": f"{width} x {height}", "machine": torch.cuda.get_device_name()}
        rows += [key | {"method": name, **time_oidn(name, height, width)} for name in OIDN]
        rows += [{**key, "method": name, "model": f"gpu/{name}", **time_model(name, height, width)} for name in MODELS]
    results.show(rows, args.table)


if __name__ == "__main__":
    main()
