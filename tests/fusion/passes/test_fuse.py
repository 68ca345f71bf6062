# SPDX-License-Identifier: Apache-2.0
"""Layers that sum to the beauty are fused, and still sum to it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from oiio_msspl import InputError, InputOptions, WriteOptions, fuse_files
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.fusion.fuse import fuse
from oiio_msspl.fusion.passes import bands, network
from oiio_msspl.fusion.passes.exact_sum import spread_rest
from oiio_msspl.fusion.passes.fuse import PassInputs, fuse_passes
from oiio_msspl.fusion.passes.sums import check_sum
from oiio_msspl.fusion.tiles import tiling
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.fusion.tiles.network import FusedPixels
from oiio_msspl.fusion.tiles.prepare import FramePair
from oiio_msspl.image import arrays
from oiio_msspl.jobs import settings
from oiio_msspl.model.catalogue import load_model
from tests.conftest import downsample, noisy, picture, read_bits, rgb, same_bits, write_exr

HEIGHT, WIDTH = 90, 122  # no multiple of 4
#: Of the pairs of :func:`write_pair`.
SCALE = 4
HALF_ROUNDING = 2**-11


def lights():
    """Clean light of two lamps: one from the left, one that lights a disk alone."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] / WIDTH
    colour = picture(HEIGHT, WIDTH)
    disk = ((x - 0.6) ** 2 + (y - 0.4) ** 2 < 0.03)[..., None]
    return {"light_key": colour * (1 - 0.8 * x)[..., None], "light_spot": np.float32(2) * disk * (0.2, 0.5, 1.0)}


def downsampled(image):
    """An image (h, w, 3) at the resolution of the LRHS."""
    return downsample(np.pad(image, ((0, -HEIGHT % SCALE), (0, -WIDTH % SCALE), (0, 0)), "edge"), SCALE)


def write_pair(
    folder, layers, dtype=np.float32, low=True, extra=None, beauty=None, noise_free=(), firefly=None, hrls_alone=()
):
    """An LRHS of 16 spp at x4 (4 spp at x2) and an HRLS of 1 spp whose ``layers`` (clean, by name) sum to the beauty.

    ``firefly``: file, layer and pixel that has one. ``low``: the LRHS has the layers, except those of ``hrls_alone``.
    """
    small = {name: downsampled(values) for name, values in layers.items()}
    paths = []
    for name, clean, spp in (("lr", small, SCALE**2), ("hr", layers, 1)):
        samples = {
            n: (v if n in noise_free else noisy(v.astype(np.float32), spp, seed)).astype(dtype)
            for seed, (n, v) in enumerate(clean.items())
        }
        if firefly is not None and firefly[0] == name:
            samples[firefly[1]][firefly[2]] = 1e4, 5e3, 1e3
        total = sum(v.astype(np.float64) for v in samples.values()) if beauty is None else beauty(samples)
        channels = rgb(np.asarray(total).astype(dtype))
        if name == "hr":
            channels |= rgb((picture(HEIGHT, WIDTH) > 0.3).astype(dtype), "albedo.")
            channels |= extra or {}
        written = {n: v for n, v in samples.items() if name == "hr" or (low and n not in hrls_alone)}
        for layer, values in written.items():
            channels |= rgb(values, f"{layer}.")
        paths.append(write_exr(folder / f"{name}.exr", channels))
    return paths


@pytest.fixture(params=["fit", "network", "half"])
def model(request, bilinear_models, monkeypatch):
    """A model whose passes are fitted, and one whose passes a network fuses, at full or, at x2, half resolution."""
    if request.param == "half":
        monkeypatch.setattr(network, "MOST_AT_FULL_SIZE", 0)
        monkeypatch.setattr("tests.fusion.passes.test_fuse.SCALE", 2)
    return str(bilinear_models[4]) if request.param == "fit" else "best"


def fused(pair, out, model, passes=(), sums=(), layout="spec", **options):
    """The report, and {channel: pixels} of the fused file."""
    write, inputs = WriteOptions(passes=passes, layout=layout, **options), InputOptions(sums=sums)
    report = fuse_files(*pair, out, model=model, write=write, inputs=inputs, overwrite=True)
    return report, {name: pixels for _, part in read_bits(out) for name, pixels in part.items()}


def fuse_layers_of(low, high, beauty, aovs=None, **options):
    """Fuse all sets of a pair, given its fused beauty: pixels (h, w, 3), or a fused frame."""
    if isinstance(beauty, np.ndarray):
        beauty = FusedPixels(beauty, None, None, align(low, high), 1.0, clean_aovs=aovs or {})
    return fuse_passes(PassInputs(low, high, beauty, high.additive_sets), **options)


def pixels_of(result, index=0):
    """A fused layer of the first set, (h, w, 3)."""
    channels = result.jobs[0].layers.layers[index].channels
    return np.stack([result.pixels.planes[channel] for channel in channels], axis=-1)


def layer(channels, name=""):
    prefix = f"{name}." if name else ""
    return np.stack([channels[f"{prefix}{c}"] for c in "RGB"], axis=-1).astype(np.float64)


def assert_sum(parts, whole):
    """Layers sum to another one: at worst but for rounding, 1e-6 of it for each layer of floats, and on average but for
    a quarter of that."""
    total = sum(parts)
    allowed = 1e-6 * len(parts) * whole + 1e-7
    if np.array_equal(whole, whole.astype(np.float16)):
        allowed = HALF_ROUNDING * (total + whole) + len(parts) * 2**-24
    wrong = np.abs(total - whole)
    assert np.all(wrong <= allowed)
    assert wrong.mean() <= allowed.mean() / 4


@pytest.mark.parametrize("low", [True, False])
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_fused_layers_sum_to_the_fused_beauty(tmp_path, model, low, dtype):
    clean = lights()
    pair = write_pair(tmp_path, clean, dtype, low)
    report, out = fused(pair, tmp_path / "out.exr", model)
    note = "" if low else " (all layers from the HRLS alone)"
    assert report.passes == {"light groups": f"fused: light_key, light_spot{note}"}
    assert not [text for text in report.warnings if "light" in text]
    assert_sum([layer(out, name) for name in clean], layer(out))
    _, raw = fused(pair, tmp_path / "raw.exr", model, ("none",))
    for name, values in clean.items():
        assert np.all(layer(out, name) >= 0)
        assert out[f"{name}.R"].dtype == dtype
        errors = [np.mean((layer(channels, name) - values) ** 2) for channels in (out, raw)]
        assert errors[0] < errors[1] / 5


