# SPDX-License-Identifier: Apache-2.0
"""The table of fused passes."""

import numpy as np
import pytest

from oiio_msspl import Session
from research.benchmarks import passes, results
from tests.conftest import downsample, picture, rgb, write_exr

SIZE = 64


@pytest.fixture
def rows(tmp_path, bilinear_models, monkeypatch):
    """Rows of a scene without noise, with a product, light groups and a faint one. OIDN halves what it gets."""
    clean = picture(SIZE, SIZE)
    colour = (0.2 + 0.7 * picture(SIZE, SIZE)[::-1]).astype(np.float32)
    light, emission = clean, 0.3 * picture(SIZE, SIZE)[:, ::-1]
    beauty = light * colour + emission
    layers = {"Combined": beauty, "Diffuse Direct": light, "Diffuse Color": colour, "Emission": emission}
    layers |= {f"Combined_{name}": share * beauty for name, share in (("a", 0.3), ("b", 0.695), ("faint", 0.005))}
    layers |= {"Denoising Albedo": colour, "Denoising Normal": np.ones_like(colour)}
    low = {name: downsample(values.astype(np.float32), 4) for name, values in layers.items()}
    low["Diffuse Direct"] = downsample((light * colour).astype(np.float32), 4) / low["Diffuse Color"]
    (tmp_path / "scene").mkdir()
    for name, images in (("lr_x4_16spp", low), ("hr_1spp", layers), ("hr_2spp", layers), ("ref", layers)):
        channels = {}
        for layer, values in images.items():
            brighter = 1.002 if name == "ref" else 1  # the PSNR of equal images is infinite
            channels |= rgb((brighter * values).astype(np.float32), f"View.{layer}.")
        write_exr(tmp_path / "scene" / f"{name}.exr", channels, **{"cycles.View.samples": "1"})
    for call in ("denoise", "denoise_prefiltered", "denoise_with_clean"):
        monkeypatch.setattr(passes, call, lambda image, *_: image / 2)
    monkeypatch.setattr(passes, "prefiltered", dict)
    monkeypatch.setattr(passes, "load_model", lambda scale, model: Session(bilinear_models[scale]))
    return passes.measure(tmp_path / "scene", 4, 1)


def test_every_bright_layer_has_a_row_and_products_are_scored_with_their_colour(rows):
    found = {(row["set"], row["method"], row["layer"]): row["psnr"] for row in rows}
    sets = {name: [layer for s, m, layer in found if (s, m) == (name, "HRLS")] for name, *_ in found}
    assert sets == {
        "light groups": ["all", "Combined_a", "Combined_b"],
        "components": ["all", "Diffuse Direct", "Emission"],
    }
    methods = {method for name, method, _ in found if name == "components"}
    assert {method for name, method, _ in found if name == "light groups"} - methods == {"msspl-x4, best, at half size"}
    assert methods == {"HRLS", passes.PEER, "OIDN, ordinary render", "msspl-x4", "msspl-x4, best"}
    # Without noise, every method that knows the sum is right. Light that is not multiplied by its colour is not.
    assert found["components", "HRLS", "Diffuse Direct"] > 50
    for method in methods - {"HRLS", "OIDN, ordinary render"}:
        assert found["components", method, "Diffuse Direct"] > 20, method


def test_means_are_over_all_scenes_and_as_old_as_their_oldest_row(rows):
    stamped = [row | {"date": "2026-01-02"} for row in rows]
    better = [row | {"scene": "other", "psnr": row["psnr"] + 3, "date": "2026-01-01"} for row in rows]
    both = stamped + better
    single = results.index((row for row in rows if row["layer"] == passes.ALL), "set", "method")
    for mean in passes.means(both):
        assert mean["psnr"] == pytest.approx(single[mean["set"], mean["method"]]["psnr"] + 1.5)
        assert (mean["scene"], mean["layer"], mean["date"]) == ("mean", passes.ALL, "2026-01-01")
    models = {mean["method"]: mean.get("model") for mean in passes.means(both)}
    assert models["msspl-x4"] == models["msspl-x4, best"] == models[passes.PEER] == "bilinear-x4"
    assert models["OIDN, ordinary render"] is None
    # A method that was not measured on every scene has no mean.
    part = [row for row in both if (row["scene"], row["method"]) != ("other", "msspl-x4")]
    assert not [row for row in passes.means(part) if row["method"] == "msspl-x4"]
