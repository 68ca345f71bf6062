# SPDX-License-Identifier: Apache-2.0
"""Files with the names of real renders and pixels of our own: which layer becomes which feature, in which convention,
and that such a pair can be fused. stand_ins.toml holds the names."""

import itertools
import tomllib
from pathlib import Path

import numpy as np
import pytest

from oiio_msspl.aovs.features import HRLS_FEATURES, NORMAL, RGB, VARIANCE
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.aovs.renderers import renderers
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.jobs.files import fuse_files
from oiio_msspl.jobs.inputs import InputOptions
from tests.conftest import downsample, write_exr

RENDERS = tomllib.loads(Path(__file__).with_name("stand_ins.toml").read_text(encoding="utf-8"))["render"]
HEIGHT, WIDTH, SCALE = 24, 32, 4
TYPES = {"half": np.float16, "float": np.float32, "uint": np.uint32}


def split(text):
    """Layer, components and pixel type of an entry of ``layers``."""
    text, _, kind = text.rpartition(" ") if text.endswith((" float", " uint")) else (text, "", "half")
    name, _, components = text.rpartition(".")
    return name, components.split(",") if "," in components else list(components), TYPES[kind]


def layers_of_feature(source):
    """Names of the layers that a feature is computed from."""
    entry = source if isinstance(source, dict) else {"layer": source}
    return entry.get("sum", []) + [entry[key] or "R" for key in ("layer", "times") if key in entry]


def pixels(render):
    """{layer: (HEIGHT, WIDTH, components) as stored}, each layer of its own values. Plain layers go by their first
    component."""
    features = render["features"]
    normal, variance = (layers_of_feature(features[name]) if name in features else [] for name in (NORMAL, VARIANCE))
    result = {}
    names = [*render["layers"], *(f"{stem}.RGB float" for stem in render.get("beside", []))]
    for seed, text in enumerate(names):
        name, components, dtype = split(text)
        rng = np.random.default_rng(seed)
        values = rng.uniform(0.1, 1, (HEIGHT, WIDTH, len(components)))
        if name in normal:
            values = rng.normal(size=values.shape)
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
            values = values * 0.5 + 0.5 if render.get("normals") == "unsigned" else values
        elif name in variance:
            values += 1  # a mean of squares is larger than the square of the mean
        elif len(components) == 4:
            values[..., 3] = 1
        result[name or components[0]] = values.astype(dtype)
    return result


def write(render, folder, layers):
    """Write a stand-in with these pixels, and the files beside it."""
    folder.mkdir()
    prefix, store = render.get("prefix", ""), render.get("store", "channels")
    parts = {}
    for name, components, _ in map(split, render["layers"]):
        part = "" if store == "channels" else prefix + name
        in_front = "" if store == "parts" or not prefix + name else f"{prefix}{name}."
        parts.setdefault(part, {}).update(
            {in_front + c: layers[name or components[0]][..., i] for i, c in enumerate(components)}
        )
    for stem in render.get("beside", []):
        write_exr(folder / f"{stem}.exr", {c: layers[stem][..., i] for i, c in enumerate("RGB")})
    path = folder / f"{render.get('stem', 'frame')}.exr"
    return write_exr(path, [(*part, (0, 0)) for part in parts.items()], **render.get("attributes", {}))


def expected(feature, source, layers, render):
    """A feature as its definition gives it, computed from the pixels that were written."""
    entry = source if isinstance(source, dict) else {"layer": source}
    values = {name: layers[name][..., :3].astype(np.float32) for name in layers_of_feature(source)}
    result = sum(values[name] for name in entry.get("sum", [entry.get("layer") or "R"]))
    if feature == NORMAL:
        return result * 2 - 1 if render.get("normals") == "unsigned" else result
    if entry.get("of") == "samples":
        return result / render["spp"]
    return result * values[entry["times"]] if "times" in entry else result


@pytest.mark.parametrize("render", RENDERS, ids=lambda render: render["name"])
def test_a_render_with_the_names_of_a_real_one_is_mapped_and_fused(tmp_path, render, bilinear_models):
    high = pixels(render)
    low = {name: downsample(values.astype(np.float32), SCALE).astype(values.dtype) for name, values in high.items()}
    beauty = render["features"][RGB] or "R"
    low[beauty][..., :3] *= 1.1  # differs from the mean of the HRLS, so the result is not simply the HRLS
    paths = [write(render, tmp_path / name, layers) for name, layers in (("lr", low), ("hr", high))]
    view = render.get("view")
    mapped = map_render(open_exr(paths[1]), view=view)
    assert (mapped.renderer, mapped.spp) == (render["renderer"], render.get("spp"))
    assert mapped.features.keys() == render["features"].keys()
    features = mapped.read(mapped.data_window)
    for name, source in render["features"].items():
        np.testing.assert_allclose(features[name], expected(name, source, high, render), rtol=2e-3, atol=2e-3)

    inputs = InputOptions(view=view)
    report = fuse_files(*paths, tmp_path / "out.exr", inputs=inputs, model=str(bilinear_models[SCALE]))
    assert (report.scale, report.repaired, report.negative) == (SCALE, {}, {})
    written = map_render(open_exr(tmp_path / "out.exr"), view=view)
    fused = written.read(written.data_window)
    # The model enlarges the LRHS, so the corners of the result are those of the LRHS.
    for y, x in itertools.product((0, -1), repeat=2):
        np.testing.assert_allclose(fused[RGB][y, x], low[beauty][y, x, :3].astype(np.float32), rtol=2e-3)
    if not render.get("beside"):
        assert written.features.keys() == render["features"].keys()
        for name in set(HRLS_FEATURES) & features.keys() - {RGB, VARIANCE}:
            np.testing.assert_array_equal(fused[name], features[name])


def test_every_renderer_of_the_table_has_a_stand_in():
    assert {entry["name"] for entry in renderers()} == {render["renderer"] for render in RENDERS}