def test_an_albedo_without_noise_sharpens_components(tmp_path):
    """Two lamps that light one material each. The HRLS's albedo, which tells them apart, is noisy."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    stripes = ((x // 9 + y // 13) % 2)[..., None].astype(np.float32)
    clean = {"light_a": np.float32(0.6) * stripes * (1, 1, 1), "light_b": np.float32(0.5) * (1 - stripes) * (1, 1, 1)}
    albedo = stripes * np.float32((0.8, 0.5, 0.3)) + (1 - stripes) * np.float32((0.3, 0.5, 0.8))
    noise = np.random.default_rng(0).standard_normal(albedo.shape).astype(np.float32)
    noisy_albedo = (albedo + 0.5 * noise).clip(0, 1)
    low, high = (map_render(open_exr(file)) for file in write_pair(tmp_path, clean, extra=rgb(noisy_albedo, "albedo.")))
    errors = []
    for guides in ({}, {"albedo": albedo.astype(np.float16)}):
        beauty = sum(clean.values()).astype(np.float32)
        result = fuse_layers_of(low, high, beauty, guides)
        errors.append(np.abs(pixels_of(result) - clean["light_a"]).mean())
    assert errors[1] < 0.5 * errors[0]


def test_a_beauty_of_halves_is_fitted_in_32_bits(tmp_path):
    """Where light is dark and even, halves would leave nothing of its variance but rounding."""
    clean = {name: np.float32(0.05) * values.astype(np.float32) for name, values in lights().items()}
    noise = np.random.default_rng(0).random((HEIGHT, WIDTH, 3), np.float32)
    low, high = (map_render(open_exr(file)) for file in write_pair(tmp_path, clean, extra=rgb(noise, "albedo.")))
    half = sum(clean.values()).astype(np.float16)
    found = []
    for beauty in (half, half.astype(np.float32)):
        result = fuse_layers_of(low, high, beauty)
        channels = [c for layer in result.jobs[0].layers.layers for c in layer.channels]
        found.append(np.stack([result.pixels.planes[channel] for channel in channels]))
    np.testing.assert_array_equal(*found)


def test_lamps_are_told_apart_by_albedos_above_1(tmp_path):
    """Two emitters side by side, one in either light group. Networks that denoise the albedo know it up to 1."""
    left = (np.arange(WIDTH) % 10 < 5)[None, :, None] * np.ones((HEIGHT, 1, 3), np.float32)
    clean = {"light_a": left * np.float32(3), "light_b": (1 - left) * np.float32(2)}
    beauty = sum(clean.values()).astype(np.float32)
    pair = write_pair(tmp_path, clean, extra=rgb(100 * beauty, "albedo."))
    low, high = (map_render(open_exr(file)) for file in pair)
    guides = {"albedo": np.ones_like(beauty)}
    errors = []
    for given in ({}, guides):
        result = fuse_layers_of(low, high, beauty, given)
        errors.append(np.abs(pixels_of(result) - clean["light_a"]).mean())
    assert errors[1] == errors[0]


@pytest.mark.parametrize("low", [True, False])
def test_a_network_keeps_detail_that_the_beauty_does_not_show(tmp_path, low):
    """Squares smaller than an LRHS pixel, dark in one layer where they are bright in the other. Layers that the LRHS
    lacks are fitted all the same."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    squares = ((x // 3 + y // 3) % 2)[..., None] * np.ones(3)
    clean = {"light_a": 0.1 + 0.8 * squares, "light_b": 0.9 - 0.8 * squares}
    pair = [map_render(open_exr(file)) for file in write_pair(tmp_path, clean, low=low)]
    session = load_model(4, "best", threads=1)
    beauty = fuse(*pair, session)
    found, steps = [], []
    for of_layers in (None, session):
        result = fuse_layers_of(*pair, beauty, session=of_layers, progress=lambda *told: steps.append(told))
        found.append(pixels_of(result))
        done, count = steps[-1]
        assert done == count > 0
    errors = [np.abs(each - clean["light_a"]).mean() for each in found]
    assert errors[1] < 0.7 * errors[0] if low else errors[1] == errors[0]


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("count", [5, 6])
def test_many_light_groups_are_fused_at_half_of_the_resolution_at_x2(tmp_path, scale, count):
    """They are nearer to the truth than without a network, in a frame whose size is no multiple of the scale."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    surface = 0.2 + 0.6 * ((x // 9 + y // 7) % 2)[..., None] * np.ones(3)
    spots = [np.exp(-((x - WIDTH * i / count) ** 2 + (y - 40) ** 2) / 900)[..., None] for i in range(count)]
    clean = {f"light_{i}": (surface * spot).astype(np.float32) for i, spot in enumerate(spots)}
    rng, files = np.random.default_rng(0), []
    for name, factor in (("lr", scale), ("hr", 1)):
        size = -(-HEIGHT // factor), -(-WIDTH // factor)
        albedo = np.pad(surface, ((0, -HEIGHT % factor), (0, -WIDTH % factor), (0, 0)), "edge")
        channels, total = rgb(downsample(albedo.astype(np.float32), factor), "albedo."), 0
        for layer_name, values in clean.items():
            padded = np.pad(values, ((0, -HEIGHT % factor), (0, -WIDTH % factor), (0, 0)), "edge")
            noisy = downsample(padded, factor) * rng.gamma(factor**2, 1 / factor**2, (*size, 1)).astype(np.float32)
            channels |= rgb(noisy, f"{layer_name}.")
            total = total + noisy
        files.append(write_exr(tmp_path / f"{name}.exr", channels | rgb(total)))
    pair = [map_render(open_exr(file)) for file in files]
    session = load_model(scale, "best", threads=1)
    beauty, errors = fuse(*pair, session, clean_aovs=True), []
    for of_layers in (None, session):
        result = fuse_layers_of(*pair, beauty, session=of_layers)
        found = {each.name: pixels_of(result, i) for i, each in enumerate(result.jobs[0].layers.layers)}
        assert_sum([each.astype(np.float64) for each in found.values()], beauty.rgb.astype(np.float64))
        errors.append(np.mean([np.abs(found[name] - clean[name]).mean() for name in clean]))
    (used,) = session._layer_sessions
    assert used == session.layers[1 if scale == 2 and count == 6 else 0]
    assert errors[1] < errors[0]


def test_a_lamp_with_few_samples_leaves_no_dark_specks(tmp_path):
    """A lamp of which one sample in eighty knows, on a white wall."""
    rng, files = np.random.default_rng(3), []
    for name, size, samples in (("lr", (23, 31), 16), ("hr", (HEIGHT, WIDTH), 1)):
        rare = 0.1 * rng.binomial(samples, 0.012, (*size, 1)) / (samples * 0.012)
        layers = {"light_a.": np.full((*size, 3), 0.5), "light_b.": rare.repeat(3, axis=-1)}
        channels = rgb(sum(layers.values()).astype(np.float32))
        for layer_name, values in layers.items():
            channels |= rgb(values.astype(np.float32), layer_name)
        files.append(write_exr(tmp_path / f"{name}.exr", channels))
    low, high = (map_render(open_exr(file)) for file in files)
    beauty = np.full((HEIGHT, WIDTH, 3), 0.6, np.float32)
    result = fuse_layers_of(low, high, beauty)
    found = result.pixels.planes[result.jobs[0].layers.layers[1].channels[0]]
    assert found[8:-8, 8:-8].min() > 0.1 * np.median(found)  # a corner has few samples around


@pytest.mark.parametrize("low", [True, False])
@pytest.mark.parametrize("rows", [32, 128])
def test_where_no_layer_has_a_sample_the_beauty_is_divided_as_around(tmp_path, monkeypatch, low, rows):
    """Whatever the height of the bands: here most of them have no sample at all."""
    monkeypatch.setattr(bands, "BAND_ROWS", rows)
    parts = {"light_a": 0.6, "light_b": 0.2, "light_off": 0.0}
    for name, size in (("lr", (96, 32)), ("hr", (384, 128))):
        light = np.zeros((*size, 3), np.float32)
        light[-size[0] // 8 :] = 1
        channels = rgb(light * np.float32(0.8))
        for layer_name, part in parts.items():
            channels |= rgb(light * np.float32(part), f"{layer_name}.") if low or name == "hr" else {}
        write_exr(tmp_path / f"{name}.exr", channels)
    lr, hr = (map_render(open_exr(tmp_path / f"{name}.exr")) for name in ("lr", "hr"))
    beauty = np.full((384, 128, 3), 0.8, np.float32)
    result = fuse_layers_of(lr, hr, beauty)
    for each in result.jobs[0].layers.layers:
        found = result.pixels.planes[each.channels[0]]
        np.testing.assert_allclose(found, parts[each.name], rtol=1e-3, err_msg=each.name)


@pytest.mark.parametrize("samples", [0.5, 0.01])
def test_bands_of_rows_agree(tmp_path, monkeypatch, samples):
    rng = np.random.default_rng(0)
    shares = np.linspace(0.1, 0.9, 320)[:, None, None] * np.ones((1, 64, 3))
    lit = rng.random((320, 64, 1)) < samples
    layers = {"light_a": shares * lit, "light_b": (1 - shares) * lit}
    channels = rgb(sum(layers.values()).astype(np.float32))
    for name, values in layers.items():
        channels |= rgb(values.astype(np.float32), f"{name}.")
    hr = map_render(open_exr(write_exr(tmp_path / "hr.exr", channels)))
    lr = map_render(open_exr(write_exr(tmp_path / "lr.exr", rgb(np.ones((160, 32, 3), np.float32)))))
    found = []
    for rows in (128, 32):
        monkeypatch.setattr(bands, "BAND_ROWS", rows)
        beauty = np.full((320, 64, 3), samples, np.float32)
        result = fuse_layers_of(lr, hr, beauty)
        found.append([result.pixels.planes[each.channels[0]] for each in result.jobs[0].layers.layers])
        np.testing.assert_allclose(sum(found[-1]), samples, rtol=1e-5)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3)


def test_a_network_reads_only_the_part_of_the_frame_where_a_layer_has_light(tmp_path, monkeypatch):
    """It gives what it gives for the whole frame, and takes fewer pixels."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    corner = ((y - 50) ** 2 + (x - 100) ** 2 < 100)[..., None] * np.ones(3)
    pair = write_pair(tmp_path, {"light_a": 0.5 * picture(HEIGHT, WIDTH), "light_b": corner})
    pair = [map_render(open_exr(file)) for file in pair]
    session = load_model(4, "best", threads=1)
    beauty = fuse(*pair, session)
    layers = session.layer_session()
    monkeypatch.setattr(layers, "contract", replace(layers.contract, overlap=0))
    run, sizes, found = layers.run, [], []
    monkeypatch.setattr(
        layers, "run", lambda lrhs, *args, **options: sizes.append(lrhs["rgb"].size) or run(lrhs, *args, **options)
    )
    for whole in (False, True):
        if whole:
            monkeypatch.setattr(FramePair, "_lit_part", lambda *_: None)
        result = fuse_layers_of(*pair, beauty, session=session)
        found.append(pixels_of(result, 1))
    assert sizes[0] == sizes[2] == sizes[3] == 2 * sizes[1]
    assert np.abs(found[0] - found[1]).max() < 0.05
    assert found[0][50, 100].min() > 0.5


