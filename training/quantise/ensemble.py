# SPDX-License-Identifier: Apache-2.0
"""Write the ``ensemble`` models in 8 bits: ``joint`` and Open Image Denoise's networks first, their weights last.

    python -m training.quantise.ensemble VIEWS --out RUN
    python -m training.quantise.ensemble VIEWS --out RUN --export
    python -m training.quantise.ensemble VIEWS --out RUN2 --export --spread

The first command quantises Open Image Denoise's networks on training views, joins them with the files of ``joint``, and
stores the results of many training pairs, with which :mod:`training.ensemble` trains. It continues where it stopped.
The second adds what was trained, and writes the files into the package. The third writes ``ensemble-spread``, which
needs no such pairs.
"""

from __future__ import annotations

import argparse
import datetime
import zlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper
from torch import Tensor, nn
from torch.nn import functional as F

from datagen.views import Folder
from oiio_msspl.model.catalogue import WEIGHTS, find_model
from oiio_msspl.model.contract import SCALES, SPREAD, Contract
from oiio_msspl.model.runtime import load_network
from training import checkpoints
from training.data import Sampling, draw, fixed_batches, view_tensors
from training.encoding import log_to_pu
from training.ensemble import BandWeights, EnsembleFusion, load
from training.export import MEMORY
from training.joint import JointFusion
from training.large import LargeDenoiser
from training.mean_denoiser import with_denoised_mean
from training.oidn import ALBEDO_BASE, LARGE_HDR, NORMAL_BASE
from training.quantise.codes import log_encoded_of_code, sliced
from training.quantise.gptq import Activations, CodeLayout, concatenated, sliced_layout
from training.quantise.graph import Graph, Nodes
from training.quantise.layers import Networks, add_layers, fitted, quantised, varied
from training.tracing import shuffle, traced, unshuffle
from training.whole_model import CHECKPOINTS, network_of, quantised_denoiser, save, whole_model

#: Calibration images of each network, and their width.
IMAGES, PATCH = 36, 256
#: Slices of the colour, and of the denoised colour.
COLOUR_SLICES, COLOUR_SLICES_OUT = 3, 10
#: Stored pairs for training and validation.
PAIRS = {"train": 480, "validation": 36}
#: The models' name; all scales share the weights of the networks.
FAMILY = "ensemble"

#: Outputs of the graph without the weights.
RESULTS = ("joint", "large", "albedo", "normal", "joint_error")


# Open Image Denoise's networks in 8 bits


def colour_codes(colour: Tensor, *layers: Tensor) -> Activations:
    """A log-encoded colour and layers in [0, 1], (1, 3, H, W), as the input of the large network."""
    plain = CodeLayout(torch.full((3 * len(layers),), 1 / 255), torch.arange(3, 3 + 3 * len(layers)))
    layout = concatenated(sliced_layout(COLOUR_SLICES, 0), plain)
    rounded = [(image.clamp(0, 1) * 255).round() for image in layers]
    codes = torch.cat([sliced(log_to_pu(colour), COLOUR_SLICES), *rounded], dim=1)
    codes = F.pad(codes, (0, 0, 0, 0, 0, len(layout.scale) - codes.shape[1]))
    return Activations([layout.dequantise(codes[0])[None]], [codes], layout)


def fit_networks(ensemble: EnsembleFusion, pairs: Sequence[tuple[Tensor, Tensor]]) -> Networks:
    """Quantise the three networks on encoded pairs, the arguments of the ensemble."""
    networks, clean = quantised(ensemble.layers, [pair[1] for pair in pairs])
    inputs = [[pair[1][:, :3], *layers] for pair, layers in zip(pairs, clean, strict=True)]
    if ensemble.large.reads_joint:
        for images, pair in zip(inputs, pairs, strict=True):
            images.append(log_to_pu(ensemble.joint.fuse(*pair)[0]))
    colour, _ = fitted(ensemble.large, COLOUR_SLICES_OUT, [colour_codes(*images) for images in inputs])
    return networks | {"colour": Graph(colour).model()}


