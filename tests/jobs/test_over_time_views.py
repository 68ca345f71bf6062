# SPDX-License-Identifier: Apache-2.0
"""Each view and view layer of a shot is averaged with its own neighbours."""

import threading
import time
import weakref
from dataclasses import replace

import numpy as np
import pytest

from oiio_msspl import InputOptions, WriteOptions, fuse_shot
from oiio_msspl.image.arrays import file_of
from oiio_msspl.jobs import frame as reading
from oiio_msspl.jobs import pipeline
from oiio_msspl.jobs.frame import read_frame
from oiio_msspl.jobs.memory import budget_view
from oiio_msspl.jobs.plan import ShotPlan, TemporalOptions, ViewPlan
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.jobs.timeline import Reach
from tests.conftest import downsample, noisy, read_bits, rgb, same_bits, write_exr
from tests.moving_plane import positions, texture, truck, vectors

FIRST, COUNT = 1001, 7


def backwards(t):
    """A camera that moves to the left."""
    return truck(t) * (-1, 1, 1)


CAMERAS = {"fg": truck, "bg": backwards}


def channels_of(view, t, scale, spp, *, motion=True):
    """A view layer's channels: beauty, albedo, two light groups and, in the HRLS, motion vectors."""
    camera, seed = CAMERAS[view], 10 * t + len(view) + (50 if view == "bg" else 0)
    places = positions(camera, t)
    clean = texture(places[..., 0], places[..., 1])
    share = np.linspace(0.2, 0.8, clean.shape[1], dtype=np.float32)[:, None]
    lamps = {"Combined_key": clean * share, "Combined_fill": clean * (1 - share)}
    lamps = {
        name: noisy(downsample(light, scale), spp, 1000 * scale + 2 * seed + i).astype(np.float32)
        for i, (name, light) in enumerate(lamps.items())
    }
    channels = rgb(sum(lamps.values()), f"{view}.Combined.")
    for name, light in lamps.items():
        channels |= rgb(light, f"{view}.{name}.")
    if scale > 1:
        return channels
    channels |= rgb(clean, f"{view}.Denoising Albedo.")
    if motion:
        back, ahead = vectors(camera, t, -1), vectors(camera, t, 1)
        # Cycles: where the surface was, and where it will be; y points up, and the second pair is reversed.
        parts = (back[..., 0], -back[..., 1], -ahead[..., 0], ahead[..., 1])
        channels |= {f"{view}.Vector.{c}": values for c, values in zip("XYZW", parts, strict=True)}
    return channels


def make_shot(folder, views=("fg", "bg"), still=(), lacking=()):
    """Pairs at x4 with view layers, whose cameras move in opposite directions.

    Args:
        views: the view layers.
        still: those without motion vectors.
        lacking: frames without the last view layer.
    """
    for name in ("lr", "hr"):
        (folder / name).mkdir(parents=True)
    header = {"cycles.fg.samples": "1", "cycles.bg.samples": "1"}
    for t in range(COUNT):
        there = views[:-1] if t in lacking else views
        low = [(view, channels_of(view, t, 4, 16), (0, 0)) for view in there]
        high = [(view, channels_of(view, t, 1, 1, motion=view not in still), (0, 0)) for view in there]
        write_exr(folder / f"lr/lr.{FIRST + t}.exr", low, **header)
        write_exr(folder / f"hr/hr.{FIRST + t}.exr", high, **header)
    return folder


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return make_shot(tmp_path_factory.mktemp("views"))


@pytest.fixture(scope="module")
def whole(shot, bilinear_models):
    return run(shot, bilinear_models[4], "whole")


def run(shot, model, name, frames=None, temporal="auto", view=None, **more):
    out = shot / name
    out.mkdir(exist_ok=True)
    inputs, options = InputOptions(view=view), TemporalOptions(temporal)
    report = fuse_shot(
        shot / "lr", shot / "hr", out, frames=frames, model=str(model), temporal=options, inputs=inputs, **more
    )
    assert report.exit_code == 0, report.results
    return report


def pixels_of(shot, name, t, view=""):
    """{channel: pixels} of a view layer of a fused frame."""
    parts = read_bits(shot / name / f"hr.{FIRST + t}.exr")
    return {channel: pixels for _, part in parts for channel, pixels in part.items() if channel.startswith(view)}


def light(shot, name, layer):
    """A layer of the fourth frame, (h, w, 3)."""
    channels = pixels_of(shot, name, 3)
    return np.stack([channels[f"{layer}.{c}"] for c in "RGB"], axis=-1)