def test_all_else_is_what_it_is_without_passes(tmp_path, model):
    pair = write_pair(
        tmp_path, lights(), extra={"Z": picture(HEIGHT, WIDTH)[..., 0], "id.X": np.ones((HEIGHT, WIDTH), np.uint32)}
    )
    _, out = fused(pair, tmp_path / "out.exr", model)
    _, raw = fused(pair, tmp_path / "raw.exr", model, ("none",))
    assert out.keys() == raw.keys()
    changed = {name for name in out if not same_bits(out[name], raw[name])}
    assert changed == {f"{name}.{c}" for name in lights() for c in "RGB"}
    assert same_bits(raw["light_key.R"], read_bits(pair[1])[0][1]["light_key.R"])


def test_layers_that_are_not_written_are_not_fused(tmp_path, bilinear_models):
    pair = write_pair(tmp_path, lights())
    report, out = fused(pair, tmp_path / "out.exr", str(bilinear_models[4]), layers=("albedo",))
    assert report.passes == {}
    assert "light_key.R" not in out


@pytest.mark.parametrize("layout", ["nuke", "multilayer"])
def test_every_layout_holds_the_same_layers(tmp_path, bilinear_models, layout):
    pair = write_pair(tmp_path, lights())
    _, expected = fused(pair, tmp_path / "out.exr", str(bilinear_models[4]))
    fused(pair, tmp_path / "other.exr", str(bilinear_models[4]), layout=layout)
    found = [pixels for _, part in read_bits(tmp_path / "other.exr") for pixels in part.values()]
    for name in ("light_key.R", "light_spot.B"):
        assert any(same_bits(expected[name], pixels) for pixels in found)