# The graphs


class Results(Nodes):
    """The graph up to the two results: inputs ``lrhs`` and ``hrls``, outputs :data:`RESULTS`."""

    def __init__(self, scale: int, networks: dict[str, onnx.ModelProto], noise: str = "") -> None:
        super().__init__()
        self.noise = noise
        self.initializers["unseen"] = log_encoded_of_code(COLOUR_SLICES_OUT)
        joint = network_of(onnx.load(find_model(scale, f"joint{noise}")))
        self.embed(joint, "first.", {"fused": "joint", "log_error": "joint_error"})
        colour, albedo, normal = self.split("hrls", {"colour": 3, "albedo": 3, "normal": 3})
        zeros = self.zeros(colour)
        add_layers(self, networks, albedo, normal, zeros)
        slices = self.slices(self.log_to_pu(colour), COLOUR_SLICES)
        step = self.constant("step", np.float32(1 / 255))
        layers = ["albedo", "normal", *([self.log_to_pu("joint")] if noise else [])]
        rounded = [self.add("QuantizeLinear", [image, step, "zero"], f"{image}.rounded") for image in layers]
        # As many as :func:`training.quantise.gptq.concatenated` appends
        packed = self.packed([*slices, *rounded, *[zeros] * (2 if noise else 1)], "colour.layers")
        pixels = self.look_up("unseen", self._run(networks["colour"], "colour", packed), "large.pixels")
        self.add("Transpose", [pixels], "large", perm=[0, 3, 1, 2])

    def _run(self, network: onnx.ModelProto, name: str, layers: str) -> str:
        """Add a network that reads the codes ``layers``; return its sums of codes."""
        self.embed(network, f"{name}.", {"layers": layers, "codes": f"{name}.codes"})
        return f"{name}.codes"

    def model(self, weights: onnx.ModelProto | None = None) -> onnx.ModelProto:
        """The graph; with ``weights`` (:func:`weights_graph`), the model that ships."""
        info = helper.make_tensor_value_info
        inputs = [info("lrhs", TensorProto.FLOAT, [1, 6, "h", "w"]), info("hrls", TensorProto.FLOAT, [1, 9, "H", "W"])]
        channels = dict.fromkeys(RESULTS, 3) | {"joint_error": 1}
        if weights is not None:
            self.embed(weights, "weights.", {})
            channels = {"fused": 3, "log_error": 1, "albedo": 3, "normal": 3}
        outputs = [info(name, TensorProto.FLOAT, [1, count, "H", "W"]) for name, count in channels.items()]
        return self.finished(FAMILY + self.noise, inputs, outputs)


# The stored pairs


def store_pairs(views: Path, out: Path, joint: JointFusion) -> None:
    """Store the results of random pairs, see :func:`training.ensemble.read_pair`."""
    sessions = {scale: load_network(out / f"results-x{scale}.onnx") for scale in SCALES}
    prepare = with_denoised_mean(joint.mean_denoiser)
    for split, count in PAIRS.items():
        (out / split).mkdir(exist_ok=True)
        tensors = view_tensors(Folder(views), split, torch.device("cpu"))
        for index in range(count):
            scale = SCALES[index % len(SCALES)]
            file = out / split / f"x{scale}-{index:05d}.npz"
            if file.exists():
                continue
            rng = np.random.default_rng([zlib.crc32(split.encode()), index])
            with torch.no_grad():
                batch = draw(tensors, scale, PATCH, 1, rng, Sampling(), prepare)
            feed = {name: batch[name].contiguous().numpy() for name in ("lrhs", "hrls")}
            feed["hrls"] = feed["hrls"][:, :9]
            results = dict(zip(RESULTS, sessions[scale].run(list(RESULTS), feed), strict=True))
            pair = feed | results | {"target": batch["target"].numpy()}
            partial = file.with_suffix(".partial.npz")
            np.savez(partial, **{name: image.astype(np.float16) for name, image in pair.items()})
            partial.rename(file)


