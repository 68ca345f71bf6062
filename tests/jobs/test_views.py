# SPDX-License-Identifier: Apache-2.0
"""All views and view layers of a pair are fused in one run, each with its own passes."""

import weakref

import numpy as np
import pytest

from oiio_msspl import InputError, InputOptions, WriteOptions, fuse_files, fuse_shot
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.inspection import inspect_file
from oiio_msspl.jobs import files, run
from oiio_msspl.jobs.fitting import check_files
from oiio_msspl.jobs.inputs import find_views, map_pair
from oiio_msspl.jobs.write import write_settled
from tests.conftest import downsample, noisy, picture, read_bits, rgb, same_bits, write_exr

HEIGHT, WIDTH = 64, 96
#: Header attributes by which a file counts as Cycles'.
CYCLES = {"cycles.fg.samples": "1", "cycles.bg.samples": "1"}


def beauty(layer):
    """The clean picture of a view layer, and of its light groups."""
    clean = picture(HEIGHT, WIDTH) * (1 if layer == "fg" else 0.3)
    share = np.linspace(0.1, 0.9, WIDTH, dtype=np.float32)[None, :, None]
    return {"Combined_key": clean * share, "Combined_fill": clean * (1 - share)}


def channels_of(layer, spp, scale, dtype=np.float32):
    """A view layer's channels: beauty with alpha, two light groups and an albedo."""
    parts = {name: downsample(values, scale) for name, values in beauty(layer).items()}
    parts = {name: noisy(values, spp, seed).astype(dtype) for seed, (name, values) in enumerate(parts.items())}
    total = sum(parts.values()).astype(dtype)
    alpha = np.full((*total.shape[:2], 1), 0.5, dtype)
    alpha[: len(alpha) // 2] = 1
    channels = rgb(np.concatenate([total, alpha], -1), f"{layer}.Combined.", "RGBA")
    for name, values in parts.items():
        channels |= rgb(values, f"{layer}.{name}.")
    albedo = (downsample(picture(HEIGHT, WIDTH), scale) > 0.3).astype(dtype)
    return channels | rgb(albedo, f"{layer}.Denoising Albedo.")


def write_layers(folder, names=("fg", "bg"), low=("fg", "bg"), dtype=np.float32, name="{}.exr"):
    """A pair at x4 with view layers, in one part each."""
    lr = write_exr(folder / name.format("lr"), [(layer, channels_of(layer, 16, 4), (0, 0)) for layer in low], **CYCLES)
    hr = write_exr(
        folder / name.format("hr"), [(layer, channels_of(layer, 1, 1, dtype), (0, 0)) for layer in names], **CYCLES
    )
    return lr, hr


def fused(pair, out, models, view=None, write=None, **more):
    """The report, and {channel: pixels} of the fused file."""
    inputs = InputOptions(view=view)
    report = fuse_files(
        *pair, out, model=str(models[4]), inputs=inputs, write=write or WriteOptions(), overwrite=True, **more
    )
    return report, {name: pixels for _, part in read_bits(out) for name, pixels in part.items()}


@pytest.mark.parametrize("layout", ["spec", "multilayer"])
def test_each_view_layer_is_what_it_is_when_it_is_fused_alone(tmp_path, bilinear_models, layout):
    pair, write = write_layers(tmp_path), WriteOptions(layout=layout)
    alone = {name: fused(pair, tmp_path / f"{name}.exr", bilinear_models, name, write)[1] for name in ("fg", "bg")}
    report, out = fused(pair, tmp_path / "out.exr", bilinear_models, write=write)
    assert [each["view"] for each in report.as_dict()["fused_views"]] == ["fg", "bg"]
    assert report.passes == {
        "light groups": "fused: Combined_fill, Combined_key",
        "bg: light groups": "fused: Combined_fill, Combined_key",
    }
    assert out.keys() == channels_of("fg", 1, 1).keys() | channels_of("bg", 1, 1).keys()
    assert all(same_bits(pixels, alone[name.partition(".")[0]][name]) for name, pixels in out.items())
    assert read_bits(tmp_path / "out.exr")[0][0] == read_bits(tmp_path / "fg.exr")[0][0]
    assert open_exr(tmp_path / "out.exr").metadata["msspl/views"] == "fg, bg"


def test_nukes_layout_holds_all_views(tmp_path, bilinear_models):
    pair, write = write_layers(tmp_path), WriteOptions(layout="nuke")
    fused(pair, tmp_path / "bg.exr", bilinear_models, "bg", write)
    fused(pair, tmp_path / "out.exr", bilinear_models, write=write)
    alone, both = (dict(read_bits(tmp_path / name)) for name in ("bg.exr", "out.exr"))
    assert all(same_bits(both["bg_Combined"][c], alone["rgba"][c]) for c in "RGBA")


def test_a_view_that_is_named_is_the_only_one(tmp_path, bilinear_models):
    pair = write_layers(tmp_path)
    report, out = fused(pair, tmp_path / "out.exr", bilinear_models, "fg")
    raw = channels_of("bg", 1, 1)
    assert all(same_bits(out[name], pixels) for name, pixels in raw.items())
    assert [each["view"] for each in report.as_dict()["fused_views"]] == ["fg"]


def test_both_eyes_of_a_stereo_file_are_fused(tmp_path, bilinear_models):
    clean = {"": picture(HEIGHT, WIDTH), "right.": picture(HEIGHT, WIDTH)[:, ::-1]}
    pair = []
    for name, scale, spp in (("lr", 4, 16), ("hr", 1, 1)):
        channels = {}
        for prefix, values in clean.items():
            channels |= rgb(noisy(downsample(values, scale), spp), prefix)
        pair.append(write_exr(tmp_path / f"{name}.exr", channels, multiView=["left", "right"]))
    report, both = fused(pair, tmp_path / "out.exr", bilinear_models)
    _, right = fused(pair, tmp_path / "right.exr", bilinear_models, "right")
    assert [each["view"] for each in report.as_dict()["fused_views"]] == ["left", "right"]
    assert all(same_bits(both[f"right.{c}"], right[f"right.{c}"]) for c in "RGB")
    assert not same_bits(both["right.R"], read_bits(pair[1])[0][1]["right.R"])


def test_a_view_layer_may_have_a_data_window_of_its_own(tmp_path, bilinear_models):
    pair = []
    for name, scale, spp in (("lr", 4, 16), ("hr", 1, 1)):
        shown = (np.zeros(2, np.int32), np.array([WIDTH // scale - 1, HEIGHT // scale - 1], np.int32))
        rows = slice(None, 32 // scale)
        cropped = {channel: values[rows] for channel, values in channels_of("bg", spp, scale).items()}
        parts = [("fg", channels_of("fg", spp, scale), (0, 0)), ("bg", cropped, (0, 16 // scale))]
        pair.append(write_exr(tmp_path / f"{name}.exr", parts, display=shown, **CYCLES))
    _, both = fused(pair, tmp_path / "out.exr", bilinear_models)
    _, alone = fused(pair, tmp_path / "bg.exr", bilinear_models, "bg")
    found = [name for name in both if name.startswith("bg")]
    assert found and all(same_bits(both[name], alone[name]) for name in found)


@pytest.mark.parametrize("low", [("fg",), ("fg", "plain")])
def test_a_view_without_partner_is_passed_on_with_one_sentence(tmp_path, bilinear_models, low):
    pair = write_layers(tmp_path, low=low)
    report, out = fused(pair, tmp_path / "out.exr", bilinear_models)
    assert [text for text in report.warnings if "bg" in text] == [
        f"bg is passed on as it is: {pair[0]}: no view or view layer 'bg'; the file has {', '.join(low)}"
    ]
    assert all(same_bits(out[name], pixels) for name, pixels in channels_of("bg", 1, 1).items())
    with pytest.raises(InputError, match="no view or view layer 'bg'"):
        fused(pair, tmp_path / "out.exr", bilinear_models, "bg")


def test_the_first_view_is_that_of_the_hrls_in_both_renders(tmp_path, bilinear_models):
    """Whatever the order in the LRHS."""
    report, out = fused(write_layers(tmp_path), tmp_path / "out.exr", bilinear_models)
    report, other = fused(write_layers(tmp_path, low=("bg", "fg")), tmp_path / "other.exr", bilinear_models)
    assert (report.lr.view, report.hr.view) == ("fg", "fg")
    assert all(same_bits(other[name], pixels) for name, pixels in out.items())


def test_a_plain_lrhs_is_the_partner_of_the_first_view_alone(tmp_path, bilinear_models):
    _, hr = write_layers(tmp_path)
    clean = downsample(sum(beauty("fg").values()), 4).astype(np.float32)
    lr = write_exr(tmp_path / "plain.exr", rgb(noisy(clean, 16)))
    report, out = fused((lr, hr), tmp_path / "out.exr", bilinear_models)
    assert any(text.startswith("bg is passed on") and "has no view" in text for text in report.warnings)
    assert same_bits(out["bg.Combined.R"], channels_of("bg", 1, 1)["bg.Combined.R"])


def test_a_view_whose_beauty_is_left_out_is_named(tmp_path, bilinear_models):
    report, out = fused(
        write_layers(tmp_path), tmp_path / "out.exr", bilinear_models, write=WriteOptions(layers=("none",))
    )
    assert "the beauty of bg is left out, because --layers does not name it" in report.warnings
    assert not any(name.startswith("bg") for name in out)


@pytest.mark.parametrize("pattern", ["fg.Combined", "bg.Combined", "Combined"])
def test_the_beauty_of_any_view_may_be_named(tmp_path, bilinear_models, pattern):
    """As `inspect` prints it. That of the first view is written anyway."""
    write = WriteOptions(layers=(pattern,))
    report, out = fused(write_layers(tmp_path), tmp_path / "out.exr", bilinear_models, write=write)
    views = ["fg"] if pattern.startswith("fg") else ["fg", "bg"]
    assert [each["view"] for each in report.as_dict()["fused_views"]] == views
    assert {name.partition(".")[0] for name in out} == set(views)


def test_a_pattern_may_mean_passes_of_another_view(tmp_path, bilinear_models):
    pair = write_layers(tmp_path)
    raw = {name: values for name, values in channels_of("fg", 1, 1).items() if "_" not in name}
    hr = write_exr(tmp_path / "hr.exr", [("fg", raw, (0, 0)), ("bg", channels_of("bg", 1, 1), (0, 0))], **CYCLES)
    report, _ = fused((pair[0], hr), tmp_path / "out.exr", bilinear_models, write=WriteOptions(passes=("light*",)))
    assert list(report.passes) == ["bg: light groups"]


def test_passes_of_all_views_are_fused_without_their_beauties(tmp_path, bilinear_models):
    pair = write_layers(tmp_path)
    _, out = fused(pair, tmp_path / "out.exr", bilinear_models, write=WriteOptions(layers=("*_key",)))
    _, everything = fused(pair, tmp_path / "all.exr", bilinear_models)
    assert not any(name.startswith("bg.Combined.") for name in out)
    for name in ("fg.Combined_key.R", "bg.Combined_key.R"):
        assert same_bits(out[name], everything[name])
        assert not same_bits(out[name], channels_of(name[:2], 1, 1)[name])


def test_the_first_view_needs_a_partner_of_its_own(tmp_path, bilinear_models):
    """Not the LRHS of another view of the same file."""
    pair = write_layers(tmp_path, low=("bg",))
    with pytest.raises(InputError, match=r"lr\.exr: has no view or view layer 'fg'.*--view-layer, such as 'bg'"):
        fused(pair, tmp_path / "out.exr", bilinear_models)
    report, _ = fused(pair, tmp_path / "out.exr", bilinear_models, "bg")
    assert report.lr.view == report.hr.view == "bg"


@pytest.mark.parametrize("columns", [slice(None), slice(8, 40)])
def test_an_alpha_of_another_view_may_have_a_data_window_of_its_own(tmp_path, bilinear_models, columns):
    pair = []
    for name, scale, spp in (("lr", 4, 16), ("hr", 1, 1)):
        light = noisy(downsample(picture(HEIGHT, WIDTH), scale), spp)
        parts = [(f"rgba.{view}", rgb(light), (0, 0), {"view": view}) for view in ("left", "right")]
        if name == "hr":
            alpha = np.full((HEIGHT - 20, WIDTH), 0.5, np.float32)[:, columns]
            parts.append(("rgba.main.right", {"A": alpha}, (columns.start or 0, 20), {"view": "right"}))
        pair.append(write_exr(tmp_path / f"{name}.exr", parts))
    report, _ = fused(pair, tmp_path / "out.exr", bilinear_models)
    assert any("right: the alpha has another data window" in text for text in report.warnings)
    assert [planes["A"].shape for name, planes in read_bits(tmp_path / "out.exr") if "A" in planes] == [alpha.shape]


def test_a_full_name_in_a_mapping_means_its_own_view(tmp_path):
    pair = write_layers(tmp_path)
    for entry, first in (("fg.Denoising Albedo", "fg"), ("Denoising Albedo", "fg")):
        inputs = InputOptions({"albedo": entry})
        lr, hr = map_pair(*pair, inputs)
        (_, other), _ = find_views(lr, hr, inputs)
        assert hr.features["albedo"].text.startswith(first)
        assert other.hr.features["albedo"].text == "bg.Denoising Albedo"


def test_a_full_name_of_a_later_view_leaves_the_others_alone(tmp_path):
    """The first view and a third one keep the layers that are found for them."""
    parts = []
    for name in ("fg", "bg", "sky"):
        layers = {key.replace("fg.", f"{name}."): pixels for key, pixels in channels_of("fg", 1, 1).items()}
        parts.append((name, layers | rgb(picture(HEIGHT, WIDTH), f"{name}.paint."), (0, 0)))
    hr = write_exr(tmp_path / "hr.exr", parts, **CYCLES)
    lr = write_exr(
        tmp_path / "lr.exr",
        [
            (name, {k.replace("fg.", f"{name}."): v for k, v in channels_of("fg", 16, 4).items()}, (0, 0))
            for name, *_ in parts
        ],
        **CYCLES,
    )
    inputs = InputOptions({"albedo": "bg.paint"})
    low, high = map_pair(lr, hr, inputs)
    views, _ = find_views(low, high, inputs)
    read = {view.hr.view: view.hr.features["albedo"].text for view in views}
    assert read == {"fg": "fg.Denoising Albedo", "bg": "bg.paint", "sky": "sky.Denoising Albedo"}
    assert inspect_file(hr, inputs).render.features["albedo"].text == "fg.Denoising Albedo"
    alone = map_pair(lr, hr, InputOptions({"albedo": "bg.paint"}, view="fg"))
    assert alone[1].features["albedo"].text == "bg.paint"


def test_what_is_broken_in_a_view_is_said_with_its_name(tmp_path, bilinear_models):
    """Broken pixels, light beyond half, and a doubt about one view alone; one sentence about all views."""
    lr, hr = write_layers(tmp_path, dtype=np.float16)
    channels = channels_of("bg", 1, 1, np.float16)
    low = channels_of("bg", 16, 4)
    for name in [name for name in low if "Combined" in name and name[-1] != "A"]:
        low[name], channels[name] = low[name] * np.float32(1e5), channels[name] * np.float16(4e3)
    channels["bg.Combined.R"][3, 4] = np.nan
    write_exr(hr, [("fg", channels_of("fg", 1, 1, np.float16), (0, 0)), ("bg", channels, (0, 0))], **CYCLES)
    write_exr(lr, [("fg", channels_of("fg", 16, 4), (0, 0)), ("bg", low, (0, 0))], **CYCLES)
    report, out = fused((lr, hr), tmp_path / "out.exr", bilinear_models)
    assert report.repaired == {"bg: hrls.rgb": 1}
    assert any(text.startswith("bg: the HRLS is") for text in report.warnings)
    assert any("too bright for half" in text for text in report.warnings if text.startswith("bg: "))
    assert not any(text.startswith("fg: ") for text in report.warnings)
    assert np.isfinite(out["bg.Combined.R"].astype(np.float32)).all()
    checked = check_files(lr, hr)
    assert not checked.fits and all(text.startswith("bg: ") for text in checked.warnings)


def test_check_and_inspect_look_at_all_views(tmp_path):
    pair = write_layers(tmp_path, low=("fg",))
    checked = check_files(*pair)
    assert checked.fits and len(checked.passed_on) == 1
    found = inspect_file(pair[1], InputOptions())
    assert [view.view for view in found.other_views] == ["bg"]
    assert any(fact.startswith("bg: light groups (Combined_fill, Combined_key): sums") for fact in found.facts)
    assert found.as_dict()["facts"] == found.facts
    assert inspect_file(pair[1], InputOptions(view="fg")).other_views == []


def test_progress_covers_the_tiles_and_the_passes_of_all_views_and_writing(tmp_path, bilinear_models, monkeypatch):
    pair, told = write_layers(tmp_path), []
    monkeypatch.setattr(
        files, "write_settled", lambda *args, **more: told.append("write") or write_settled(*args, **more)
    )
    fused(pair, tmp_path / "out.exr", bilinear_models, progress=lambda done, count: told.append(done / count))
    at = told.index("write")
    shares = told[:at] + told[at + 1 :]
    # For each view one tile, and one band of one set.
    assert len(set(shares)) >= 6 and shares == sorted(shares)
    assert (shares[0], told[-1]) == (0, 1) and 0.5 < told[at - 1] < 1


def test_memory_holds_one_view_at_a_time(tmp_path, bilinear_models, monkeypatch):
    """Every view is fused with the whole of the memory, and the others are on the disk by then."""
    pair = write_layers(tmp_path)
    alive = []

    def fuse(*args, **options):
        frame = original(*args, **options)
        assert not [each for each in alive if each() is not None]
        alive.append(weakref.ref(frame.rgb))
        return frame

    original = run.fuse
    monkeypatch.setattr(run, "fuse", fuse)
    fused(pair, tmp_path / "out.exr", bilinear_models)
    assert len(alive) == 2


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_shots_fuse_all_views(tmp_path, bilinear_models, dtype):
    """As a single frame: passes of half floats sum to the beauty as it is stored."""
    for folder in ("lr", "hr"):
        (tmp_path / folder).mkdir()
    write_layers(tmp_path, dtype=dtype, name="{}/a.0001.exr")
    shot = fuse_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out", model=str(bilinear_models[4]))
    assert [each["view"] for each in shot.first["fused_views"]] == ["fg", "bg"]
    pair = tmp_path / "lr" / "a.0001.exr", tmp_path / "hr" / "a.0001.exr"
    _, single = fused(pair, tmp_path / "single.exr", bilinear_models)
    (written,) = (tmp_path / "out").glob("*.exr")
    found = {name: pixels for _, part in read_bits(written) for name, pixels in part.items()}
    assert found.keys() == single.keys() and all(same_bits(found[name], single[name]) for name in single)
