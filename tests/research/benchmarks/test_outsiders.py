# SPDX-License-Identifier: Apache-2.0
"""The benchmark that everybody can run: motion, scores, and what a run that continues leaves alone."""

import sys

import numpy as np
import pytest

from research.benchmarks import outsiders
from research.benchmarks.outsiders import MOTION, Extent, Renderer
from research.benchmarks.render.film import write_exr
from tests.conftest import noisy, picture

RGB = ("R", "G", "B")


def test_vectors_lead_to_the_same_surface_in_the_next_frame():
    """A point is seen where the camera projects it: straight ahead in the middle, and right and up as it lies."""
    renderer = Renderer(None, (192, 128))
    points = np.array([[[0, 0, 0], [0.5, 0, 0], [0, 0.5, -1]]], np.float32)
    middle, right, up = renderer._project(points, 0.0)[0]
    assert middle == pytest.approx([0, 0]) and right[0] > 0 > up[1] and right[1] == up[0] == 0
    seen, later = (renderer._project(points, at) for at in (2.0, 3.0))
    assert renderer._motion(points, 2.0) == pytest.approx(later - seen, abs=1e-4)
    assert np.abs(later - seen).max() > 1


def test_a_shot_has_the_flicker_of_its_frames(tmp_path):
    truth = picture(32, 48)
    for number in (1, 2, 3):
        write_exr(tmp_path / f"ref.{number:04}.exr", truth, RGB, np.float32)
        for name, image in (("steady", truth), ("noisy", noisy(truth, 8, number))):
            (tmp_path / name).mkdir(exist_ok=True)
            write_exr(tmp_path / name / f"out.{number:04}.exr", image, RGB, np.float32)
    steady, rough = (outsiders._scores(tmp_path, tmp_path / name) for name in ("steady", "noisy"))
    assert steady["flicker"] == 0 and steady["relmse"] == 0 and steady["flip"] == pytest.approx(0, abs=1e-4)
    assert rough["flicker"] > 0.01 and rough["psnr"] < 40


def test_what_is_measured_is_not_measured_again(tmp_path, monkeypatch):
    monkeypatch.setattr(outsiders, "_run", lambda command: pytest.fail(f"ran {command}"))
    monkeypatch.setattr(outsiders, "oidn_version", lambda python: "2.5.1")
    key = ("room", "box", 2)
    done = {(*key, method) for method in (*outsiders.QUALITIES, *(f"OIDN 2.5.1 {name}" for name in outsiders.OIDN))}
    assert list(outsiders.measure(tmp_path, done, key, sys.executable)) == []


def test_another_oidn_has_rows_of_its_own_and_one_render_is_fused_alone(tmp_path, monkeypatch):
    commands = []

    def run(command):
        commands.append(command)
        return "3.0.0\n"

    monkeypatch.setattr(outsiders, "_run", run)
    monkeypatch.setattr(outsiders, "_scores", lambda folder, target: {"psnr": 30.0})
    (tmp_path / "1spp").mkdir()
    (tmp_path / "1spp/full.exr").touch()
    key = ("room", "box", 1)
    done = {(*key, method) for method in ("fast", "balanced", "OIDN 2.5.1 at full resolution")}
    rows = list(outsiders.measure(tmp_path, done, key, "other/python"))
    assert [row["method"] for row in rows] == ["best", "OIDN 3.0.0 at full resolution"]
    (_, fuse, denoise) = commands
    assert [word for word in fuse if word.endswith("spp/full.exr")] == [fuse[1]] and fuse[2] == "-o"
    assert denoise[0] == "other/python" and denoise[2:] == [
        str(tmp_path / "1spp/full.exr"),
        str(tmp_path / "1spp/OIDN_3.0.0_at_full_resolution/out.exr"),
    ]


def test_each_scene_has_one_page_of_pictures(tmp_path, monkeypatch):
    compared = []
    monkeypatch.setattr(outsiders, "_run", lambda command: compared.append(command) or "")
    rows = [
        {"scene": scene, "filter": "box", "spp": spp, "method": method, "psnr": 30.126, "relmse": 0.5, "flip": 0.1}
        for scene, spp in (("room", 1), ("room", 2), ("shot", 2))
        for method in ("best", "OIDN <3>")
    ]
    for row in rows:
        frame = ".0001" if row["scene"] == "shot" else ""
        folder = tmp_path / row["scene"] / "box" / f"{row['spp']}spp"
        (folder / "best").mkdir(parents=True, exist_ok=True)
        write_exr(folder / f"best/out{frame}.exr", np.zeros((4, 4, 3)), RGB)
        write_exr(folder / f"full{frame}.exr", np.zeros((4, 4, 3)), RGB)
    outsiders.write_pages(tmp_path, rows)
    assert [command[-1] for command in compared] == [
        str(tmp_path / name) for name in ("room/box/1spp.html", "room/box/2spp.html", "shot/box/2spp.html")
    ]


def test_files_that_exist_are_not_rendered_again(tmp_path):
    class Counting:
        def __init__(self):
            self.jobs = []

        def frame(self, *job):
            self.jobs.append(job)
            return dict.fromkeys(RGB, np.zeros((8, 8), np.float32))

    first, second = Counting(), Counting()
    extent = Extent((8, 8), ("room",), ("box",), (1, 2, 8), 1, 64)
    for renderer in (first, second):
        outsiders.render(renderer, extent, tmp_path, "room", "box")
    assert [(scale, spp) for _, _, scale, spp, *_ in first.jobs] == [
        *((1, 64), (1, 1)),
        *((1, 2), (2, 4), (1, 1)),
        *((1, 8), (2, 16), (1, 4)),
    ]
    assert len({seed for *_, seed, _ in first.jobs}) == 8 and not second.jobs


def test_mitsuba_renders_light_groups_that_sum_to_the_beauty_and_vectors():
    mitsuba = pytest.importorskip("mitsuba")
    from research.datagen.mitsuba import start

    renderer = Renderer(start(1), (48, 32))
    assert mitsuba.variant()
    layers = renderer.frame("lamps", "box", 1, 4, "seed")
    for channel in "RGB":
        groups = sum(layers[f"lg_{group}.{channel}"] for group in outsiders.GROUPS)
        np.testing.assert_array_equal(layers[channel], groups)
    assert set(MOTION) <= set(renderer.frame("shot", "gaussian", 1, 1, "seed", 1.0))
    assert not set(MOTION) & set(renderer.frame("shot", "box", 2, 1, "seed", 1.0))