def test_a_layer_stays_black_where_it_has_no_light(tmp_path, model):
    pair = write_pair(tmp_path, lights() | {"light_off": np.zeros((HEIGHT, WIDTH, 3))})
    _, out = fused(pair, tmp_path / "out.exr", model)
    assert not layer(out, "light_off").any()
    near = lights()["light_spot"].any(axis=-1)
    reach = 16  # HRLS pixels: the renders around bound a fit, and both are interpolated
    padded = np.pad(near, reach)
    near = sliding_window_view(padded, (2 * reach + 1, 2 * reach + 1)).any(axis=(-1, -2))
    assert not layer(out, "light_spot")[~near].any()
    assert (~near).any()


@pytest.mark.parametrize("model", ["balanced", "best"])
@pytest.mark.parametrize(("file", "pixel"), [("hr", (44, 74)), ("lr", (11, 18))])
def test_a_firefly_in_one_layer_leaves_no_speck_in_any(tmp_path, model, file, pixel):
    """Neither a bright one where it is, nor one darker by a third in the layers that share its pixel.

    With `best`, values below a tenth of the beauty may lose half and a little more. Around the firefly, its layer is
    the more uncertain one, so what the beauty has more or less goes to that rather than to the other.
    """
    without, out = (
        fused(write_pair(tmp_path, lights(), firefly=each), tmp_path / "out.exr", model)[1]
        for each in (None, (file, "light_key", pixel))
    )
    around = slice(34, 54), slice(64, 84)  # inside the spot
    for name, brightest in (("", 1.5), ("light_key", 1.8), ("light_spot", 1.8)):
        ratio = layer(out, name)[around] / layer(without, name)[around]
        assert ratio.min() > (0.45 if model == "best" else 2 / 3) and ratio.max() < brightest
        assert ratio[layer(without, name)[around] >= 0.1 * layer(without, "")[around]].min() > 2 / 3


@pytest.mark.parametrize(
    ("beauty", "doubts", "expected"),
    [
        (1.25, (1, 0.25), (0.7, 0.55)),  # a quarter more, in the ratio 4 : 1
        (0.75, (1, 0.25), (0.3, 0.45)),
        (1.25, None, (0.625, 0.625)),
        (1e-3, (1, 0.25), (1e-3 * 0.05 / 0.37, 1e-3 * 0.32 / 0.37)),  # the first loses nine tenths, and then both
        (10, (1, 0.25), (1.22 + 8.1 * 16 * 1.22 / 20.2, 0.68 + 8.1 * 0.68 / 20.2)),  # the rest in the ratio 16 : 1
        (10, (1, 0), (1.22 + 8.1 * 1.22 / 1.22068, 0.68)),
        (0.0, (1, 1), (0, 0)),
    ],
)
def test_what_layers_lack_is_spread_by_light_and_doubt(beauty, doubts, expected):
    layers = np.full((2, 3, 1, 1), 0.5, np.float32)
    spread_rest(
        layers, np.full((3, 1, 1), beauty, np.float32), None if doubts is None else np.float32(doubts)[:, None, None]
    )
    np.testing.assert_allclose(layers[:, 0, 0, 0], expected, rtol=1e-2 if expected[-1] == 0.68 else 2e-6)


def test_no_layer_becomes_black_however_far_the_sum_is_off():
    rng = np.random.default_rng(3)
    layers = (10 ** rng.uniform(-30, 29, (4, 3, 8, 50))).astype(np.float32)
    beauty = (10 ** rng.uniform(-30, 29, (3, 8, 50))).astype(np.float32)
    before = layers.copy()
    spread_rest(layers, beauty, rng.uniform(0.25, 1, (4, 8, 50)).astype(np.float32))
    np.testing.assert_allclose(layers.sum(axis=0, dtype=np.float64), beauty, rtol=3e-6)
    is_more = beauty > before.sum(axis=0, dtype=np.float64)
    assert (layers >= before * 0.999)[is_more & (before > 1e-6 * before.sum(axis=0, dtype=np.float64))].all()
    share = layers / beauty.astype(np.float64) / (before / before.sum(axis=0, dtype=np.float64))
    assert share[(layers > 1e-36) & ~is_more].min() > 0.05


@pytest.mark.parametrize("model", ["balanced", "best"])
def test_a_layer_without_noise_gets_little_of_the_error_of_the_beauty(tmp_path, model):
    """It has as much light as a noisy layer beside it."""
    light = np.full((HEIGHT, WIDTH, 3), 0.4, np.float32)
    pair = write_pair(tmp_path, {"light_key": light, "light_sky": light}, noise_free=["light_sky"])
    _, out = fused(pair, tmp_path / "out.exr", model)
    off = np.abs(layer(out) - 0.8).mean()
    assert off > 1e-3
    assert np.abs(layer(out, "light_sky") - 0.4).mean() < 0.3 * off


def test_light_of_a_layer_without_noise_does_not_leak_over_its_edge(tmp_path, model):
    """A bright window in a dim room, whose edges lie within LRHS pixels."""
    window = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    window[21:58, 42:87] = 3.0
    room = np.where(window > 0, 0, 0.1 * picture(HEIGHT, WIDTH))
    pair = write_pair(tmp_path, {"light_key": room, "light_sky": window}, noise_free=["light_sky"])
    (lamps,) = map_render(open_exr(pair[1])).additive_sets
    assert [each.name for each in check_sum(map_render(open_exr(pair[1])), lamps).noise_free] == ["light_sky"]
    _, out = fused(pair, tmp_path / "out.exr", model)
    outside = np.ones((HEIGHT, WIDTH), bool)
    outside[20:59, 41:88] = False
    assert layer(out, "light_sky")[outside].max() == 0
    assert layer(out, "light_key")[outside].min() > 0


