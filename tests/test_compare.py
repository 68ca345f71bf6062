# SPDX-License-Identifier: Apache-2.0
"""Scores, and the error of each pixel."""

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from oiio_msspl.compare import (
    error_colours,
    error_levels,
    notes,
    open_comparison,
    score_images,
    scores,
    upsample_bicubic,
)
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import ExrFile
from oiio_msspl.image.colour import ACESCG, REC709, conversion
from oiio_msspl.image.metrics import RELMSE_GHARBI, relmse
from tests.conftest import downsample, picture, rgb, write_exr


def test_scores_follow_the_conventions_that_they_are_named_after():
    image, truth = picture(32, 32), 1.5 * picture(32, 32)
    measures = scores(image, truth)
    assert measures["relmse"] == relmse(image, truth, (0.5, 0.01))
    assert measures["relmse_gharbi"] == relmse(image, truth, RELMSE_GHARBI) != measures["relmse"]


def test_files_that_different_weights_or_versions_fused_are_named(tmp_path):
    def file(name, version, weights):
        made_by = {"msspl/version": version, "msspl/weights": weights}
        return write_exr(tmp_path / name, rgb(picture(16, 16)), **made_by)

    a, b = file("a.exr", "1.0.0", "joint-x2 01"), file("b.exr", "1.0.0", "joint-x2 01")
    c, d = file("c.exr", "1.0.0", "joint-x2 02"), file("d.exr", "1.0.1", "joint-x2 01")
    render = write_exr(tmp_path / "render.exr", rgb(picture(16, 16)))
    assert notes(open_comparison([a, b], render)) == []
    for other, maker in ((c, "1.0.0, joint-x2 02"), (d, "1.0.1, joint-x2 01")):
        (note,) = notes(open_comparison([a, other], render))
        assert note == f"Different versions or weights made these: {a} (1.0.0, joint-x2 01); {other} ({maker})"


def part_of(path, truth, x0, y0, width, height):
    """A file of the frame ``truth`` that holds only a part of its pixels."""
    display = tuple(np.array(corner, np.int32) for corner in ((0, 0), (truth.shape[1] - 1, truth.shape[0] - 1)))
    pixels = truth[y0 : y0 + height, x0 : x0 + width]
    return write_exr(path, [("rgba", rgb(pixels), (x0, y0))], display=display)


def test_pictures_are_compared_where_they_lie(tmp_path):
    truth = picture(48, 64)
    reference = part_of(tmp_path / "ref.exr", truth, 0, 4, 64, 44)
    image = part_of(tmp_path / "image.exr", truth, 6, 0, 58, 48)
    moved = part_of(tmp_path / "moved.exr", truth, 0, 0, 64, 44)  # of the reference's size
    low = write_exr(tmp_path / "low.exr", rgb(downsample(truth[4:], 4)))
    comparison = open_comparison([image, moved, low], reference)
    measures = score_images(comparison)
    assert [m["relmse"] for m in measures[:2]] == [0, 0]
    shown = upsample_bicubic(downsample(truth[4:], 4)[:10, 2:], 56, 40)
    assert measures[2]["relmse"] == pytest.approx(relmse(shown, truth[4:44, 8:]), rel=1e-4)
    assert notes(comparison)[0].endswith(" is compared: 56x40+8+4")
    assert notes(open_comparison([low], reference)) == []