def cut_part(path, view):
    """Damage the pixels of a view layer: overwrite the last bytes of its part, which is stored in file order."""
    data = bytearray(path.read_bytes())
    half = len(data) // 2
    where = half - 2000 if view == "fg" else len(data) - 2000
    data[where : where + 1500] = bytes(1500)
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("view", CAMERAS)
def test_each_view_is_what_it_is_when_its_shot_is_fused_alone(shot, whole, bilinear_models, view):
    assert whole.temporal.startswith("with 4 frames before and after each: motion vectors of ")
    run(shot, bilinear_models[4], f"{view} alone", view=view)
    for t in range(COUNT):
        alone, both = (pixels_of(shot, name, t, f"{view}.") for name in (f"{view} alone", "whole"))
        assert alone.keys() == both.keys() and all(same_bits(both[name], alone[name]) for name in alone)


def test_views_gain_as_much_as_the_first_one(shot, whole, bilinear_models):
    run(shot, bilinear_models[4], "off", temporal="off")
    for view, camera in CAMERAS.items():
        places = positions(camera, 3)
        clean = texture(places[..., 0], places[..., 1])
        share = np.linspace(0.2, 0.8, clean.shape[1], dtype=np.float32)[:, None]
        for layer, truth in (("Combined", clean), ("Combined_key", clean * share)):
            before, after = (np.mean((light(shot, name, f"{view}.{layer}") - truth) ** 2) for name in ("off", "whole"))
            assert after < before / 1.3


def test_chunks_of_several_views_are_one_run_bit_for_bit(shot, whole, bilinear_models):
    for frames in ("1001-1003", "1004-1007"):
        run(shot, bilinear_models[4], "chunks", frames)
    for t in range(COUNT):
        once, chunks = (pixels_of(shot, name, t) for name in ("whole", "chunks"))
        assert all(same_bits(once[name], chunks[name]) for name in once)


def test_large_renders_of_several_views_wait_in_files(shot, whole, bilinear_models, monkeypatch):
    monkeypatch.setattr("oiio_msspl.image.arrays.MOST_PIXELS", 1)
    run(shot, bilinear_models[4], "on disk")
    once, again = (pixels_of(shot, name, 3) for name in ("whole", "on disk"))
    assert all(same_bits(once[name], again[name]) for name in once)


def test_frames_of_other_views_are_counted_as_memory(shot, whole):
    """Also by a frame that lacks the view."""
    frame = whole.shot.frames[0]
    plan = ShotPlan(views=dict.fromkeys([None, "bg", "gone"], ViewPlan(Reach(2, 2))))
    views = {read.view: read for read in read_frame(frame, Settings(), plan) if read.error is None}
    held = {view: read.memory.held for view, read in views.items()}
    assert held.keys() == {None, "bg"}
    pixels = views["bg"].renders.hr.layers["rgb"]
    assert file_of(pixels) is not None  # renders wait in files, and results and vectors in memory
    alone = read_frame(frame, Settings(), ShotPlan(views={None: ViewPlan(Reach(2, 2))}))[0].memory
    of_two_views = 2 * (4 * 16 + 16 * 9) * pixels[..., 0].size
    assert min(held.values()) - alone.held + alone.waiting >= of_two_views, (held, alone, of_two_views)


def test_a_view_without_motion_stays_alone(tmp_path, bilinear_models):
    shot = make_shot(tmp_path, still=("bg",))
    report = run(shot, bilinear_models[4], "whole")
    assert report.temporal.startswith("with 4 frames before and after each: motion vectors of ")
    assert "; bg frame by frame: no motion vectors" in report.temporal
    run(shot, bilinear_models[4], "off", temporal="off")
    off, whole = (pixels_of(shot, name, 3) for name in ("off", "whole"))
    assert all(same_bits(off[name], whole[name]) for name in off if name.startswith("bg."))
    assert not same_bits(off["fg.Combined.R"], whole["fg.Combined.R"])


def test_a_frame_may_lack_a_view(tmp_path, bilinear_models):
    shot = make_shot(tmp_path, lacking=(3,))
    report = run(shot, bilinear_models[4], "whole", write=WriteOptions(passes=("none",)))
    assert not any(name.startswith("bg.") for name in pixels_of(shot, "whole", 3))
    warnings = report.results[FIRST + 2].warnings
    assert "bg: frame 1004 is not averaged: it has no pair for bg" in warnings
    run(shot, bilinear_models[4], "fg alone", view="fg", write=WriteOptions(passes=("none",)))
    for t in (2, 3):
        whole, alone = (pixels_of(shot, name, t, "fg.") for name in ("whole", "fg alone"))
        assert all(same_bits(whole[name], alone[name]) for name in alone)