@pytest.mark.parametrize("quality", ["balanced", "best"])
@pytest.mark.parametrize("shape", ["caustic", "mirror image"])
def test_hardly_any_light_leaks_over_an_edge_that_only_one_layer_has(tmp_path, quality, shape):
    """A wall of one colour on which light ends, for a caustic or what a mirror shows."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    outside = np.hypot(x - 61, y - 45) - 18 if shape == "caustic" else 60.5 - x  # pixels from the edge
    wall = np.full((HEIGHT, WIDTH, 3), 0.3, np.float32)
    clean = {
        "light_wall": wall,
        "light_edge": np.where(outside[..., None] < 0, np.float32(1.5), 0) * np.ones_like(wall),
    }
    pair = write_pair(tmp_path, clean, extra=rgb(np.full_like(wall, 0.5), "albedo."))
    _, out = fused(pair, tmp_path / "out.exr", quality)
    leak = layer(out, "light_edge").mean(axis=-1) / 1.5
    assert leak[(outside >= 1) & (outside < 4)].mean() < 0.03
    assert leak[(outside >= 4) & (outside < 16)].mean() < 0.005
    assert leak[outside >= 24].max() == 0


def test_saturated_lamps_get_no_light_of_another_colour(tmp_path, model):
    x = np.linspace(0, 1, WIDTH, dtype=np.float32)[None, :, None]
    grey = picture(HEIGHT, WIDTH).mean(axis=-1, keepdims=True)
    red, blue = (2 * grey * share * np.float32(colour) for share, colour in ((1 - x, (1, 0, 0)), (x, (0, 0, 1))))
    clean = {
        "light_red": red,
        "light_blue": blue,
        "light_white": np.float32(0.2) * grey * np.ones((1, 1, 3), np.float32),
    }
    _, out = fused(write_pair(tmp_path, clean), tmp_path / "out.exr", model)
    assert layer(out, "light_red")[..., 1:].max() == layer(out, "light_blue")[..., :2].max() == 0
    assert_sum([layer(out, name) for name in clean], layer(out))


def test_negative_light_becomes_black(tmp_path, model):
    """Colours out of gamut have negative channels."""
    clean = lights()
    clean["light_spot"] = clean["light_spot"] * np.float32((-0.2, 1, 1))
    _, out = fused(write_pair(tmp_path, clean), tmp_path / "out.exr", model)
    for name in ("", *clean):
        assert np.isfinite(layer(out, name)).all() and layer(out, name).min() >= 0
    assert not layer(out, "light_spot")[..., 0].any()
    assert_sum([layer(out, name) for name in clean], layer(out))


def test_light_in_no_layer_is_left_out(tmp_path, model):
    clean = lights() | {"light_rest": 0.2 * picture(HEIGHT, WIDTH)}
    pair = write_pair(tmp_path, clean, beauty=lambda layers: sum(v.astype(np.float64) for v in layers.values()))
    sums = ("some=light_key+light_spot",)
    report, out = fused(pair, tmp_path / "out.exr", model, ("some",), sums)
    assert report.passes == {"some": "fused: light_key, light_spot; 17.6% of the beauty's light is in none of them"}
    rest = layer(out) - layer(out, "light_key") - layer(out, "light_spot")
    assert rest.min() >= -1e-5 * layer(out).max()
    assert np.mean((rest - clean["light_rest"]) ** 2) < 0.02


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@pytest.mark.parametrize("low", [True, False])
def test_products_of_light_and_colour_sum_too(tmp_path, model, low, dtype):
    colour = np.where(picture(HEIGHT, WIDTH) > 0.3, np.float32(0.8), np.float32(0.0))
    clean = {"DiffDir": lights()["light_key"], "DiffInd": 0.3 * picture(HEIGHT, WIDTH), "Emit": lights()["light_spot"]}
    small = downsampled(colour)
    colours = {HEIGHT: colour.astype(dtype), len(small): small.astype(dtype)}

    def beauty(layers):
        albedo = colours[len(layers["Emit"])]
        return (layers["DiffDir"].astype(np.float64) + layers["DiffInd"]) * albedo + layers["Emit"]

    pair = write_pair(tmp_path, clean, dtype, low, beauty=beauty)
    for path in pair:
        channels = read_bits(path)[0][1]
        write_exr(path, channels | rgb(colours[len(channels["R"])], "DiffCol."))
    sums = ("components=DiffDir*DiffCol+DiffInd*DiffCol+Emit",)
    report, out = fused(pair, tmp_path / "out.exr", model, sums=sums)
    assert list(report.passes) == ["components"]
    assert ("HRLS alone" in report.passes["components"]) is not low
    parts = [layer(out, name) * layer(out, "DiffCol") for name in ("DiffDir", "DiffInd")]
    assert_sum([*parts, layer(out, "Emit")], layer(out))
    assert not layer(out, "DiffDir")[layer(out, "DiffCol") == 0].any()
    (stored,) = json.loads(open_exr(tmp_path / "out.exr").metadata["msspl/passes"])
    assert stored == {"name": "components", "layers": [["DiffDir", "DiffCol"], ["DiffInd", "DiffCol"], ["Emit"]]}
    fused(pair, tmp_path / "plain.exr", model, passes=("none",))
    assert open_exr(tmp_path / "plain.exr").metadata["msspl/passes"] == "[]"


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_hardly_any_light_in_all_layers_stays_finite(tmp_path):
    """The beauty has 10^40 times as much, as a network may leave it where the renders are black."""
    dark = np.full((HEIGHT, WIDTH, 3), 1e-41, np.float32)
    low, high = (map_render(open_exr(file)) for file in write_pair(tmp_path, {"light_a": dark, "light_b": dark}))
    beauty = np.full((HEIGHT, WIDTH, 3), 0.1, np.float32)
    result = fuse_layers_of(low, high, beauty)
    channels = [each.channels[0] for each in result.jobs[0].layers.layers]
    total = sum(result.pixels.planes[channel] for channel in channels)
    np.testing.assert_allclose(total, 0.1, rtol=1e-5)


def test_a_lamp_whose_square_overflows_stays_finite(tmp_path, model):
    clean = lights()
    clean["light_spot"] = clean["light_spot"].copy()
    clean["light_spot"][40:44, 72:76] = 1e25
    pair = write_pair(tmp_path, clean)
    _, out = fused(pair, tmp_path / "out.exr", model)
    total = layer(out, "light_key") + layer(out, "light_spot")
    assert np.isfinite(total).all() and layer(out).max() > 1e20
    np.testing.assert_allclose(total, layer(out), rtol=1e-5, atol=1e-6)


def test_a_lamp_that_is_too_bright_for_half_is_left_out_of_the_sum(tmp_path):
    clean = lights()
    for each in clean.values():
        each[40:44, 72:76] = 5e4  # together more than half can hold

    def clipped(layers):
        return np.minimum(sum(each.astype(np.float32) for each in layers.values()), 65504)

    pair = write_pair(tmp_path, clean, np.float16, beauty=clipped, noise_free=clean)
    high = map_render(open_exr(pair[1]))
    (lamps,) = high.additive_sets
    assert not check_sum(high, lamps).problem


def test_layers_that_are_too_bright_for_half_are_counted(tmp_path, model):
    """The beauty is float, so it has more light than they can hold."""
    clean = lights()
    clean["light_spot"][40:44, 72:76] = 9e4
    pair = write_pair(tmp_path, clean, noise_free=clean)
    for path in pair:
        ((_, channels),) = read_bits(path)
        with np.errstate(over="ignore"):
            half = {name: v.astype(np.float16) for name, v in channels.items() if name.startswith("light")}
        write_exr(path, channels | half)
    report, out = fused(pair, tmp_path / "out.exr", model)
    assert layer(out, "light_spot").max() <= 65504 < layer(out).max()
    assert any("light groups: " in each and "too bright for half and were clipped" in each for each in report.warnings)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_the_brightest_floats_are_compared_without_a_warning(tmp_path):
    clean = lights()
    clean["light_spot"][40:44, 72:76] = 3e38
    high = map_render(open_exr(write_pair(tmp_path, clean, noise_free=clean)[1]))
    (lamps,) = high.additive_sets
    assert check_sum(high, lamps).text.startswith("sums to the beauty")


def test_a_layer_that_the_lrhs_lacks_is_named_and_the_others_are_read_from_both(tmp_path, model):
    clean = lights() | {"light_fill": np.float32(0.3) * picture(HEIGHT, WIDTH)}
    keys = []
    for missing in ((), ("light_spot",), tuple(clean)):
        pair = write_pair(tmp_path, clean, hrls_alone=missing)
        report, out = fused(pair, tmp_path / "out.exr", model)
        warnings = [text for text in report.warnings if "light" in text]
        if missing == ("light_spot",):
            assert warnings == ["light groups: the LRHS lacks light_spot, so more noise is left there"]
            assert report.passes["light groups"].endswith("light_spot (light_spot from the HRLS alone)")
        else:
            assert not warnings
        assert_sum([layer(out, name) for name in clean], layer(out))
        keys.append(layer(out, "light_key")[:, :40])  # far from the spot
    both, one_lacks, all_lack = keys
    assert np.abs(one_lacks - both).mean() < np.abs(one_lacks - all_lack).mean() / 2


def test_layers_of_an_lrhs_that_do_not_sum_are_not_read(tmp_path, bilinear_models):
    def beauty(layers):
        total = sum(v.astype(np.float64) for v in layers.values())
        return total if len(total) == HEIGHT else noisy(total.astype(np.float32), 3, 9)

    report, out = fused(write_pair(tmp_path, lights(), beauty=beauty), tmp_path / "out.exr", str(bilinear_models[4]))
    (warning,) = (text for text in report.warnings if "light" in text)
    assert warning.startswith("light groups: the LRHS's layers do not sum to its beauty, so they are not read: they")
    _, alone = fused(
        write_pair(tmp_path, lights(), beauty=beauty, low=False), tmp_path / "out.exr", str(bilinear_models[4])
    )
    np.testing.assert_array_equal(layer(out, "light_key"), layer(alone, "light_key"))


def wide_filter(image):
    """Mean over 3 x 3 pixels."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), "edge")
    return sliding_window_view(padded, (3, 3), axis=(0, 1)).mean(axis=(-1, -2))