@pytest.mark.parametrize("crop", [(16, 12, 32, 24), (14, 9, 33, 25)])
def test_a_smaller_picture_of_the_whole_frame_lies_under_a_crop(tmp_path, crop):
    """The smaller one is cut between its pixels, and not stretched over the crop."""
    truth = picture(48, 64)
    reference = part_of(tmp_path / "ref.exr", truth, *crop)
    low = downsample(truth, 4)
    whole = write_exr(tmp_path / "low.exr", rgb(low))
    part = part_of(tmp_path / "part.exr", low, 3, 2, 13, 10)
    comparison = open_comparison([whole, part], reference)
    x0, y0 = (-(-side // 4) for side in crop[:2])
    x1, y1 = ((crop[i] + crop[i + 2]) // 4 for i in (0, 1))
    shown = upsample_bicubic(low[y0:y1, x0:x1], 4 * (x1 - x0), 4 * (y1 - y0))
    expected = relmse(shown, truth[4 * y0 : 4 * y1, 4 * x0 : 4 * x1])
    assert [m["relmse"] for m in score_images(comparison)] == pytest.approx([expected, expected], rel=1e-4)
    assert notes(comparison)[0].endswith(f": {4 * (x1 - x0)}x{4 * (y1 - y0)}+{4 * x0}+{4 * y0}")


def test_pictures_are_compared_in_the_space_of_the_reference(tmp_path):
    truth = picture(48, 64)
    reference = write_exr(tmp_path / "ref.exr", rgb(truth), chromaticities=REC709.chromaticities)
    in_aces = (truth @ conversion(REC709, ACESCG).T).astype(np.float32)
    image = write_exr(tmp_path / "aces.exr", rgb(in_aces), chromaticities=ACESCG.chromaticities)
    plain = write_exr(tmp_path / "plain.exr", rgb(in_aces))
    comparison = open_comparison([image, plain], reference)
    in_space, unconverted = (measures["psnr"] for measures in score_images(comparison))
    assert in_space > 80 and unconverted < 40
    assert notes(comparison) == [f"Converted to lin_rec709, the colour space of {reference}: {image} (acescg)"]
    assert notes(open_comparison([plain], reference)) == []


def test_pixels_that_are_no_numbers_are_counted(tmp_path):
    truth = picture(32, 32)
    broken = truth.copy()
    broken[3, 4], broken[5, 6, 0] = np.nan, np.inf
    reference = write_exr(tmp_path / "ref.exr", rgb(truth))
    image = write_exr(tmp_path / "image.exr", rgb(broken))
    comparison = open_comparison([image], reference)
    score_images(comparison)
    assert comparison.broken == {str(image): 4}


def test_negative_values_are_scored(tmp_path):
    """A normal may point away, and a beauty may lie outside the gamut."""
    truth = picture(32, 32) - np.float32(0.5)
    reference = write_exr(tmp_path / "ref.exr", rgb(truth))
    image = write_exr(tmp_path / "image.exr", rgb(np.where(truth < 0, 2 * truth, truth)))
    (scores,) = score_images(open_comparison([image], reference))
    expected = 0.5 * np.square(np.minimum(truth, 0)) / (np.square(truth) + 0.01)
    assert scores["relmse"] == pytest.approx(expected.mean(), rel=1e-3)


def test_pictures_of_two_parts_of_the_frame_are_refused(tmp_path):
    truth = picture(48, 64)
    left, right = (part_of(tmp_path / f"{x}.exr", truth, x, 0, 32, 48) for x in (0, 32))
    with pytest.raises(InputError, match=r"no part of the frame in common: .*0\.exr \(32x48\+0\+0\), .*32\.exr \("):
        open_comparison([left], right)


def test_scores_read_the_reference_once(tmp_path, monkeypatch):
    paths = [write_exr(tmp_path / f"{n}.exr", rgb(picture(32, 32, n))) for n in range(3)]
    comparison = open_comparison(paths[:2], paths[2])
    read, decode = [], ExrFile.read
    monkeypatch.setattr(ExrFile, "read", lambda self, *more: (read.append(self.path), decode(self, *more))[1])
    score_images(comparison)
    assert read.count(paths[2]) == 1


def views(path, image, names):
    """A file with a view layer of each name, whose picture is as bright as the name says."""
    parts = [(name, rgb(image * "_AB".index(name), f"{name}.Combined."), (0, 0)) for name in names]
    return write_exr(path, parts)


def test_all_files_are_compared_in_the_view_of_the_first_image(tmp_path):
    """Whatever order the other files have them in. A plain one has only one."""
    image = picture(32, 32)
    fused = views(tmp_path / "fused.exr", image, "BA")
    high, reference = (views(tmp_path / f"{name}.exr", image, "AB") for name in ("hr", "ref"))
    comparison = open_comparison([fused, high], reference)
    assert [render.view for render in comparison.renders] == ["B", "B", "B"]
    assert [measures["relmse"] for measures in score_images(comparison)] == [0, 0]
    assert notes(comparison) == []
    plain = open_comparison([views(tmp_path / "a.exr", image, "A")], write_exr(tmp_path / "plain.exr", rgb(image)))
    assert notes(plain) == []  # there is nothing to choose


def test_views_that_a_file_lacks_are_told(tmp_path):
    image = picture(32, 32)
    fused = views(tmp_path / "fused.exr", image, "BA")
    low, plain = views(tmp_path / "low.exr", image, "A"), write_exr(tmp_path / "ref.exr", rgb(image))
    (said,) = notes(open_comparison([fused, low], plain))
    assert said == f"Different views are compared: B of {fused}, A of {low}, (unnamed) of {plain}"


def test_the_left_eyes_are_compared_with_the_left_eye(tmp_path):
    """The eyes have parts of their own, in another order."""
    left = picture(32, 32)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    paths = []
    for name, eyes in (("image", ("left", "right")), ("ref", ("right", "left"))):
        parts = []
        for eye in eyes:
            planes = rgb(left * (1 if eye == "left" else 2))
            planes = {component: np.ascontiguousarray(plane) for component, plane in planes.items()}
            parts.append(OpenEXR.Part(header | {"view": eye}, planes, f"rgba.{eye}"))
        with OpenEXR.File(parts) as file:
            file.write(str(tmp_path / f"{name}.exr"))
        paths.append(tmp_path / f"{name}.exr")
    (measures,) = score_images(open_comparison(paths[:1], paths[1]))
    assert measures["relmse"] == 0


def test_an_enlarged_picture_has_no_negative_light():
    edge = np.full((8, 8, 3), -0.5, np.float32)
    edge[:, 4:] = 1
    enlarged = upsample_bicubic(edge, 32, 32)
    assert enlarged.min() == 0
    assert enlarged.max() == pytest.approx(1, rel=0.1)


def test_the_error_map_spans_five_decades():
    """From 1e-5 to 1, of the colours of "inferno"; beyond both ends nothing changes."""
    truth = np.zeros((1, 6, 3), np.float32)
    errors = np.float64([1e-6, 1e-5, 10**-2.5, 10**-1.25, 1, 10])
    image = np.sqrt(errors * 0.01 / 0.5)[None, :, None] * np.ones(3)
    colours = error_colours(error_levels(image.astype(np.float32), truth))[0]
    np.testing.assert_allclose(colours[0], colours[1], atol=0.01)
    np.testing.assert_allclose(colours[4], colours[5], atol=0.01)
    assert colours[1].sum() < 0.1 and colours[4].sum() > 2.3
    for colour, position in zip(colours[1:5], (0, 0.5, 0.75, 1), strict=True):
        grey = oiio.ImageBuf(np.full((1, 1, 1), position, np.float32))
        expected = oiio.ImageBufAlgo.color_map(grey, 0, "inferno").getpixel(0, 0)
        np.testing.assert_allclose(colour, expected[:3], atol=0.01)
