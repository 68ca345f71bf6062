# SPDX-License-Identifier: Apache-2.0
"""What is timed is what a user runs, and Open Image Denoise gets the same full-resolution render."""

import sys
from argparse import Namespace

import numpy as np
import OpenEXR
import pytest

pytest.importorskip("torch")

from oiio_msspl import map_render, open_exr
from research.benchmarks import oidn, runtime, timer

RUN = timer.Run((2.0,), 3.0, 100.0)


def test_whole_commands_read_the_same_pair(monkeypatch):
    """Every quality is a command of its own; OIDN reads the HRLS that they read."""
    given = {}

    def in_turn(jobs, rounds):
        given.update(jobs)
        return {name: [RUN] * rounds for name in jobs}

    monkeypatch.setattr(timer, "in_turn", in_turn)
    args = Namespace(size=(64, 32), scale=2, quality=["fast", "best", "paper"], rounds=3)
    rows = runtime.time_command(args)
    assert list(given) == ["joint-small-x2", "joint-large-x2", "paper-x2", runtime.OIDN_PREFILTERED]
    for name in list(given)[:3]:
        low, high = given[name][1:3]
        assert given[name][-2:] == ["--model", name] and low.endswith("lr.exr")
    assert given[runtime.OIDN_PREFILTERED][:4] == [sys.executable, "-m", "research.benchmarks.oidn", high]
    assert [row.get("model") for row in rows] == ["joint-small-x2", "joint-large-x2", "paper-x2", None]
    assert {(row["seconds"], row["cpu_seconds"], row["rounds"]) for row in rows} == {(2.0, 3.0, 3)}
    runtime.time_command(Namespace(size=(64, 32), scale=1, quality=["joint-clean"], rounds=1))
    assert given["joint-clean-x1"][1].endswith("hr.exr") and given["joint-clean-x1"][2] == "-o"


def test_oidn_denoises_a_file_as_it_is_recommended(tmp_path):
    pytest.importorskip("pyoidn")
    low, high = runtime.write_pair(tmp_path, 64, 48, 2)
    assert (map_render(open_exr(low)).data_window.width, map_render(open_exr(high)).data_window.width) == (32, 64)
    oidn.denoise_file(str(high), str(tmp_path / "out.exr"))
    layers = map_render(open_exr(high)).load().layers
    expected = oidn.denoise_prefiltered(*(layers[name] for name in ("rgb", "albedo", "normal")))
    with OpenEXR.File(str(tmp_path / "out.exr")) as file:
        written = file.channels()["RGB"].pixels
    np.testing.assert_allclose(written, np.maximum(expected, 0), rtol=2e-3, atol=1e-4)