def calibration_pairs(views: Path, joint: JointFusion, count: int = IMAGES) -> list[tuple[Tensor, Tensor]]:
    """Encoded pairs of training views, some with other albedos, see :func:`training.quantise.layers.varied`."""
    batches = islice(fixed_batches(views, "train", [2], PATCH, 1, with_denoised_mean(joint.mean_denoiser)), count)
    pairs = [(batch["lrhs"].contiguous(), batch["hrls"][:, :9].contiguous()) for batch in batches]
    return list(zip((lrhs for lrhs, _ in pairs), varied([hrls for _, hrls in pairs]), strict=True))


# The files that ship


def weights_graph(weights: nn.Module, scale: int) -> onnx.ModelProto:
    """The graph of what weighs the results, a part of :class:`training.ensemble.EnsembleFusion`."""
    height, width = 64, 96
    full = {name: torch.rand(1, 3, height * scale, width * scale) for name in ("joint", "large", "albedo", "normal")}
    lrhs, hrls = torch.rand(1, 6, height, width), torch.rand(1, 9, height * scale, width * scale)
    inputs = {**full, "lrhs": lrhs, "hrls": hrls, "joint_error": hrls[:, :1]}
    translations = {torch.ops.aten.pixel_unshuffle.default: unshuffle, torch.ops.aten.pixel_shuffle.default: shuffle}
    return traced(weights, tuple(inputs.values()), list(inputs), ["fused", "log_error"], 16 * scale, translations)


def export(ensemble: EnsembleFusion, networks: dict[str, onnx.ModelProto], noise: str, trained: dict[str, int]) -> None:
    """Write the models into the package."""
    models = {}
    for scale in SCALES:
        contract = Contract.of_file(find_model(scale, f"joint{noise}"))
        name = f"{FAMILY}{noise}-x{scale}"
        provenance = contract.provenance | {
            "network": FAMILY,
            "other_networks": f"Open Image Denoise 2.5.1, {ALBEDO_BASE}, {NORMAL_BASE}, {LARGE_HDR} (Apache-2.0)",
            "trained_weights": trained,
            "date": datetime.date.today().isoformat(),
        }
        contract = replace(contract, name=name, bytes_per_pixel=MEMORY[FAMILY], provenance=provenance)
        graph = Results(scale, networks, noise).model(weights_graph(ensemble.weights, scale))
        models[WEIGHTS / f"{name}.onnx"] = whole_model(graph, contract, quantised_denoiser(contract.denoiser))
    save(models, FAMILY + noise)
    for path in sorted(WEIGHTS.glob(f"{FAMILY}{noise}*")):
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m training.quantise.ensemble",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("--out", type=Path, required=True, help="folder of the stored results and of what was trained")
    parser.add_argument("--export", action="store_true", help="write the models, once all is trained")
    parser.add_argument("--spread", action="store_true", help="of ensemble-spread")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    noise = SPREAD if args.spread else ""
    joint, _ = checkpoints.load(CHECKPOINTS / ("joint_spread.pt" if noise else "joint.pt"))
    assert isinstance(joint, JointFusion)
    ensemble = EnsembleFusion(joint, LargeDenoiser(), BandWeights()).eval()
    trained: dict[str, int] = {}
    if noise or args.export:
        ensemble, trained = load(CHECKPOINTS / "ensemble_spread.pt" if noise else args.out / "weights.pt", joint)
    files = {name: args.out / f"{name}.onnx" for name in ("albedo", "normal", "colour")}
    if not all(file.exists() for file in files.values()):
        with torch.no_grad():
            fits = fit_networks(ensemble, calibration_pairs(args.views, joint))
        for name, network in fits.items():
            onnx.save(network, files[name])
    networks = {name: onnx.load(file) for name, file in files.items()}
    if args.export:
        export(ensemble, networks, noise, trained)
        return
    for scale in SCALES:
        onnx.save(Results(scale, networks).model(), args.out / f"results-x{scale}.onnx")
    store_pairs(args.views, args.out, joint)


if __name__ == "__main__":
    main()
