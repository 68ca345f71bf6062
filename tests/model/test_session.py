# SPDX-License-Identifier: Apache-2.0
import json
import os
import sys
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from oiio_msspl.aovs.features import HRLS_FEATURES
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.image.allocator import keep_memory
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.contract import METADATA_KEY, SCALES, Contract
from oiio_msspl.model.devices import PROVIDERS, usable_devices
from oiio_msspl.model.encoding import encode_radiance
from oiio_msspl.model.session import Session
from tests.conftest import noisy, picture


def pair(session, height, width, value=0.0):
    """Features of both renders for :meth:`Session.run`, all pixels alike."""
    contract = session.contract
    lrhs = {name: np.full((height, width, 3), value, np.float32) for name in contract.lrhs}
    size = height * contract.scale, width * contract.scale
    return lrhs, {name: np.full((*size, HRLS_FEATURES[name]), value, np.float32) for name in contract.hrls}


@pytest.mark.parametrize("scale", SCALES)
def test_shipped_models_load_and_say_where_they_come_from(scale):
    session = Session(find_model(scale))
    assert session.contract.scale == scale
    assert session.contract.training_spp.keys() == {"hrls", "lrhs"}
    assert session.contract.provenance["steps"] > 0
    values = session.run(*pair(session, 32, 48), 1.0, {"rgb": 0.5})["fused"]
    assert values.shape == (32 * scale, 48 * scale, 3)
    assert np.isfinite(values).all()


def test_a_network_that_fails_is_named(monkeypatch):
    session = Session(find_model(2))
    session.run(*pair(session, 16, 16), 1.0, {"rgb": 0.5})

    def fail(*_):
        raise RuntimeError("out of memory\nand more")

    monkeypatch.setattr(session, "_session", SimpleNamespace(run=fail))
    with pytest.raises(MssplError, match=r"^joint-x2 failed on CPUExecutionProvider \(out of memory\); try --device"):
        session.run(*pair(session, 16, 16), 1.0, {"rgb": 0.5})


@pytest.mark.parametrize("family", ["paper", "joint"])
def test_a_model_sees_the_exposed_scene(family):
    """A scene that is ten stops darker, with an exposure that is ten stops higher, is the same picture."""
    session, clean = Session(find_model(2, family)), picture(64, 96)
    lrhs, hrls = {"rgb": box_downsample(noisy(clean, 16), 2)}, {"rgb": noisy(clean, 4, seed=1), "albedo": clean}
    fused = session.run(lrhs, hrls, 1.0, {"rgb": 0.5})["fused"]
    darker = lrhs | {"rgb": lrhs["rgb"] / 1024}, hrls | {"rgb": hrls["rgb"] / 1024}
    np.testing.assert_allclose(session.run(*darker, 1024.0, {"rgb": 0.5})["fused"] * 1024, fused, rtol=1e-5)
    assert np.abs(fused - clean).mean() < 0.5 * np.abs(hrls["rgb"] - clean).mean()


@pytest.mark.parametrize("light", [0.0, 1e-30, 65504.0, 3e38])
@pytest.mark.parametrize("family", ["paper", "joint", "joint-large"])
def test_any_light_gives_a_finite_picture(family, light):
    """Also where a float could overflow, and without the features that a render may lack."""
    session = Session(find_model(2, family))
    lrhs, hrls = pair(session, 32, 48, light)
    for exposure in (2e-34, 1.0, 1e38):
        for high in (hrls, {"rgb": hrls["rgb"]}):
            fused = session.run(lrhs, high, exposure, {"rgb": 0.5})["fused"]
            assert np.isfinite(fused).all() and fused.min() >= 0


def test_features_that_are_missing_are_their_defaults():
    """As the network reads them: a missing variance is a deviation of 0.5, log-encoded, at any exposure."""
    session, exposure = Session(find_model(2, "paper")), 3.0
    colour = np.ones((16, 16, 3), np.float32)
    feed = session._feed({"rgb": colour[:8, :8]}, {"rgb": colour}, exposure, {})
    assert feed.keys() == session.contract.inputs.keys()
    assert (feed["hrls.albedo"] == 0.5).all() and not feed["hrls.normal"].any() and not feed["hrls.diffuse"].any()
    np.testing.assert_allclose(encode_radiance(np.sqrt(feed["hrls.variance"]), exposure), 0.5, rtol=1e-5)
    assert {name: values.shape[1] if values.ndim else 0 for name, values in feed.items()} == session.contract.inputs


def test_a_contract_survives_its_json():
    contract = Contract(name="x", scale=4, training_spp={"hrls": [1, 8]}, provenance={"steps": 1})
    assert Contract.from_json(contract.to_json(), "x.onnx") == contract


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 99}, "contract format 99, this version reads 2"),
        ({"hrls": ["rgb.R"]}, "the field hrls of its contract has a value that can't be"),
        ({"lrhs": ["albedo"]}, "the field lrhs of its contract has a value that can't be"),
        ({"transforms": {"curve": "linear"}}, "made for transforms"),
        ({"defaults": {"albedo": 0.4}}, "made for defaults"),
        ({"scale": 3}, "the field scale of its contract has a value that can't be"),
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
    with pytest.raises(InputError, match="there is no model for x3; the scales are x1, x2, x4, x8"):
        find_model(3)


def test_devices_that_are_not_there_are_said(bilinear_models):
    with pytest.raises(InputError, match="use one of cpu, cuda"):
        Session(bilinear_models[2], "gpu")
    absent = next(d for d in PROVIDERS if d not in usable_devices())
    with pytest.raises(InputError, match=r"has no .*; usable here: cpu"):
        Session(bilinear_models[2], absent)


#: Values that a forged file may hold anywhere.
FORGED = [
    *(None, True, -1, 0, 1e308, 2**70, "", "x" * 10**4, "\x1b[2J"),
    *([], [[]], {}, {"hrls": 1}, {"hrls": [1]}, [None] * 9),
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
        assert contract.inputs["lrhs.rgb"] == contract.inputs["hrls.rgb"] == 3
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
    with pytest.raises(InputError, match=r"forged\.onnx: has the inputs"):
        Session(tmp_path / "forged.onnx")


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_is_given_back():
    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    keep_memory()  # as programs do
    session = Session(find_model(2, "joint"))
    session.run(*pair(session, 384, 384), 1.0, {"rgb": 0.5})
    held = resident()
    session.release_memory()
    assert held - resident() > 100 << 20
