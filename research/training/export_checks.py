# SPDX-License-Identifier: Apache-2.0
"""Checks of exported models: how far they are from PyTorch, how far tiles must overlap, and what a file computes."""

from __future__ import annotations

import collections
import timeit
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

from oiio_msspl.model.contract import Contract
from oiio_msspl.model.runtime import load_network
from research.datagen.views import View
from research.training.encoding import log_encode
from research.training.joint import JointFusion
from research.training.mean_denoiser import MeanDenoiser
from research.training.networks import Network, run
from research.training.validation import ValidationPair
from research.training.whole_model import InTorch, example


@torch.inference_mode()
def parity(network: Network, path: Path, denoise: MeanDenoiser | None = None) -> float:
    """Largest difference of an exported file's output from the network's, log-encoded.

    Args:
        denoise: the denoiser of both renders' mean, if the file's contract has one.
    """
    session, contract = load_network(path), Contract.of_file(path)
    model = InTorch(contract, partial(run, network))
    if isinstance(network, JointFusion):
        model = InTorch(contract, network.fuse, denoise)
    block = contract.alignment * -(-6 // contract.alignment)  # at least six pixels
    worst = 0.0
    for height, width in ((4 * block, 4 * block), (3 * block, 5 * block)):
        inputs = example(contract, height, width, seed=height)
        (found,) = session.run(["fused"], {name: values.numpy() for name, values in inputs.items()})
        expected = model(inputs)
        worst = max(worst, float((log_encode(torch.from_numpy(found)) - log_encode(expected)).abs().max()))
    return worst


@torch.inference_mode()
def measure_overlap(network: Network, scale: int, views: list[View], tile: int = 16) -> dict[int, float]:
    """Largest difference between a tile and the same pixels of the whole image, by overlap in LRHS pixels.

    Trained weights use much less than the theoretical receptive field of over 60 LRHS pixels. Differences are
    log-encoded, and the maximum of all views.
    """
    alignment = network.multiple // scale
    differences: dict[int, list[np.ndarray]] = collections.defaultdict(list)
    for view in views:
        pair = ValidationPair.centre(view, scale, view.ref.shape[0])
        lrhs = pair.lrhs
        # Mirrored at its sides, a small view has room for the largest overlap
        margin = 64
        lrhs, hrls = (
            torch.from_numpy(np.pad(image, ((m, m), (m, m), (0, 0)), "symmetric")).permute(2, 0, 1)[None]
            for image, m in ((lrhs, margin), (pair.hrls, margin * scale))
        )
        whole, _ = run(network, lrhs, hrls)
        start = (lrhs.shape[-1] - tile) // 2 // alignment * alignment
        for overlap in (n for n in (4, 8, 12, 16, 24, 32, 48, 64) if n % alignment == 0):
            part, _ = run(network, _square(lrhs, start, tile, overlap), _square(hrls, start, tile, overlap, scale))
            middle = _square(part, overlap, tile, 0, scale)
            difference = middle - _square(whole, start, tile, 0, scale)
            differences[overlap].append(difference.abs().numpy().ravel())
    return {overlap: float(np.concatenate(values).max()) for overlap, values in differences.items()}


def _square(image: torch.Tensor, start: int, size: int, border: int, scale: int = 1) -> torch.Tensor:
    """A square crop with a border, all in LRHS pixels of an image that is ``scale`` times as large."""
    part = slice((start - border) * scale, (start + size + border) * scale)
    return image[..., part, part]


def check_casts(path: Path) -> None:
    """Refuse a file whose weights ONNX Runtime would cast in every run."""
    options = onnxruntime.SessionOptions()
    optimised = path.with_suffix(".optimised")
    options.optimized_model_filepath = str(optimised)
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    counts = collections.Counter(node.op_type for node in onnx.load(optimised).graph.node)
    optimised.unlink()
    print(f"as loaded: {dict(counts)}")
    if counts["Cast"]:
        raise SystemExit(
            f"{path}: {counts['Cast']} casts of weights are left after loading; they would slow every tile"
        )


def describe(path: Path) -> None:
    """Print the operators of a file, and how long ONNX Runtime takes."""
    model = onnx.load(path)
    counts = collections.Counter(node.op_type for node in model.graph.node)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {dict(counts)}")
    session = load_network(path)
    feed = {name: values.numpy() for name, values in example(Contract.of_file(path), 64, 64).items()}
    seconds = min(timeit.repeat(lambda: session.run(None, feed), number=1, repeat=3))
    print(f"64x64 LRHS pixels: {seconds:.2f} s")
