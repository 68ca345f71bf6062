# SPDX-License-Identifier: Apache-2.0
import hashlib

import pytest

from oiio_msspl.model.catalogue import shipped_models
from oiio_msspl.model.digests import digest


def test_a_digest_depends_on_the_model_and_on_the_weights_that_it_names(tmp_path):
    model = tmp_path / "a.onnx"
    model.write_bytes(b"\x00graph\x0edenoiser.weights\x00")
    with pytest.raises(FileNotFoundError):
        digest(model)
    (tmp_path / "denoiser.weights").write_bytes(b"one")
    (tmp_path / "other.weights").write_bytes(b"not named")
    before = digest(model)
    assert before == hashlib.sha256(b"\x00graph\x0edenoiser.weights\x00one").hexdigest()[:12]
    (tmp_path / "denoiser.weights").write_bytes(b"two")
    assert digest(model) != before


def test_models_that_ship_have_different_digests():
    models = shipped_models().values()
    assert len({digest(path) for path in models}) == len(models)
