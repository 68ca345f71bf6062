# SPDX-License-Identifier: Apache-2.0
"""Linear RGB spaces: their matrices, and which one a header or a name means."""

import numpy as np
import pytest

from oiio_msspl.image.colour import (
    ACES2065,
    ACESCG,
    REC709,
    REC2020,
    SPACES,
    conversion,
    luminance,
    named_space,
    same_space,
    space_of,
)

#: Published matrices: of the ACES project's CTL and OpenColorIO's configurations (Bradford), and of ITU-R BT.2087.
PUBLISHED = {
    (ACESCG, REC709): [
        [1.7050509, -0.6217921, -0.0832589],
        [-0.1302564, 1.1408047, -0.0105483],
        [-0.0240034, -0.1289690, 1.1529723],
    ],
    (ACES2065, REC709): [
        [2.5216861, -1.1341309, -0.3875551],
        [-0.2764799, 1.3727191, -0.0962391],
        [-0.0153781, -0.1529753, 1.1683534],
    ],
    (ACES2065, ACESCG): [
        [1.4514393161, -0.2365107469, -0.2149285693],
        [-0.0765537734, 1.1762296998, -0.0996759264],
        [0.0083161484, -0.0060324498, 0.9977163014],
    ],
    (REC709, REC2020): [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]],
}


@pytest.mark.parametrize("width", [156, 157, 159, 160])
def test_luminance_does_not_depend_on_how_the_picture_lies_in_memory(width):
    """Frames that are read from a file lie otherwise than frames in memory, and the result must be the same."""
    image = np.random.default_rng(width).gamma(1, 1, (64, width, 3)).astype(np.float32)
    planar = np.ascontiguousarray(image.transpose(2, 0, 1)).transpose(1, 2, 0)
    np.testing.assert_array_equal(luminance(image), luminance(planar))
    np.testing.assert_array_equal(luminance(image)[:, 5:50], luminance(image[:, 5:50]))


@pytest.mark.parametrize("pair", PUBLISHED, ids=lambda pair: f"{pair[0].name} to {pair[1].name}")
def test_matrices_are_the_published_ones(pair):
    np.testing.assert_allclose(conversion(*pair), PUBLISHED[pair], atol=6e-5)


@pytest.mark.parametrize("space", SPACES, ids=lambda space: space.name)
def test_white_stays_white_and_the_way_back_is_the_inverse(space):
    there, back = conversion(space, REC709), conversion(REC709, space)
    np.testing.assert_allclose(there @ np.ones(3), 1, atol=1e-12)
    np.testing.assert_allclose(there @ back, np.eye(3), atol=1e-12)


def test_chromaticities_of_a_header_win_over_names():
    """Rounded to float32 they are still the same space; unknown ones are a space of their own."""
    rounded = tuple(float(v) for v in np.float32(ACESCG.chromaticities))
    assert space_of({"chromaticities": rounded, "oiio:ColorSpace": "lin_rec709_scene"}) == ACESCG
    own = (0.7, 0.3, 0.2, 0.7, 0.1, 0.05, 0.3127, 0.329)
    assert space_of({"chromaticities": own}).chromaticities == own


def test_the_interop_id_wins_over_stale_chromaticities():
    """A program that converts colours sets the ID, and often keeps the chromaticities of its source."""
    header = {"chromaticities": tuple(map(float, REC709.chromaticities)), "oiio:ColorSpace": "lin_ap1_scene"}
    assert space_of(header | {"colorInteropID": "lin_ap1_scene"}) == ACESCG
    assert space_of(header | {"colorInteropID": "unknown"}) == REC709
    assert space_of({"colorInteropID": "lin_adobergb_scene"}).name == "lin_adobergb"


@pytest.mark.parametrize("values", [(0.0,) * 8, (float("nan"),) * 8, (0.3, 0.3) * 4, (1.0,), "8 letters", None])
def test_chromaticities_that_mean_nothing_are_ignored(values):
    assert space_of({"chromaticities": values}) is None


@pytest.mark.parametrize(
    ("name", "space"),
    [("ACEScg", ACESCG), ("lin_ap1_scene", ACESCG), ("Linear Rec.709 (sRGB)", REC709), ("ACES2065-1", ACES2065)],
)
def test_names_of_configurations_are_understood(name, space):
    assert named_space(name) == space


def test_names_of_no_linear_space_are_not(monkeypatch):
    assert named_space("sepia") is None
    assert named_space("ACEScct") is None
    assert space_of({"oiio:ColorSpace": "scene_linear"}) is None  # which a file gets that nobody gave a space


def test_names_of_the_users_configuration_are_understood(tmp_path, monkeypatch):
    """$OCIO: its own alias of ACEScg, which no table here has."""
    config = tmp_path / "config.ocio"
    config.write_text(
        "ocio_profile_version: 2\nroles: {default: ACEScg, scene_linear: ACEScg}\n"
        "displays: {d: [!<View> {name: v, colorspace: ACEScg}]}\n"
        "colorspaces:\n  - !<ColorSpace> {name: ACEScg, aliases: [house_space, acescg]}\n"
    )
    monkeypatch.setenv("OCIO", str(config))
    assert named_space("house_space") == ACESCG


def test_spaces_whose_headers_were_rounded_are_the_same():
    own = (0.7, 0.3, 0.2, 0.7, 0.1, 0.05, 0.3127, 0.329)
    one, other = (space_of({"chromaticities": tuple(v + delta for v in own)}) for delta in (0, 1e-6))
    assert one != other and same_space(one, other) and not same_space(one, ACESCG)
    moved = space_of({"chromaticities": (own[0] - 0.01, *own[1:])})
    assert not same_space(one, moved)


def test_luminance_weighs_red_green_and_blue_as_rec_709_does():
    assert luminance(np.eye(3, dtype=np.float32)) == pytest.approx([0.2126, 0.7152, 0.0722])
