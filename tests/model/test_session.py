# SPDX-License-Identifier: Apache-2.0
import json
import os
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.model.catalogue import find_model, shipped_models
from oiio_msspl.model.contract import METADATA_KEY, SCALES, Contract
from oiio_msspl.model.devices import PROVIDERS, usable_devices
from oiio_msspl.model.session import Session


def test_a_model_ships_for_every_scale():
    assert {f"{family}-x{s}" for family in ("paper", "joint-small") for s in SCALES} <= shipped_models().keys()


@pytest.mark.parametrize("scale", SCALES)
def test_shipped_models_load_and_say_where_they_come_from(scale):
    session = Session(find_model(scale))
    assert session.contract.scale == scale
    assert session.contract.training_spp.keys() == {"hrls", "lrhs"}
    assert session.contract.provenance["steps"] > 0
    size = 32 // scale * 2, 32 // scale * 3
    high = size[0] * scale, size[1] * scale
    values = session.run(np.zeros((*size, 3), np.float32), np.zeros((*high, 16), np.float32))["fused"]
    assert values.shape == (*high, 3)
    assert np.isfinite(values).all()


@pytest.mark.parametrize("part", ["_denoiser", "_session"])
def test_a_network_that_fails_is_named(monkeypatch, part):
    """Either of the two of `joint`."""
    session = Session(find_model(2))
    pair = np.zeros((16, 16, 3), np.float32), np.zeros((32, 32, 16), np.float32)
    session.run(*pair)
    network = session._denoiser if part == "_denoiser" else session

    def fail(*_):
        raise RuntimeError("out of memory\nand more")

    monkeypatch.setattr(network, "_session", SimpleNamespace(run=fail))
    with pytest.raises(MssplError, match=r"^joint-x2 failed on CPUExecutionProvider \(out of memory\); try --device"):
        session.run(*pair)


def test_a_contract_survives_its_json():
    contract = Contract(name="x", scale=4, training_spp={"hrls": [1, 8]}, provenance={"steps": 1})
    assert Contract.from_json(contract.to_json(), "x.onnx") == contract


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 99}, "contract format 99, this version reads 1"),
        ({"hrls": ["rgb.R"]}, "made for hrls"),
        ({"transforms": {"curve": "linear"}}, "made for transforms"),
        ({"defaults": {"albedo": 0.4}}, "made for defaults"),
        ({"scale": 3}, "scale 3 is none of"),
        ({"surprise": 1}, "can't be read"),
    ],
)
def test_a_contract_that_cannot_be_honoured_is_refused(change, message):
    text = json.dumps(json.loads(Contract(name="x", scale=4).to_json()) | change)
    with pytest.raises(InputError, match=rf"x\.onnx: .*{message}"):
        Contract.from_json(text, "x.onnx")


def test_files_that_are_no_models_are_named(tmp_path, bilinear_models):
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(InputError, match=r"text\.onnx: onnxruntime can't load it"):
        Session(tmp_path / "text.onnx")
    onnx = pytest.importorskip("onnx")
    model = onnx.load(bilinear_models[2])
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "bare.onnx")
    with pytest.raises(InputError, match=rf"bare\.onnx: has no '{METADATA_KEY}' metadata"):
        Session(tmp_path / "bare.onnx")
    with pytest.raises(InputError, match="no model 'nothing': neither a file nor one of"):
        find_model(4, "nothing")


def test_devices_that_are_not_there_are_said(bilinear_models):
    with pytest.raises(InputError, match="use one of cpu, cuda"):
        Session(bilinear_models[2], "gpu")
    absent = next(d for d in PROVIDERS if d not in usable_devices())
    with pytest.raises(InputError, match=r"has no .*; usable here: cpu"):
        Session(bilinear_models[2], absent)


def test_the_cpu_is_named_as_provider(bilinear_models):
    assert Session(bilinear_models[2]).provider == "CPUExecutionProvider"


#: Values that a forged file may hold anywhere.
FORGED = [
    None,
    True,
    -1,
    0,
    1e308,
    2**70,
    "",
    "x" * 10**4,
    "\x1b[2J",
    [],
    [[]],
    {},
    {"hrls": 1},
    {"hrls": [1]},
    [None] * 9,
]


@pytest.mark.parametrize("name", [field.name for field in fields(Contract)])
def test_a_forged_contract_is_refused_or_can_be_used(name):
    """By a sentence that is no longer than a screen. What is accepted has the types that the rest relies on."""
    honest = json.loads(Contract(name="x", scale=4, training_spp={"hrls": [1, 8]}).to_json())
    for value in FORGED:
        try:
            contract = Contract.from_json(json.dumps(honest | {name: value}), "x.onnx")
        except InputError as error:
            assert len(str(error)) < 2000
            continue
        numbers = [contract.scale, contract.alignment, contract.overlap, contract.bytes_per_pixel]
        assert all(type(number) is int for number in numbers)
        assert contract.alignment > 0 <= contract.overlap and contract.bytes_per_pixel > 0
        assert isinstance(contract.name, str) and isinstance(contract.provenance, dict)
        assert all(low <= 0 or high for low, high in contract.training_spp.values())


@pytest.mark.parametrize("text", ["[" * 10**5, "[]", "null", "{", '{"name": 1' + "0" * 5000 + "}", "", "\x00"])
def test_text_that_is_no_contract_is_refused(text):
    with pytest.raises(InputError, match=r"x\.onnx: the 'msspl' metadata can't be read"):
        Contract.from_json(text, "x.onnx")


@pytest.mark.parametrize("change", ["outputs", "inputs"])
def test_a_network_with_other_inputs_or_outputs_is_refused(tmp_path, bilinear_models, change):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(bilinear_models[2])
    side = model.graph.output if change == "outputs" else model.graph.input
    old, side[0].name = side[0].name, "other"
    for node in model.graph.node:
        for names in (node.input, node.output):
            names[:] = ["other" if each == old else each for each in names]
    onnx.save(model, tmp_path / "forged.onnx")
    with pytest.raises(InputError, match=r"forged\.onnx: its network has the inputs"):
        Session(tmp_path / "forged.onnx")


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_is_given_back():
    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    session = Session(find_model(2, "joint"))
    session.run(np.zeros((384, 384, 3), np.float32), np.zeros((768, 768, 9), np.float32))
    held = resident()
    session.release_memory()
    assert held - resident() > 100 << 20
