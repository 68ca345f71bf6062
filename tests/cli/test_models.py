# SPDX-License-Identifier: Apache-2.0
"""msspl models, as a process."""

import json
from pathlib import Path

from oiio_msspl.model.digests import digest
from tests.programs import run


def test_models_lists_what_ships():
    data = json.loads(run("msspl", "models", "--json").stdout)
    assert {m["name"] for m in data["models"]} >= {"paper-x2", "paper-x4", "paper-x8"}
    assert "cpu" in data["devices"]
    (default,) = (m for m in data["models"] if m["name"] == "joint-x2")
    assert default["quality"] == "balanced" and default["layers"] == ["albedo", "normal"]
    assert default["measured"]["psnr_8spp"] > default["measured"]["psnr_2spp"] > 30
    assert default["digests"]["cpu"] == digest(Path(default["files"]["cpu"])) != default["digests"]["gpu"]
    printed = run("msspl", "models").stdout
    assert f"{default['measured']['psnr_2spp']:.2f} / {default['measured']['psnr_8spp']:.2f}" in printed
    assert all(digits in printed for digits in default["digests"].values())
