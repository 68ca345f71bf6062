# SPDX-License-Identifier: Apache-2.0
"""Shots whose frames are averaged with their neighbours: the same pixels however the shot is cut or resumed."""

import os
import struct
from dataclasses import replace
from threading import current_thread

import numpy as np
import pytest

from oiio_msspl import InputError, InputOptions, fuse_shot, map_render, open_exr
from oiio_msspl.exr.layers import layers_of
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.motion.source import FLOW, VECTORS, MotionSource
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY
from oiio_msspl.image import parallel
from oiio_msspl.image.arrays import file_of
from oiio_msspl.jobs import frame as reading
from oiio_msspl.jobs import memory
from oiio_msspl.jobs import run as run_module
from oiio_msspl.jobs.memory import budget_view, memory_to_average
from oiio_msspl.jobs.plan import AUTO_COUNT, ShotPlan, TemporalOptions, ViewPlan, plan_temporal, reach_of
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles, find_shot
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.jobs.timeline import ALONE, Reach
from tests import shots
from tests.conftest import downsample, noisy, picture, read_bits, rgb, write_exr
from tests.moving_plane import HEIGHT, positions, standing, texture, truck, vectors
from tests.shots import contents, low_layers

FIRST, COUNT = 1001, 9
#: Passes of the shot with passes.
LAMPS = ("light_key", "light_fill")


def make_moving_shot(folder, camera=truck, count=COUNT, layers=("motion",), seeds=range(COUNT), signs=lambda t: (1, 1)):
    """Pairs at x4 of a textured plane before a moving camera; the HRLS has vectors to the next frame, x to the right
    and y down if their ``signs`` in that frame are 1."""
    for name in ("lr", "hr", "out"):
        (folder / name).mkdir(parents=True)
    for t, seed in zip(range(count), seeds, strict=False):
        places = positions(camera, t)
        clean = texture(places[..., 0], places[..., 1])
        albedo = rgb(clean.astype(np.float32), "albedo.")
        there = vectors(camera, t, 1) * np.float32(signs(t))
        motion = {"motionFore.X": there[..., 0], "motionFore.Y": there[..., 1]} if "motion" in layers else {}
        low = noisy(downsample(clean, 4), 16, 100 + seed)
        write_exr(folder / f"lr/lr.{FIRST + t}.exr", rgb(low.astype(np.float32)))
        write_exr(folder / f"hr/hr.{FIRST + t}.exr", rgb(noisy(clean, 1, seed).astype(np.float32)) | albedo | motion)
    return folder


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return make_moving_shot(tmp_path_factory.mktemp("shot"))


@pytest.fixture(scope="module")
def whole(shot, bilinear_models):
    """The shot, fused in one run."""
    return run(shot, bilinear_models[4], "whole")


def make_shot_with_passes(folder, count=COUNT):
    """A moving shot, lit by two lamps that are passes, each with noise of its own."""
    shot = make_moving_shot(folder, count=count, seeds=range(count))
    for t in range(count):
        for name, spp in (("lr", 16), ("hr", 1)):
            path = shot / f"{name}/{name}.{FIRST + t}.exr"
            channels = read_bits(path)[0][1]
            lamps = {lamp: light_of(lamp, t) for lamp in LAMPS}
            if name == "lr":
                lamps = {lamp: downsample(light, 4) for lamp, light in lamps.items()}
            seeds = range(200 + 10 * t + spp, 1000)
            lamps = {lamp: noisy(lamps[lamp], spp, seed) for lamp, seed in zip(lamps, seeds, strict=False)}
            for lamp, light in lamps.items():
                channels |= rgb(light, f"{lamp}.")
            write_exr(path, channels | rgb(sum(lamps.values())))
    return shot


@pytest.fixture(scope="module")
def shot_with_passes(tmp_path_factory):
    return make_shot_with_passes(tmp_path_factory.mktemp("passes"))


def light_of(lamp, t):
    """Clean light of one of ``LAMPS`` in a frame of the shot with passes, (h, w, 3)."""
    places = positions(truck, t)
    light = texture(places[..., 0], places[..., 1])
    share = (0.5 + 0.4 * np.sin(places[..., :1] / 5)) * np.float32((1, 0.8, 0.4))
    return (light * (share if lamp == "light_key" else 1 - share)).astype(np.float32)