@pytest.mark.parametrize(
    ("beauty", "message"),
    [
        (lambda layers: layers["light_key"], "more light; without light_spot they would sum to it"),
        (lambda layers: 0.5 * layers["light_key"], "more light; some layers overlap"),
        (lambda layers: noisy(sum(layers.values()).astype(np.float32), 3, 9), "denoised"),
        (lambda layers: wide_filter(sum(layers.values())), "or made with another pixel filter?"),
    ],
)
def test_layers_that_do_not_sum_are_passed_on(tmp_path, bilinear_models, beauty, message):
    pair = write_pair(tmp_path, lights(), beauty=beauty)
    report, out = fused(pair, tmp_path / "out.exr", str(bilinear_models[4]))
    assert report.passes["light groups"].startswith("passed on: does not sum to the beauty")
    assert message in report.passes["light groups"]
    assert same_bits(out["light_spot.G"], read_bits(pair[1])[0][1]["light_spot.G"])
    assert not [text for text in report.warnings if "light" in text]
    report, _ = fused(pair, tmp_path / "out.exr", str(bilinear_models[4]), sums=("mine=light_spot+light_key",))
    assert [text for text in report.warnings if text.startswith("--sum mine: does not sum to the beauty")]


@pytest.mark.parametrize(
    ("passes", "sums", "message"),
    [
        (("reflection*",), (), "--passes reflection.*no such set.*'light groups'"),
        ((), ("a=light_key",), "write NAME=LAYER"),
        ((), ("a=light_key+light_none",), "no layer 'light_none'"),
        ((), 2 * ("a=light_key+light_spot",), "two sets are called 'a'"),
        (("none",), ("a=light_key+light_spot",), "--sum and --passes none exclude each other"),
    ],
)
def test_a_wrong_name_is_one_sentence_before_the_work(tmp_path, bilinear_models, monkeypatch, passes, sums, message):
    pair = write_pair(tmp_path, lights())
    monkeypatch.setattr(settings, "load_model", pytest.fail)
    with pytest.raises(InputError, match=message):
        fused(pair, tmp_path / "out.exr", str(bilinear_models[4]), passes, sums)
    assert not (tmp_path / "out.exr").exists()


def test_passes_that_layers_leaves_out_are_said_to_be_left_out(tmp_path, bilinear_models):
    pair = write_pair(tmp_path, lights())
    write = WriteOptions(passes=("light*",), layers=("albedo",))
    with pytest.raises(InputError, match="no such set of layers that --layers albedo keeps; it has none"):
        fuse_files(*pair, tmp_path / "out.exr", model=str(bilinear_models[4]), write=write)


def test_the_result_does_not_depend_on_memory(tmp_path, bilinear_models, monkeypatch):
    """Decoded rows of a large frame are kept, or decoded again for each band that needs them."""
    pair = write_pair(tmp_path, lights())
    monkeypatch.setattr("oiio_msspl.image.arrays.MOST_PIXELS", 1000)
    monkeypatch.setattr("oiio_msspl.fusion.passes.bands.BAND_ROWS", 16)
    decode, decoded, results = ExrFile._decode, [], []
    monkeypatch.setattr(ExrFile, "_decode", lambda *given: decoded.append(given) or decode(*given))
    for share in (tiling.STRIPS_FRACTION, 0):
        monkeypatch.setattr(tiling, "STRIPS_FRACTION", share)
        fuse_files(*pair, tmp_path / "out.exr", model=str(bilinear_models[4]), overwrite=True)
        results.append((read_bits(tmp_path / "out.exr"), len(decoded)))
        decoded.clear()
    (results, times) = zip(*results, strict=True)
    assert times[1] > 1.5 * times[0]
    for (_, first), (_, second) in zip(*results, strict=True):
        assert all(same_bits(first[name], second[name]) for name in first)