def test_both_eyes_are_averaged(tmp_path, bilinear_models):
    """Layers of the second eye have its name before the channel's, as OpenEXR stores them."""
    for name, scale, spp in (("lr", 4, 16), ("hr", 1, 1)):
        (tmp_path / name).mkdir()
        for t in range(COUNT):
            channels = {}
            for view, eye in (("fg", ""), ("bg", "right.")):
                for stored, values in channels_of(view, t, scale, spp, motion=False).items():
                    layer, _, letter = stored.removeprefix(f"{view}.").rpartition(".")
                    if layer != "Denoising Albedo":
                        channels[{"Combined": ""}.get(layer, f"{layer}.") + eye + letter] = values
                if scale == 1:
                    ahead = vectors(CAMERAS[view], t, 1)
                    channels |= {f"motionFore.{eye}{c}": ahead[..., i] for i, c in enumerate("XY")}
                    places = positions(CAMERAS[view], t)
                    channels |= rgb(texture(places[..., 0], places[..., 1]), f"albedo.{eye}")
            write_exr(tmp_path / name / f"{name}.{FIRST + t}.exr", channels, multiView=["left", "right"])
    run(tmp_path, bilinear_models[4], "whole")
    run(tmp_path, bilinear_models[4], "off", temporal="off")
    places = positions(backwards, 3)
    clean = texture(places[..., 0], places[..., 1])
    before, after = (
        np.mean((np.stack([pixels_of(tmp_path, name, 3)[f"right.{c}"] for c in "RGB"], -1) - clean) ** 2)
        for name in ("off", "whole")
    )
    assert after < before / 1.5


@pytest.mark.parametrize("view", CAMERAS)
def test_a_damaged_view_is_absent_wherever_renders_wait(tmp_path, bilinear_models, monkeypatch, view):
    """Frames beside it lose that view of it as a neighbour, and no other one."""
    shot = make_shot(tmp_path)
    path = shot / f"hr/hr.{FIRST + 3}.exr"
    cut_part(path, view)
    results = []
    for name, on_disk in (("in memory", False), ("in files", True)):

        def budget(*view, on_disk=on_disk, **more):
            return replace(budget_view(*view, **more), on_disk=on_disk)

        monkeypatch.setattr(reading, "budget_view", budget)
        out = shot / name
        out.mkdir()
        options = TemporalOptions("auto")
        report = fuse_shot(shot / "lr", shot / "hr", out, model=str(bilinear_models[4]), temporal=options)
        assert [n for n, result in report.results.items() if result.status == "failed"] == [FIRST + 3]
        results.append(pixels_of(shot, name, 2))
        other = "bg" if view == "fg" else "fg"
        warnings = [text for text in report.results[FIRST + 2].warnings if "1004" in text]
        assert len(warnings) == 1 and warnings[0].startswith(f"{view}: ") and other not in warnings[0]
    assert all(same_bits(results[0][name], results[1][name]) for name in results[0])


def test_no_more_frames_are_held_than_are_counted(shot, bilinear_models, monkeypatch):
    """Neither by the frames that wait nor by the one that is written meanwhile."""
    held, most, counting = [], [], threading.Event()
    real_read, real_write = reading._read_pixels, pipeline.write_settled

    def load(frame):
        real_read(frame)
        if frame.view is None:
            held.append(weakref.ref(frame.renders.hr.layers["rgb"]))
            limit = 2 * frame.plan.reach.renders + 2
            counting.set()
            for _ in range(500):  # a thread that has done its work may hold its arguments a moment longer
                alive = sum(pixels() is not None for pixels in held)
                if alive <= limit:
                    break
                time.sleep(0.01)
            counting.clear()
            most.append((alive, limit))

    def write(*args):
        counting.wait(0.3)
        while counting.is_set():
            time.sleep(0.01)
        real_write(*args)

    monkeypatch.setattr(reading, "_read_pixels", load)
    monkeypatch.setattr(pipeline, "write_settled", write)
    for count in ("auto", "1", "off"):
        run(shot, bilinear_models[4], f"held {count}", temporal=count)
    assert len(most) >= 3 * 7
    assert all(alive <= limit for alive, limit in most)


def test_a_view_whose_beauty_is_not_written_is_not_planned(tmp_path, bilinear_models):
    shot = make_shot(tmp_path, still=("bg",))
    report = run(shot, bilinear_models[4], "whole", "1001", write=WriteOptions(layers=("fg.*",)))
    assert "bg" not in report.temporal
