# SPDX-License-Identifier: Apache-2.0
"""The files for GPUs."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pyoidn")
torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

from oiio_msspl.model.runtime import load_network  # noqa: E402
from research.training import export, gpu  # noqa: E402
from research.training.encoding import log_encode  # noqa: E402
from research.training.joint import JointFusion  # noqa: E402
from research.training.whole_model import example, run_in_torch  # noqa: E402


@pytest.mark.parametrize("size", ["small", "large"])
def test_a_file_for_gpus_computes_what_the_network_does(tmp_path: Path, size: str) -> None:
    """In half floats. The large size also returns the albedo and the normal that it has denoised."""
    torch.manual_seed(0)
    network = JointFusion(size=size).eval()
    state = {"training_spp": {"2": {}}, "architecture": "joint", "provenance": {}}
    contract = export.contract_of(network, 2, f"joint-{size}-x2", 48, state)
    denoiser = export.denoiser_for(network, contract.denoiser)
    model = gpu.to_onnx(gpu.joint_in_half_floats(network), contract, gpu.in_half_floats(denoiser))
    onnx.save(model, tmp_path / "gpu.onnx")
    session = load_network(tmp_path / "gpu.onnx")
    inputs = example(contract, 2 * contract.alignment, 3 * contract.alignment)
    names = ["fused", "log_error", *(["albedo", "normal"] if size == "large" else [])]
    found = dict(zip(names, session.run(names, {n: v.numpy() for n, v in inputs.items()}), strict=True))
    with torch.inference_mode():
        expected = run_in_torch(contract, inputs, network.fuse, denoiser)
        difference = log_encode(torch.from_numpy(found["fused"])) - log_encode(expected)
    assert float(difference.abs().mean()) < 0.01
    assert {value.name for value in session.get_outputs()} == set(names)
    if size == "large":
        clean = network.layers(inputs["hrls.albedo"], inputs["hrls.normal"])
        for name, values in zip(("albedo", "normal"), clean, strict=True):
            assert float((torch.from_numpy(found[name]) - values.detach()).abs().mean()) < 0.01
