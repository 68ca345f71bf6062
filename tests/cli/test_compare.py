# SPDX-License-Identifier: Apache-2.0
"""msspl compare, as a process."""

import json

import OpenImageIO as oiio
import pytest

from tests.conftest import picture, rgb, write_exr
from tests.programs import fuse, run


def test_compare_prints_the_papers_measures(files, bilinear_models):
    fuse(files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", "--model", bilinear_models[4])
    names = ["out.exr", "hr.exr", "lr.exr"]
    done = run(
        "msspl",
        "compare",
        *(files / n for n in names),
        "-r",
        files / "ref.exr",
        "--json",
        "--error-map",
        files / "e.png",
    )
    assert done.returncode == 0, done.stderr
    scores = json.loads(done.stdout)
    assert scores[0]["psnr"] > scores[1]["psnr"]
    assert set(scores[0]) == {"image", "psnr", "relmse", "relmse_gharbi", "ssim"}
    assert oiio.ImageBuf(str(files / "e.png")).spec().width == 128


def test_compare_does_not_overwrite_its_reference(files):
    before = (files / "ref.exr").read_bytes()
    arguments = [files / "hr.exr", "-r", files / "ref.exr", "--error-map", files / "ref.exr", "--overwrite"]
    done = run("msspl", "compare", *arguments)
    assert done.returncode == 2
    assert "the error map is a PNG" in done.stderr
    assert (files / "ref.exr").read_bytes() == before


def test_compare_of_equal_pictures_is_valid_json(files):
    done = run("msspl", "compare", files / "ref.exr", "-r", files / "ref.exr", "--json")
    assert json.loads(done.stdout, parse_constant=pytest.fail)[0]["psnr"] is None


def test_compare_refuses_other_sizes(files):
    write_exr(files / "small.exr", rgb(picture(50, 50)))
    done = run("msspl", "compare", files / "small.exr", "-r", files / "ref.exr")
    assert done.returncode == 2
    assert "is 50x50, but" in done.stderr