@pytest.mark.parametrize("quality", ["best", "fast"])
def test_a_small_hrls_is_decoded_once_and_copied_once(tmp_path, monkeypatch, quality):
    """The noise check, the network and the passes share what is decoded. As a large frame, it has the same result."""
    pair = write_pair(tmp_path, lights())
    (part,) = open_exr(pair[1]).parts
    decode, decoded, results = ExrFile._decode, [], []

    def count(file, *given):
        rows = decode(file, *given)
        decoded.append(rows.size if file.path == pair[1] else 0)
        return rows

    monkeypatch.setattr(ExrFile, "_decode", count)
    for most in (arrays.MOST_PIXELS, 1000):
        monkeypatch.setattr(arrays, "MOST_PIXELS", most)
        fuse_files(*pair, tmp_path / "out.exr", model=quality, overwrite=True)
        results.append((read_bits(tmp_path / "out.exr"), sum(decoded) / (len(part.channels) * HEIGHT * WIDTH)))
        decoded.clear()
    (small, large), reads = zip(*results, strict=True)
    assert reads[0] <= 2 < reads[1]
    assert all(same_bits(small[0][1][name], large[0][1][name]) for name in small[0][1])


@pytest.mark.parametrize("by_network", [False, True])
def test_each_row_of_the_layers_is_decoded_once(tmp_path, monkeypatch, by_network):
    """To check the sums of two sets, and to fuse them in several bands."""
    pair = [map_render(open_exr(path)) for path in write_levels(tmp_path, {"diffuse_key": {"diffuse", "key"}})]
    session = load_model(4, "best", threads=1)
    beauty = fuse(*pair, session)
    monkeypatch.setattr(bands, "BAND_ROWS", 32)
    decode, rows = ExrFile._decode, {render.file.path: [] for render in pair}

    def count(file, part, first, last, *others):
        rows[file.path] += range(first, last)
        return decode(file, part, first, last, *others)

    monkeypatch.setattr(ExrFile, "_decode", count)
    fuse_layers_of(*pair, beauty, session=session if by_network else None)
    for render in pair:
        assert sorted(rows[render.file.path]) == list(range(render.data_window.height))


def lobes_by_light():
    """Clean light of two lobes, direct and indirect, of two lamps; and of an emitter."""
    lamps = {"key": lights()["light_key"], "spot": lights()["light_spot"].astype(np.float32)}
    shares = {"diffuse_direct": 0.5, "diffuse_indirect": 0.2, "specular_direct": 0.2, "specular_indirect": 0.1}
    layers = {f"{lobe}_{lamp}": share * light for lobe, share in shares.items() for lamp, light in lamps.items()}
    emission = np.zeros_like(layers["diffuse_direct_key"])
    emission[20:30, 10:30] = (3.0, 2.0, 0.5)
    return layers | {"emission": emission}


def write_levels(folder, extra, dtype=np.float32):
    """A pair with :func:`lobes_by_light`, and coarser layers ``extra``: by name, the words of their parts."""
    pair = write_pair(folder, lobes_by_light(), dtype)
    for path in pair:
        channels = read_bits(path)[0][1]
        fine = [name for name in lobes_by_light() if name != "emission"]
        for name, words in extra.items():
            parts = [layer(channels, each) for each in fine if words <= set(each.split("_"))]
            channels |= rgb(sum(parts).astype(dtype), f"{name}.")
        write_exr(path, channels, **{"arnold/AA_samples": "3"})
    return pair


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_coarser_layers_are_sums_of_the_finest(tmp_path, model, dtype):
    extra = {name: set(name.split("_")) for name in ("diffuse", "diffuse_key", "specular_direct", "specular")}
    extra |= {f"RGBA_{lamp}": {lamp} for lamp in ("key", "spot")}
    pair = write_levels(tmp_path, extra, dtype)
    report, out = fused(pair, tmp_path / "out.exr", model)
    fine = list(lobes_by_light())
    assert set(report.passes) == {"light groups", "components", "finest components"}
    assert all(text.startswith("fused: ") for text in report.passes.values())
    assert report.passes["finest components"].endswith("sums of these: diffuse_key, specular_direct")
    assert_sum([layer(out, name) for name in fine], layer(out))
    for name, words in extra.items():
        assert_sum([layer(out, each) for each in fine if words <= set(each.split("_"))], layer(out, name))
    assert_sum([layer(out, name) for name in ("diffuse", "specular", "emission")], layer(out))


def test_a_coarser_layer_whose_pixels_are_no_sum_is_passed_on(tmp_path, bilinear_models):
    pair = write_levels(tmp_path, {"diffuse_key": {"diffuse", "direct"}})  # wrong by its pixels
    report, out = fused(pair, tmp_path / "out.exr", str(bilinear_models[4]))
    assert "sums of these" not in report.passes["finest components"]
    assert same_bits(out["diffuse_key.R"], read_bits(pair[1])[0][1]["diffuse_key.R"])


def test_a_coarser_layer_with_another_data_window_is_passed_on(tmp_path, bilinear_models):
    pair = write_levels(tmp_path, {"diffuse_key": {"diffuse", "key"}})
    channels = read_bits(pair[1])[0][1]
    cropped = {name: channels.pop(name)[20:] for name in list(channels) if name.startswith("diffuse_key.")}
    write_exr(pair[1], [("rgba", channels, (0, 0)), ("cropped", cropped, (0, 20))], **{"arnold/AA_samples": "3"})
    report, out = fused(pair, tmp_path / "out.exr", str(bilinear_models[4]))
    assert report.passes["finest components"].startswith("fused: ")
    assert "sums of these" not in report.passes["finest components"]
    assert all(same_bits(out[name], values) for name, values in cropped.items())


def test_a_light_that_takes_light_away_is_passed_on(tmp_path, bilinear_models):
    """A few negative values, as pixel filters make them, are none."""
    clean = lights()
    dimmer = -0.3 * clean["light_spot"].astype(np.float32)
    pair = write_pair(tmp_path, clean | {"light_dim": dimmer}, noise_free=("light_dim", "light_spot"))
    report, out = fused(pair, tmp_path / "out.exr", str(bilinear_models[4]))
    assert report.passes["light groups"] == "passed on: can't be fused: the layer light_dim is negative"
    assert same_bits(out["light_dim.R"], dimmer[..., 0])
    clean["light_key"][20:40, 20:40] *= -0.05
    report, _ = fused(write_pair(tmp_path, clean), tmp_path / "out.exr", str(bilinear_models[4]))
    assert report.passes["light groups"].startswith("fused: ")