def run(shot, model, output, temporal="auto", **more):
    out = shot / output
    out.mkdir(exist_ok=True)
    report = fuse_shot(shot / "lr", shot / "hr", out, model=str(model), temporal=TemporalOptions(temporal), **more)
    assert report.exit_code == 0, report.results
    return report


def beauty(path):
    """(h, w, 3)"""
    return map_render(open_exr(path), features=()).load().layers["rgb"]


def test_vectors_are_verified_and_frames_are_cleaner(shot, whole, bilinear_models):
    assert "with 4 frames before and after each: motion vectors of motionFore" in whole.temporal
    run(shot, bilinear_models[4], "alone", "off")
    gains = []
    for t in range(2, COUNT - 2):
        places = positions(truck, t)
        clean = texture(places[..., 0], places[..., 1])
        errors = []
        for folder in ("alone", "whole"):
            fused = beauty(shot / folder / f"hr.{FIRST + t}.exr")
            errors.append(np.mean(np.square(fused - clean)[8:-8, 16:-16]))
        gains.append(10 * np.log10(errors[0] / errors[1]))
    assert min(gains) > 0.5, gains


@pytest.mark.parametrize("size", [1, 3, 7])
def test_chunks_are_one_run_bit_for_bit(shot, whole, bilinear_models, size):
    """Each chunk plans for itself, as on a farm."""
    for start in range(FIRST, FIRST + COUNT, size):
        last = min(start + size, FIRST + COUNT) - 1
        report = run(shot, bilinear_models[4], f"chunks{size}", frames=f"{start}-{last}")
        assert report.temporal == whole.temporal
    assert contents(shot / f"chunks{size}") == contents(shot / "whole")


def test_every_second_frame_and_resuming_are_one_run_bit_for_bit(shot, whole, bilinear_models):
    run(shot, bilinear_models[4], "parts", frames=f"{FIRST}-{FIRST + COUNT - 1}x2")
    run(shot, bilinear_models[4], "parts", skip_existing=True)
    assert contents(shot / "parts") == contents(shot / "whole")


def test_a_frame_without_usable_neighbours_is_the_single_frame_bit_for_bit(tmp_path, bilinear_models):
    """Frames 1001 and 1002 verify the vectors; 1005 is alone, and the neighbours of 1008 are broken."""
    folder = make_moving_shot(tmp_path)
    for missing in (1004, 1006):
        (folder / f"lr/lr.{missing}.exr").unlink()
    for broken in (1007, 1009):
        (folder / f"hr/hr.{broken}.exr").write_bytes(b"no EXR")
    out = folder / "out"
    report = fuse_shot(folder / "lr", folder / "hr", out, model=str(bilinear_models[4]))
    alone = folder / "alone"
    alone.mkdir()
    off = TemporalOptions("off")
    fuse_shot(folder / "lr", folder / "hr", alone, model=str(bilinear_models[4]), temporal=off)
    assert {n: result.status for n, result in report.results.items() if result.status != "fused"} == {
        1004: "missing", 1006: "missing", 1007: "failed", 1009: "failed",
    }  # fmt: skip
    for number in (1005, 1008):
        assert contents(out)[f"hr.{number}.exr"] == contents(alone)[f"hr.{number}.exr"]
    assert contents(out)["hr.1002.exr"] != contents(alone)["hr.1002.exr"]
    assert "frame 1004 is missing, so fewer neighbours are averaged" in report.results[1005].warnings
    assert any(text.startswith("frame 1007 is not averaged: ") for text in report.results[1008].warnings)


def turning(t):
    """A camera that moves to the right, and from the third frame on as fast downwards."""
    return np.array([0.03 * min(t, 2), -0.03 * max(t - 2, 0), 1.0])


def planned(shot, **options):
    found = find_shot(shot / "lr", shot / "hr", shot / "out")
    return plan_temporal(found, InputOptions(), TemporalOptions(**options))


def test_what_one_movement_does_not_tell_another_one_does(tmp_path):
    """The first frames move sideways. So y is what the table expects, until later frames show that it is not."""
    shot = make_moving_shot(tmp_path, turning, signs=lambda t: (1, -1))
    plan = planned(shot)
    assert "y=up" in plan.text and plan.count == AUTO_COUNT
    again = planned(make_moving_shot(tmp_path / "expected", turning))
    assert "y=down" in again.text


