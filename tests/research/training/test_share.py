# SPDX-License-Identifier: Apache-2.0
"""What several models have in common is stored once, and they compute what they did."""

from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
pytest.importorskip("torch")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402
from onnx.external_data_helper import set_external_data  # noqa: E402

from oiio_msspl.model.catalogue import WEIGHTS  # noqa: E402
from oiio_msspl.model.runtime import load_network  # noqa: E402
from research.training.export import HALF_DROPPED, rounded_half  # noqa: E402
from research.training.share import share  # noqa: E402

SIZE = 2000


def model(path, *tensors):
    """A model that adds up tensors: (name, values, weights file or None)."""
    names, stored = [name for name, _, _ in tensors], []
    for name, values, file in tensors:
        tensor = numpy_helper.from_array(values, name)
        if file:
            target = path.parent / file
            offset = target.stat().st_size if target.exists() else 0
            with target.open("ab") as out:
                out.write(tensor.raw_data)
            set_external_data(tensor, file, offset, len(tensor.raw_data))
            tensor.ClearField("raw_data")
        stored.append(tensor)
    graph = helper.make_graph(
        [helper.make_node("Sum", ["x", *names], ["y"])],
        "sum",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [SIZE])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [SIZE])],
        stored,
    )
    path.write_bytes(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9).SerializeToString()
    )


def results(folder):
    x = np.zeros(SIZE, np.float32)
    return {path.name: load_network(path).run(None, {"x": x})[0].tobytes() for path in folder.glob("*.onnx")}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_equal_tensors_are_stored_once_and_results_stay(tmp_path):
    random = np.random.default_rng(0)
    table, base, own, other, alone = (random.random(SIZE, np.float32) for _ in range(5))
    model(tmp_path / "fine-x2.onnx", ("t", table, None), ("b", base, "fine.weights"), ("o", own, "fine.weights"))
    model(tmp_path / "fine-spread-x2.onnx", ("t", table, None), ("b", base, "fine-spread.weights"), ("o", other, None))
    model(tmp_path / "quick-x2.onnx", ("t", table, None), ("small", np.ones(1, np.float32), None), ("a", alone, None))
    before = results(tmp_path)
    share(tmp_path)
    assert results(tmp_path) == before
    files = contents(tmp_path)
    assert sum(content.count(values.tobytes()) for values in (table, base) for content in files.values()) == 2
    assert files["shared.weights"] == table.tobytes() and files["fine_shared.weights"] == base.tobytes()
    assert files["fine.weights"] == own.tobytes() and "fine-spread.weights" not in files
    share(tmp_path)
    assert contents(tmp_path) == files


@pytest.mark.parametrize("folder", [WEIGHTS, WEIGHTS / "gpu"], ids=["cpu", "gpu"])
def test_no_model_that_ships_repeats_a_tensor(folder: Path):
    """Otherwise run ``python -m research.training.share`` after the last export."""
    seen = {}
    for path in sorted(folder.glob("*.onnx")):
        for tensor in onnx.load(path, load_external_data=False).graph.initializer:
            place = path.name
            data = tensor.raw_data
            if tensor.data_location == TensorProto.EXTERNAL:
                entries = {entry.key: entry.value for entry in tensor.external_data}
                place = (entries["location"], int(entries["offset"]))
                data = (folder / place[0]).read_bytes()[place[1] :][: int(entries["length"])]
            if len(data) >= 4096:
                assert seen.setdefault(data, place) == place, f"{path.name}: {tensor.name} lies in {place}, too"


def test_the_sum_of_an_outputs_weights_survives_rounding():
    weights = np.random.default_rng(0).uniform(0.51, 0.98, (8, 64, 3, 3)).astype(np.float32)
    rounded = rounded_half(weights)
    assert not (rounded.view(np.uint16) % (1 << HALF_DROPPED)).any()
    step = 2.0 ** (HALF_DROPPED - 11)  # of half floats from 0.5 to 1, without these bits
    errors = rounded.astype(np.float64) - weights
    assert np.abs(errors).max() < 1.2 * step and np.abs(errors.sum(axis=(1, 2, 3))).max() < 0.6 * step
