# SPDX-License-Identifier: Apache-2.0
"""msspl compare, as a process."""

import json
import re

import numpy as np
import pytest

from tests.conftest import picture, rgb, write_exr
from tests.programs import fuse, run


def test_compare_prints_the_papers_measures(files, bilinear_models):
    fuse(files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", "--model", bilinear_models[4])
    names = ["out.exr", "hr.exr", "lr.exr"]
    done = run("msspl", "compare", *(files / n for n in names), "-r", files / "ref.exr", "--json")
    assert done.returncode == 0, done.stderr
    scores = json.loads(done.stdout)
    assert scores[0]["psnr"] > scores[1]["psnr"]
    assert set(scores[0]) == {"image", "psnr", "relmse", "relmse_gharbi", "ssim"}


def test_compare_does_not_overwrite_its_reference(files):
    before = (files / "ref.exr").read_bytes()
    arguments = [files / "hr.exr", "-r", files / "ref.exr", "--html", files / "ref.exr", "--overwrite"]
    done = run("msspl", "compare", *arguments)
    assert done.returncode == 2
    assert "the page is HTML" in done.stderr
    assert (files / "ref.exr").read_bytes() == before


def test_compare_scores_the_layer_that_map_names(tmp_path):
    """Two files of one beauty, whose lamps differ."""
    image = picture(48, 64)
    for name, lamp in (("image", image), ("ref", 0.5 * image)):
        write_exr(tmp_path / f"{name}.exr", rgb(image) | rgb(lamp, "lamp."))
    arguments = ["msspl", "compare", tmp_path / "image.exr", "-r", tmp_path / "ref.exr", "--json"]
    assert json.loads(run(*arguments).stdout)[0]["psnr"] is None
    assert json.loads(run(*arguments, "--map", "rgb=lamp").stdout)[0]["psnr"] < 30
    done = run(*arguments, "--map", "rgb=gone")
    assert done.returncode == 2 and "image.exr" in done.stderr and "gone" in done.stderr


def test_compare_says_what_is_wrong_with_the_layer_that_map_names(tmp_path):
    for name in ("image", "ref"):
        write_exr(tmp_path / f"{name}.exr", rgb(picture(16, 16)) | {"key.Y": picture(16, 16)[..., 0]})
    arguments = ["msspl", "compare", tmp_path / "image.exr", "-r", tmp_path / "ref.exr"]
    done = run(*arguments, "--map", "rgb=key")
    assert done.returncode == 2 and "rgb: layer 'key' has channels Y, not R, G, B" in done.stderr
    done = run(*arguments, "--map", "rgb=gone")
    assert done.returncode == 2 and "gone, which is not there; a mapping of rgb applies to every file" in done.stderr


def test_compare_refuses_other_sizes(files):
    write_exr(files / "small.exr", rgb(picture(50, 50)))
    done = run("msspl", "compare", files / "small.exr", "-r", files / "ref.exr")
    assert done.returncode == 2
    assert "is 50x50, but" in done.stderr


def test_compare_says_that_only_a_part_is_compared(tmp_path):
    display = (np.array([0, 0], np.int32), np.array([63, 47], np.int32))
    for name, top in (("image", 0), ("ref", 4)):
        part = ("rgba", rgb(picture(48, 64)[top : top + 44]), (0, top))
        write_exr(tmp_path / f"{name}.exr", [part], display=display)
    done = run("msspl", "compare", tmp_path / "image.exr", "-r", tmp_path / "ref.exr", "--json")
    assert json.loads(done.stdout)[0]["relmse"] == 0
    assert done.stderr == "The data windows differ; only the part that all pictures show is compared: 64x40+0+4\n"


def test_compare_writes_a_page(files):
    """With a reference beside the scores, without one alone."""
    arguments = [files / "hr.exr", files / "lr.exr", "--html", files / "page.html"]
    done = run("msspl", "compare", *arguments, "-r", files / "ref.exr")
    assert done.returncode == 0, done.stderr
    assert "PSNR" in done.stdout and re.search(r"Wrote .*page.html: \d\.\d MB, layers: beauty", done.stdout)
    again = run("msspl", "compare", *arguments)
    assert again.returncode == 2 and "pass --overwrite" in again.stderr
    alone = run("msspl", "compare", *arguments, "--overwrite", "--layers", "albedo", "--json")
    assert alone.returncode == 0, alone.stderr
    assert json.loads(alone.stdout) == [{"image": str(files / "hr.exr")}, {"image": str(files / "lr.exr")}]
    assert "layers: beauty, albedo" in alone.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "scores need --reference"),
        (["-r", "ref.exr", "--layers", "albedo"], "add --html PAGE"),
        (["-r", "ref.exr", "--map", "albedo=N"], "only rgb is compared; write --map rgb=LAYER"),
        (["--html", "page.png"], "the page is HTML; name it .html"),
        (["--html", "page.html", "--layers", "nothing"], "no image has such a layer; they have: beauty, Z, "),
        (["--html", "gone/page.html"], "the folder gone does not exist"),
    ],
)
def test_compare_refuses_options_that_do_not_fit(files, arguments, message):
    before = set(files.iterdir())
    done = run("msspl", "compare", "hr.exr", *arguments, cwd=files)
    assert done.returncode == 2 and message in done.stderr
    assert set(files.iterdir()) == before
