# SPDX-License-Identifier: Apache-2.0
"""Checks of exported models: how far they are from PyTorch, and that no weights are cast in every run."""

from __future__ import annotations

import collections
from functools import partial
from pathlib import Path

import onnx
import onnxruntime
import torch

from oiio_msspl.model.contract import Contract
from oiio_msspl.model.runtime import load_network
from research.training.denoisers import MeanDenoiser
from research.training.encoding import log_encode
from research.training.joint import JointFusion
from research.training.networks import Network, run
from research.training.whole_model import InTorch, example


@torch.inference_mode()
def parity(network: Network, path: Path, denoise: MeanDenoiser | None = None) -> float:
    """Return the largest difference of an exported file's output from the network's, log-encoded.

    Args:
        denoise: the denoiser of both renders' mean, if the file's contract has one.
    """
    session, contract = load_network(path), Contract.of_file(path)
    fuse = network.fuse if isinstance(network, JointFusion) else partial(run, network)
    model = InTorch(contract, fuse, denoise)
    block = contract.alignment * -(-6 // contract.alignment)  # at least six pixels
    worst = 0.0
    for height, width in ((4 * block, 4 * block), (3 * block, 5 * block)):
        inputs = example(contract, height, width, seed=height)
        (fused,) = session.run(["fused"], {name: values.numpy() for name, values in inputs.items()})
        worst = max(worst, float((log_encode(torch.from_numpy(fused)) - log_encode(model(inputs))).abs().max()))
    return worst


def check_casts(path: Path) -> None:
    """Refuse a file whose weights ONNX Runtime would cast in every run."""
    options = onnxruntime.SessionOptions()
    optimised = path.with_suffix(".optimised")
    options.optimized_model_filepath = str(optimised)
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    counts = collections.Counter(node.op_type for node in onnx.load(optimised).graph.node)
    optimised.unlink()
    if counts["Cast"]:
        raise SystemExit(
            f"{path}: {counts['Cast']} casts of weights are left after loading; they would slow every tile"
        )