def test_broken_values_of_a_layer_are_told(tmp_path, model, monkeypatch):
    """Whether it is fused in one band or in several."""
    clean = lights()
    pair = write_pair(tmp_path, clean)
    channels = read_bits(pair[1])[0][1]
    channels["light_key.R"][30:40, 50:60] = np.nan
    write_exr(pair[1], channels)
    for rows in (bands.BAND_ROWS, 16):
        monkeypatch.setattr(bands, "BAND_ROWS", rows)
        report, out = fused(pair, tmp_path / "out.exr", model)
        assert "light_key: 100 values of the HRLS are NaN or infinite; they were repaired" in report.warnings
        assert_sum([layer(out, name) for name in clean], layer(out))


def test_light_groups_and_components_may_share_a_layer(tmp_path, model):
    """Each set sums to the beauty; the shared layer has the value that the larger set gives it."""
    emission = lobes_by_light()["emission"]
    clean = lights() | {"light_rim": 0.2 * picture(HEIGHT, WIDTH), "emission": emission}
    pair = write_pair(tmp_path, clean)
    for path in pair:
        channels = read_bits(path)[0][1]
        lit = sum(layer(channels, name) for name in clean if name != "emission")
        share = (np.linspace(0.2, 0.8, lit.shape[1]) * np.ones(lit.shape[:2]))[..., None]
        channels |= rgb((lit * share).astype(np.float32), "diffuse.")
        channels |= rgb((lit * (1 - share)).astype(np.float32), "specular.")
        write_exr(path, channels)
    sums = ("lights=light_key+light_spot+light_rim+emission", "parts=diffuse+specular+emission")
    report, out = fused(pair, tmp_path / "out.exr", model, sums=sums)
    assert report.passes["parts"] == "fused: diffuse, specular, emission"
    assert report.passes["lights"].startswith("fused")
    for names in (("light_key", "light_spot", "light_rim", "emission"), ("diffuse", "specular", "emission")):
        assert_sum([layer(out, name) for name in names], layer(out))
        assert all(layer(out, name).min() >= 0 for name in names)
    _, alone = fused(pair, tmp_path / "lights.exr", model, ("lights",), sums[:1])
    assert all(same_bits(out[f"{name}.{c}"], alone[f"{name}.{c}"]) for name in clean for c in "RGB")
    _, raw = fused(pair, tmp_path / "raw.exr", model, ("none",))
    truth = (sum(clean.values()) - emission) * np.linspace(0.2, 0.8, WIDTH)[None, :, None]
    errors = [np.mean((layer(channels, "diffuse") - truth) ** 2) for channels in (out, raw)]
    assert errors[0] < errors[1] / 5


def test_a_set_that_shares_layers_with_two_others_is_passed_on(tmp_path, bilinear_models):
    clean = lobes_by_light()
    names = list(clean)
    pair = write_pair(tmp_path, clean)
    for path in pair:
        channels = read_bits(path)[0][1]
        half = sum(layer(channels, name) for name in names[:4])
        rest = sum(layer(channels, name) for name in names[4:])
        write_exr(path, channels | rgb(half.astype(np.float32), "a.") | rgb(rest.astype(np.float32), "b."))
    sums = (f"first=b+{'+'.join(names[:4])}", f"second=a+{'+'.join(names[4:])}", "third=a+b")
    report, _ = fused(pair, tmp_path / "out.exr", str(bilinear_models[4]), sums=sums)
    assert report.passes["third"] == "passed on: shares b with another set that does not have its other layers"
    assert [text for text in report.warnings if text.startswith("--sum third: shares")]


def test_an_emitter_leaves_nothing_to_the_other_set(tmp_path, model):
    """Where all light is the shared layer's, the other layers of the second set stay exactly black."""
    dark = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    lamp, glow = dark.copy(), dark.copy()
    lamp[:, :40], glow[:, 80:] = (0.7, 0.3, 0.1), (3.0, 2.0, 0.7)
    clean = {"key": 0.5 * lamp, "fill": 0.5 * lamp, "rim": 0.1 * lamp, "glow": glow}
    pair = write_pair(tmp_path, clean)
    for path in pair:
        channels = read_bits(path)[0][1]
        lit = layer(channels, "key") + layer(channels, "fill") + layer(channels, "rim")
        write_exr(
            path, channels | rgb((0.4 * lit).astype(np.float32), "a.") | rgb((0.6 * lit).astype(np.float32), "b.")
        )
    report, out = fused(pair, tmp_path / "out.exr", model, sums=("x=key+fill+rim+glow", "y=a+b+glow"))
    assert all(text.startswith("fused") for text in report.passes.values())
    for name in ("a", "b", "key"):
        assert not layer(out, name)[:, 88:].any()
    assert np.abs(layer(out, "a") + layer(out, "b") + layer(out, "glow") - layer(out)).max() <= 1e-5


def test_an_lrhs_with_a_wide_filter_does_not_blur_small_lamps(tmp_path):
    """Lamps are smaller than an LRHS pixel, whose filter reaches the pixels around."""
    lamps = np.zeros((HEIGHT + 2, WIDTH + 2, 3), np.float32)
    lamps[10::16, 10::16] = lamps[11::16, 10::16] = 30
    layers = {"light_key": np.full_like(lamps, 0.5), "light_lamps": lamps}
    narrow = {name: downsample(values, 4) for name, values in layers.items()}
    tent = np.array([1, 2, 1], np.float32) / 4
    padded = {name: np.pad(values, ((1, 1), (1, 1), (0, 0)), "edge") for name, values in narrow.items()}
    windows = {name: sliding_window_view(values, (3, 3), (0, 1)) for name, values in padded.items()}
    wide = {name: np.einsum("yxcij,i,j->yxc", values, tent, tent) for name, values in windows.items()}
    files = {"hr": layers, "narrow": narrow, "wide": wide}
    maps = {}
    for file, images in files.items():
        channels = rgb(sum(images.values())).copy()
        for name, values in images.items():
            channels |= rgb(values.astype(np.float32), f"{name}.")
        maps[file] = map_render(open_exr(write_exr(tmp_path / f"{file}.exr", channels)))
    beauty = sum(layers.values())
    errors = {}
    for low in ("narrow", "wide"):
        lr, hr = maps[low], maps["hr"]
        result = fuse_layers_of(lr, hr, beauty).pixels
        channels = {c.name: c for part in hr.file.parts for c in part.channels}
        made = np.stack([result.planes[channels[f"light_lamps.{c}"]] for c in "RGB"], axis=-1)
        errors[low] = np.sqrt(np.mean((made - lamps) ** 2))
    assert errors["wide"] < 1.4 * errors["narrow"]
