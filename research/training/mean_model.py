# SPDX-License-Identifier: Apache-2.0
"""Cut the denoiser of both renders' mean out of an exported model, as a model of its own.

    python -m research.training.mean_model oiio_msspl/model/weights/joint-small-x2.onnx

This writes ``mean-x1.onnx`` beside the file for CPUs and, in the folder `gpu`, beside that for GPUs. It reads two
renders of the same size, and returns their denoised mean. Passes of a pair at x2 are fused by it at half of the frame's
resolution (:mod:`oiio_msspl.fusion.passes.network`). It has the contract of any other model, with a scale of 1, and the
weights of the model that it is cut from.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import onnx
from onnx import helper

from oiio_msspl.model.catalogue import MEAN_MODEL
from oiio_msspl.model.contract import METADATA_KEY, SPREAD, Contract
from oiio_msspl.model.devices import gpu_file
from research.training.tracing import image_info

#: Peak memory of a tile in bytes for each of its pixels.
BYTES_PER_PIXEL = 800
#: In the graph of a model: the denoised mean, what is fused, and the result.
DENOISED, ENCODED, FUSED = "mean.denoised", "encoded.fused", "fused"


def mean_model(path: Path) -> onnx.ModelProto:
    """Cut the model out of the file ``path`` of a `joint` model at x2."""
    model = onnx.load(path, load_external_data=False)
    graph, contract = model.graph, Contract.of_file(path)
    # Both renders have the same size, so nothing is averaged. The denoised mean takes the place of what is fused.
    same = {node.output[0]: node.input[0] for node in graph.node if node.op_type == "AveragePool"} | {ENCODED: DENOISED}
    for node in graph.node:
        node.input[:] = [same.get(name, name) for name in node.input]
    needed = {FUSED}
    nodes: list[onnx.NodeProto] = []
    for node in reversed(graph.node):
        if needed & set(node.output):
            needed |= set(node.input)
            nodes.insert(0, node)
    tensors = [tensor for tensor in graph.initializer if tensor.name in needed]
    inputs = [image_info(name, channels, "hw") for name, channels in contract.inputs.items()]
    outputs = [image_info(FUSED, 3, "hw")]
    provenance = contract.provenance | {"cut_from": contract.name}
    name = f"{MEAN_MODEL}{SPREAD if contract.denoiser.endswith(SPREAD) else ''}-x1"
    contract = replace(contract, name=name, scale=1, bytes_per_pixel=BYTES_PER_PIXEL, provenance=provenance)
    graph.CopyFrom(helper.make_graph(nodes, name, inputs, outputs, tensors))
    helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="file for CPUs of a joint model at x2 with a denoiser of its own")
    args = parser.parse_args()
    for path in filter(None, (args.model, gpu_file(args.model))):
        model = mean_model(path)
        file = path.with_name(f"{model.graph.name}.onnx")
        onnx.save(model, file)
        onnx.checker.check_model(file, full_check=True)
        print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