def test_frames_that_contradict_each_other_are_fused_alone(tmp_path):
    """x changes its sign in the middle of the shot, where the camera moves both ways."""
    both = lambda t: turning(t) if t < 3 else np.array([0.03 * t, -0.03 * (t - 2), 1.0])  # noqa: E731
    shot = make_moving_shot(tmp_path, both, signs=lambda t: (1 if t < 3 else -1, 1))
    plan = planned(shot)
    assert not plan.count
    assert "the frames contradict each other on how motion vectors are stored (frames 1001 and 1002" in plan.text
    with pytest.raises(InputError, match=r"contradict each other .* describe them with --motion-format"):
        planned(shot, frames=2)


def test_other_frames_are_looked_at_if_some_are_broken(tmp_path):
    """The first, the middle and the last pair of frames can't be decoded."""
    shot = make_moving_shot(tmp_path)
    for number in (FIRST, FIRST + COUNT // 2, FIRST + COUNT - 1):
        path = shot / f"hr/hr.{number}.exr"
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "motion vectors of motionFore.XY" in planned(shot).text


def test_zeros_in_some_frames_of_a_moving_shot_are_not_believed(tmp_path, bilinear_models):
    """Cycles writes them if motion blur is on. Of a standing camera they are."""
    folder = make_moving_shot(tmp_path / "moving", count=6)
    for number in (1004, 1005, 1006):
        path = folder / f"hr/hr.{number}.exr"
        channels = read_bits(path)[0][1]
        write_exr(path, channels | {c: 0 * channels[c] for c in ("motionFore.X", "motionFore.Y")})
    run(folder, bilinear_models[4], "alone", "off")
    report = run(folder, bilinear_models[4], "out")
    assert "motion vectors" in report.temporal
    assert contents(folder / "out")["hr.1006.exr"] == contents(folder / "alone")["hr.1006.exr"]
    assert any("are 0, though the picture moves" in text for text in report.results[1005].warnings)
    assert contents(folder / "out")["hr.1002.exr"] != contents(folder / "alone")["hr.1002.exr"]


def test_zeros_while_the_camera_rests_are_believed(tmp_path, bilinear_models):
    folder = make_moving_shot(tmp_path, lambda t: truck(min(t, 2)), count=6)
    run(folder, bilinear_models[4], "alone", "off")
    report = run(folder, bilinear_models[4], "out")
    assert not any("is not averaged" in text for each in report.results.values() for text in each.warnings)
    assert contents(folder / "out")["hr.1005.exr"] != contents(folder / "alone")["hr.1005.exr"]


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_neighbour_that_cannot_be_decoded_is_absent(tmp_path, bilinear_models, monkeypatch, in_memory):
    folder = make_moving_shot(tmp_path, count=4)
    damaged = folder / "hr/hr.1003.exr"
    damaged.write_bytes(damaged.read_bytes()[:-2000])

    def budget(*view, **more):
        return replace(budget_view(*view, **more), on_disk=not in_memory)

    monkeypatch.setattr(reading, "budget_view", budget)
    report = fuse_shot(folder / "lr", folder / "hr", folder / "out", model=str(bilinear_models[4]))
    assert [report.results[n].status for n in range(1001, 1005)] == ["fused", "fused", "failed", "fused"]
    assert any("frame 1003 is not averaged" in text for text in report.results[1002].warnings)


@pytest.mark.parametrize("stage", ["_read_pixels", "fuse"])
def test_frames_beside_one_that_failed_for_another_reason_fail_too(tmp_path, bilinear_models, monkeypatch, stage):
    """Without it they would have other pixels than in a run that does not meet that failure."""
    folder = make_moving_shot(tmp_path, count=7)
    more = {"model": str(bilinear_models[4]), "temporal": TemporalOptions("2")}
    pair = folder / "lr", folder / "hr"
    fuse_shot(*pair, folder / "clean", **more)
    owner = ShotRun if stage == "fuse" else reading
    real = getattr(owner, stage)

    def faulty(*arguments):
        if arguments[owner is ShotRun].number == 1004:
            raise MemoryError
        return real(*arguments)

    monkeypatch.setattr(owner, stage, faulty)
    report = fuse_shot(*pair, folder / "out", **more)
    failed = [n for n, result in report.results.items() if result.status == "failed"]
    # With one frame's renders and one fused frame on each side, a frame depends on two.
    assert failed == ([1002, 1003, 1004, 1005, 1006] if stage == "_read_pixels" else [1003, 1004, 1005])
    assert report.results[1004].message.startswith("out of memory")
    assert "frame 1004, its neighbour, has failed: out of memory" in report.results[1003].message
    assert report.exit_code == 1
    monkeypatch.undo()
    assert fuse_shot(*pair, folder / "out", skip_existing=True, **more).exit_code == 0
    assert contents(folder / "out") == contents(folder / "clean")


@pytest.mark.parametrize("large", ["_vector_bytes", "_pixel_bytes"])
def test_renders_that_do_not_fit_into_memory_give_the_same_pixels(tmp_path, bilinear_models, monkeypatch, large):
    folder = make_moving_shot(tmp_path, count=4)
    fuse_shot(folder / "lr", folder / "hr", folder / "out", model=str(bilinear_models[4]))
    in_memory = contents(folder / "out")
    pixels = []
    real = reading._read_pixels
    monkeypatch.setattr(reading, "_read_pixels", lambda frame: pixels.append(real(frame) or frame.renders.hr))
    monkeypatch.setattr("oiio_msspl.image.arrays.MOST_PIXELS", 10)
    monkeypatch.setattr(memory, large, lambda render, names: 1 << 32)
    fuse_shot(folder / "lr", folder / "hr", folder / "out", model=str(bilinear_models[4]), overwrite=True)
    assert contents(folder / "out") == in_memory
    assert len(pixels) == 4
    assert all(file_of(each.layers["rgb"]) is not None for each in pixels)


@pytest.mark.parametrize(
    ("count", "averaged"), [(1, (0, 1)), (2, (1, 1)), (3, (1, 2)), (4, (2, 2)), (6, (4, 2)), (8, (6, 2))]
)
def test_renders_and_fused_frames_share_the_neighbours(count, averaged):
    assert reach_of(count, VECTORS) == averaged
    assert reach_of(count, FLOW) == (0, count)  # flow is computed on fused frames


def test_without_known_motion_frames_stay_alone(tmp_path, bilinear_models):
    folder = make_moving_shot(tmp_path, layers=(), count=3)
    # Without OpenCV there is no source of motion at all; with it, auto does not take computed motion either.
    report = fuse_shot(folder / "lr", folder / "hr", folder / "out", model=str(bilinear_models[4]))
    assert report.temporal.startswith("frame by frame: no motion vectors")
    alone = run(folder, bilinear_models[4], "alone", "off")
    assert alone.temporal == "" and contents(folder / "out") == contents(folder / "alone")


def test_a_static_camera_needs_no_vectors(tmp_path, bilinear_models):
    folder = make_moving_shot(tmp_path, standing, count=3, layers=())
    report = fuse_shot(folder / "lr", folder / "hr", folder / "out", model=str(bilinear_models[4]))
    assert "the camera stands still" in report.temporal
    run(folder, bilinear_models[4], "alone", "off")
    clean = texture(*np.moveaxis(positions(standing, 0)[..., :2], -1, 0))
    alone, together = (np.mean(np.square(beauty(folder / name / "hr.1002.exr") - clean)) for name in ("alone", "out"))
    assert together < 0.6 * alone


def make_standing_shot(folder, crop=0, fades=COUNT, count=5):
    """Pairs at x4 of a wall before a standing camera, with an object that moves.

    It is as bright as the wall, so the light does not tell where it was. Its albedo does.

    Args:
        crop: rows at the top that every second frame lacks, as a renderer that crops the data window does.
        fades: from this frame on, the left of the wall has less contrast.

    Returns:
        The clean frames (h, w, 3).
    """
    frames = []
    for name in ("lr", "hr"):
        (folder / name).mkdir(parents=True)
    clean = texture(*np.moveaxis(positions(standing, 0)[..., :2], -1, 0))
    height, width = clean.shape[:2]
    object_colour = np.float32((0.15, 0.55, 0.9)) * clean.mean() / np.dot((0.2126, 0.7152, 0.0722), (0.15, 0.55, 0.9))
    for t in range(count):
        frames.append(clean.copy())
        if t >= fades:
            frames[t][:, :64] = 0.5 + 0.5 * (frames[t][:, :64] - 0.5)
        frames[t][20:60, 40 + 8 * t : 72 + 8 * t] = object_colour
        top = crop * (t % 2)
        low, high = noisy(downsample(frames[t], 4), 16, 100 + t), noisy(frames[t], 1, t)
        channels = rgb(high[top:]) | rgb(frames[t][top:], "albedo.")
        for name, image, y, factor in (("lr", rgb(low[top // 4 :]), top // 4, 4), ("hr", channels, top, 1)):
            size = np.array([0, 0], np.int32), np.array([width // factor - 1, height // factor - 1], np.int32)
            write_exr(folder / f"{name}/{name}.{FIRST + t}.exr", [("", image, (0, y))], display=size)
    return frames


@pytest.mark.parametrize("crop", [0, 4])
def test_an_object_that_moves_before_a_standing_camera_leaves_no_ghost(tmp_path, bilinear_models, crop):
    frames = make_standing_shot(tmp_path, crop)
    for temporal in ("auto", "off"):
        report = run(tmp_path, bilinear_models[4], temporal, temporal)
        assert ("the camera stands still" in report.temporal) == (temporal == "auto")
    together, alone = (
        np.square(beauty(tmp_path / name / f"hr.{FIRST + 2}.exr") - frames[2]).mean(axis=-1) for name in ("auto", "off")
    )
    for beside in (slice(36, 54), slice(90, 108)):  # the wall that the object hides in other frames, and its edges
        assert together[20:60, beside].mean() < 1.02 * alone[20:60, beside].mean()
    assert together[8:, 120:].mean() < 0.6 * alone[8:, 120:].mean()


def test_objects_before_a_standing_camera_are_the_same_in_chunks(tmp_path, bilinear_models):
    """From a frame on, the wall has less contrast: by the frame before, the camera stands, by the frame after, it does
    not."""
    make_standing_shot(tmp_path, fades=4, count=7)
    whole = run(tmp_path, bilinear_models[4], "whole")
    assert "the camera stands still" in whole.temporal
    for number in range(FIRST, FIRST + 7):
        run(tmp_path, bilinear_models[4], "chunks", frames=str(number))
    assert contents(tmp_path / "chunks") == contents(tmp_path / "whole")


def test_frames_with_one_seed_are_named(tmp_path, bilinear_models):
    """The noise stays where it is while the picture moves."""
    folder = make_moving_shot(tmp_path, count=3, seeds=[0, 0, 5])
    report = run(folder, bilinear_models[4], "out")
    said = [[text for text in report.results[n].warnings if "same noise" in text] for n in (1001, 1002, 1003)]
    assert [len(texts) for texts in said] == [1, 1, 0]
    assert said[0][0].startswith("frames 1001 and 1002 have the same noise")


def test_the_number_of_neighbours_is_checked():
    for wrong in ("two", "-1", "0", 0, "99", 2.5):
        with pytest.raises(InputError, match="give auto, off, or a number of frames from 1 to"):
            TemporalOptions(wrong)


def test_update_fuses_a_frame_again_whose_neighbour_is_newer(tmp_path, bilinear_models):
    folder = make_moving_shot(tmp_path, count=8)
    run(folder, bilinear_models[4], "out")
    later = (folder / "out/hr.1008.exr").stat().st_mtime + 9
    os.utime(folder / "hr/hr.1002.exr", (later, later))
    report = run(folder, bilinear_models[4], "out", update=True)
    fused = [n for n, result in report.results.items() if result.status == "fused"]
    assert fused == [1001, 1002, 1003, 1004, 1005, 1006]


def layer(path, name):
    """(h, w, 3)"""
    channels = {name: pixels for _, part in read_bits(path) for name, pixels in part.items()}
    return np.stack([channels[f"{name}{c}"] for c in "RGB"], axis=-1).astype(np.float64)


@pytest.mark.parametrize("quality", ["fit", "best"])
def test_passes_are_averaged_with_the_weights_of_the_beauty(shot_with_passes, bilinear_models, quality):
    """They have less noise than those of single frames, and still sum to the beauty."""
    shot, model = shot_with_passes, quality if quality == "best" else bilinear_models[4]
    run(shot, model, f"{quality}-alone", "off")
    run(shot, model, quality, "4")
    gains = []
    for t in range(2, COUNT - 2):
        path = shot / quality / f"hr.{FIRST + t}.exr"
        total = sum(layer(path, f"{lamp}.") for lamp in LAMPS)
        np.testing.assert_allclose(total, layer(path, ""), rtol=2e-6, atol=1e-6)
        clean = light_of("light_key", t)
        errors = [
            np.mean((layer(each, "light_key.") - clean) ** 2) for each in (shot / f"{quality}-alone" / path.name, path)
        ]
        gains.append(10 * np.log10(errors[0] / errors[1]))
    # If only the beauty were averaged, the passes would gain 4.3 and 1.3 dB.
    assert np.mean(gains) > {"fit": 4.8, "best": 2.0}[quality]


def test_broken_and_missing_passes_do_not_change_the_beauty(tmp_path, bilinear_models):
    """A pass of one frame has pixels that are NaN, another frame lacks a pass."""
    shot = make_shot_with_passes(tmp_path, count=7)
    broken, lacking = (shot / f"hr/hr.{n}.exr" for n in (1003, 1007))
    channels = read_bits(broken)[0][1]
    channels["light_key.R"] = channels["light_key.R"].copy()
    channels["light_key.R"][10:20, 30:50] = np.nan
    write_exr(broken, channels)
    write_exr(lacking, {name: v for name, v in read_bits(lacking)[0][1].items() if not name.startswith("light_key.")})
    report = run(shot, bilinear_models[4], "auto", "4")
    run(shot, bilinear_models[4], "none", "4", write=WriteOptions(passes=("none",)))
    for n in range(FIRST, FIRST + 7):
        fused, plain = (layer(shot / name / f"hr.{n}.exr", "") for name in ("auto", "none"))
        np.testing.assert_array_equal(fused, plain)
    total = sum(layer(shot / "auto/hr.1004.exr", f"{lamp}.") for lamp in LAMPS)
    np.testing.assert_allclose(total, layer(shot / "auto/hr.1004.exr", ""), rtol=2e-6, atol=1e-6)
    warnings = {n: [text for text in report.results[n].warnings if "light_key" in text] for n in (1004, 1006)}
    said = "frame 1007 has no set of passes with light_fill and light_key, so passes are not averaged"
    assert warnings == {1004: [], 1006: [said]}


def test_products_of_light_and_colour_are_averaged_as_products(tmp_path, bilinear_models):
    shot = make_shot_with_passes(tmp_path, count=5)
    for path in sorted(shot.glob("?r/*.exr")):
        channels = read_bits(path)[0][1]
        height, width = channels["R"].shape
        tint = np.full((height, width, 3), (0.5, 0.25, 0.8), np.float32)
        tint[: height // 2] = 0
        key, fill = (np.stack([channels[f"{lamp}.{c}"] for c in "RGB"], axis=-1) for lamp in LAMPS)
        write_exr(path, channels | rgb(tint, "tint.") | rgb(key * tint + fill))
    inputs = InputOptions(sums=("parts=light_key*tint+light_fill",))
    run(shot, bilinear_models[4], "out", "4", inputs=inputs)
    path = shot / "out/hr.1003.exr"
    total = layer(path, "light_key.") * layer(path, "tint.") + layer(path, "light_fill.")
    np.testing.assert_allclose(total, layer(path, ""), rtol=3e-6, atol=1e-6)
    assert not layer(path, "light_key.")[:40].any()  # where the colour is black


def test_passes_of_chunks_are_those_of_one_run_bit_for_bit(shot_with_passes, bilinear_models, monkeypatch):
    shot, model = shot_with_passes, bilinear_models[4]
    run(shot, model, "one run", "4")
    monkeypatch.setattr("oiio_msspl.image.arrays.MOST_PIXELS", 1)  # frames wait in temporary files
    run(shot, model, "chunk", "4", frames="1004-1006")
    chunk, one_run = (contents(shot / name) for name in ("chunk", "one run"))
    assert len(chunk) == 3 and chunk.items() <= one_run.items()


def test_frames_are_fused_once_and_kept_as_long_as_needed(shot, bilinear_models, monkeypatch):
    fused, most, most_renders = [], 0, 0
    real, release = ShotRun.fuse, ShotRun._release

    def count(self, frame, *arguments):
        fused.append(frame.number)
        return real(self, frame, *arguments)

    def watch(self):
        nonlocal most, most_renders
        release(self)
        frames = self._frames.values()
        most = max(most, sum(frame.fused is not None for frame in frames))
        most_renders = max(most_renders, sum(isinstance(frame.renders.hr, Render) for frame in frames))

    monkeypatch.setattr(ShotRun, "fuse", count)
    monkeypatch.setattr(ShotRun, "_release", watch)
    run(shot, bilinear_models[4], "once")
    assert fused == list(range(FIRST, FIRST + COUNT)) and (most, most_renders) == (4, 4)


def test_averaging_uses_no_more_threads_than_allowed(shot, whole, bilinear_models, monkeypatch):
    seen = []
    for name in ("average_renders", "average_results"):
        real = getattr(run_module, name)

        def watch(*arguments, real=real):
            seen.append(parallel._thread_limit.get())
            return real(*arguments)

        monkeypatch.setattr(run_module, name, watch)
    run(shot, bilinear_models[4], "one thread", threads=1)
    assert len(seen) == 2 * COUNT and set(seen) == {1}
    assert contents(shot / "one thread") == contents(shot / "whole")


def test_motion_is_read_while_the_network_works(shot, whole, bilinear_models, monkeypatch):
    """The thread that reads a frame also reads its motion from the frame before."""
    read, threads = MotionSource.read, []
    monkeypatch.setattr(MotionSource, "read", lambda *args: threads.append(current_thread().name) or read(*args))
    run(shot, bilinear_models[4], "ahead")
    assert len(threads) == 2 * (COUNT - 1) and all(name.startswith("read") for name in threads)
    assert contents(shot / "ahead") == contents(shot / "whole")


def test_a_frame_that_flashes_stands_alone_and_is_named(tmp_path, bilinear_models):
    """The report says how many frames counted, of each frame and in the mean."""
    shot = make_moving_shot(tmp_path / "shot", count=5)
    for name in ("lr", "hr"):
        path = shot / f"{name}/{name}.{FIRST + 2}.exr"
        channels = read_bits(path)[0][1]
        write_exr(path, channels | {c: channels[c] * np.float32(1.5) for c in "RGB"})
    report = run(shot, bilinear_models[4], "flash")
    counted = {number - FIRST: result.frames_counted for number, result in report.results.items()}
    assert counted[2] < 1.1 < 2 < min(counted[t] for t in (0, 1, 3, 4))
    named = [number - FIRST for number, result in report.results.items() if "hardly count" in str(result.warnings)]
    assert named == [2]
    assert f"a pixel counts {sum(counted.values()) / 5:.1f} frames" in report.temporal_text


def test_no_more_frames_count_than_a_shot_has(tmp_path, bilinear_models):
    shot = make_moving_shot(tmp_path / "shot", standing, 3, layers=())
    report = run(shot, bilinear_models[4], "short")
    assert 2 < report.frames_counted <= 3


def test_the_order_of_a_part_begins_with_its_neighbours():
    frames = {n: FrameFiles(n, None, None, None) for n in (1, 2, 3, 5, 6, 7, 8, 9)}
    plan = ShotPlan(frames, {None: ViewPlan(Reach(1, 1))})

    def order(number):
        return [files.number for files in ShotRun(Settings(), plan, [frames[number]]).order]

    assert order(7) == [5, 6, 7, 8, 9] and order(3) == [1, 2, 3]
    assert plan.missing(3) == [4] and plan.missing(6) == [4] and plan.missing(1) == []


def test_large_frames_wait_in_temporary_files(shot, whole, bilinear_models, monkeypatch):
    monkeypatch.setattr("oiio_msspl.image.arrays.MOST_PIXELS", 100)
    run(shot, bilinear_models[4], "on disk")
    assert contents(shot / "on disk") == contents(shot / "whole")
    window = Window(0, 0, 4096, 2160)
    monkeypatch.undo()
    assert sum(memory_to_average(Reach(2, 2), window, 12, 2)) < 1 << 30
    assert sum(memory_to_average(Reach(2, 2), Window(0, 0, 1920, 1080), 12, 2)) < 1 << 29
    assert sum(memory_to_average(ALONE, window, 12, 2)) == 0


def test_the_number_of_frames_that_counted_is_a_layer(shot, bilinear_models):
    write = WriteOptions(frames_layer=True)
    run(shot, bilinear_models[4], "counted", write=write, frames="1001-1003")
    run(shot, bilinear_models[4], "ones", "off", write=write, frames="1001")
    files = {name: open_exr(shot / f"{name}.exr") for name in ("counted/hr.1001", "counted/hr.1003", "ones/hr.1001")}
    counts = {}
    for name, file in files.items():
        (layer,) = [layer for layer in layers_of(file) if layer.name == "frames"]
        counts[name] = file.read(list(layer.channels.values()), map_render(file, features=()).data_window)
    assert (counts["ones/hr.1001"] == 1).all()
    assert 1 < np.median(counts["counted/hr.1001"]) <= 5 < np.median(counts["counted/hr.1003"]) <= 9


@pytest.mark.parametrize(("temporal", "text"), [("auto", "with 4"), (1, "with one frame before"), ("2", "with 2")])
def test_a_number_of_neighbours_is_enough(shot, bilinear_models, tmp_path, temporal, text):
    options = {"model": str(bilinear_models[4]), "frames": [FIRST]}
    report = fuse_shot(shot / "lr", shot / "hr", tmp_path / "out", temporal=temporal, **options)
    assert report.exit_code == 0 and report.temporal.startswith(text)


def damage_pixels(path, part, height=shots.HEIGHT):
    """Overwrite the compressed pixels of one part of a multipart EXR. Its headers stay whole."""
    stored = bytearray(path.read_bytes())
    for y in range(0, height, 16):  # rows of a block of ZIP
        # A chunk of a multipart file: part, first row, size, pixels. The last match is no entry of a table in front.
        start = stored.rfind(struct.pack("<ii", part, y))
        (size,) = struct.unpack_from("<i", stored, start + 8)
        stored[start + 12 : start + 12 + size] = b"\xff" * size
    path.write_bytes(stored)


def test_a_frame_with_damaged_vectors_fails_however_much_memory_there_is(tmp_path, bilinear_models):
    """Also where nothing else would read them: they are not copied, and wait in their file if memory is short."""
    shot = make_moving_shot(tmp_path / "shot", count=4)
    for path in (shot / "hr").iterdir():
        channels = read_bits(path)[0][1]
        motion = {name: channels.pop(name) for name in list(channels) if name.startswith("motionFore")}
        write_exr(path, [("rgba", channels, (0, 0)), ("motionFore", motion, (0, 0))])
    damage_pixels(shot / f"hr/hr.{FIRST + 2}.exr", 1, HEIGHT)
    for max_memory in (MAX_MEMORY, 1 << 29):
        more = {"temporal": TemporalOptions("2"), "write": WriteOptions(layers=("none",)), "max_memory": max_memory}
        report = fuse_shot(shot / "lr", shot / "hr", tmp_path / str(max_memory), model=str(bilinear_models[4]), **more)
        assert [report.results[FIRST + n].status for n in range(4)] == ["fused", "fused", "failed", "fused"]


def test_a_neighbour_with_one_damaged_pass_is_left_out_wherever_pixels_wait(tmp_path, bilinear_models):
    """The beauty of the damaged frame can be decoded. Only the pixels of one of its passes can't."""
    for name in ("lr", "hr"):
        (tmp_path / name).mkdir()
    for n in range(1, 6):
        write_exr(tmp_path / f"lr/lr.{n:04d}.exr", low_layers(n))
        clean = picture(shots.HEIGHT, shots.WIDTH)
        light = np.round(noisy(clean, 1, n) * 32) / 32
        first = np.round(light * 12) / 32
        layers = {"": light, "light_1.": first, "light_2.": light - first, "albedo.": (clean > 0.3) + light / 8}
        parts = {name or "rgb": rgb(values.astype(np.float32), name) for name, values in layers.items()}
        write_exr(tmp_path / f"hr/hr.{n:04d}.exr", [(name, each, (0, 0)) for name, each in parts.items()])
    damage_pixels(tmp_path / "hr/hr.0003.exr", 1)
    fused = {}
    for name, max_memory in (("pixels wait in memory", MAX_MEMORY), ("pixels wait in files", 1 << 29)):
        out = tmp_path / name
        report = fuse_shot(tmp_path / "lr", tmp_path / "hr", out, model=str(bilinear_models[4]), max_memory=max_memory)
        assert [report.results[n].status for n in range(1, 6)] == ["fused", "fused", "failed", "fused", "fused"]
        assert any("frame 3 is not averaged" in text for text in report.results[2].warnings), report.temporal
        fused[name] = contents(out)
    assert fused["pixels wait in memory"] == fused["pixels wait in files"]
