# SPDX-License-Identifier: Apache-2.0
"""The movement of a plane whose movement is known: every format is recognised, and what can't be known is said."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.aovs.motion import MotionFormat, user_fields
from oiio_msspl.aovs.renderers import renderers
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.motion import source as motion
from oiio_msspl.fusion.motion import vectors as motion_vectors
from oiio_msspl.fusion.motion.flow import flow_vectors
from oiio_msspl.fusion.motion.source import MotionFrame, MotionSource, find_motion
from tests import moving_plane as plane
from tests.conftest import rgb, write_exr
from tests.moving_plane import (
    HEIGHT,
    WIDTH,
    camera_matrix,
    encode,
    frame,
    layer,
    positions,
    screen_matrix,
    standing,
    texture,
    truck,
    truck_and_dolly,
    vectors,
)

AXES = [MotionFormat(*words) for words in itertools.product(("next", "previous"), ("right", "left"), ("down", "up"))]
UNITS = (("ndc", 1), ("screen", 1), ("width", 1), ("pixels", 2), ("pixels", 2.5))
FORMATS = AXES + [replace(AXES[3 * i % 8], unit=unit, scale=scale) for i, (unit, scale) in enumerate(UNITS)]
TABLE = [
    (renderer["name"], {key: value for key, value in entry.items() if key not in ("layer", "channels")})
    for renderer in renderers()
    for entry in renderer.get("motion", ())
]


@pytest.fixture(autouse=True)
def no_optical_flow(monkeypatch):
    """Tests are the same whether OpenCV is installed or not."""
    monkeypatch.setattr(motion, "has_optical_flow", lambda: False)


def shot(folder, form, name="motion", camera=truck_and_dolly, change=lambda values: values, **options):
    """Three frames whose layer holds vectors in a format."""
    return [
        frame(folder, t, layer(name, change(encode(vectors(camera, t, form.hop), form))), camera, **options)
        for t in (0, 1, 2)
    ]


def read(source, frames, t, step):
    """What the source says of frame t."""
    return source.read(MotionFrame(frames[t]), MotionFrame(frames[t + step]), step)


def right_share(source, frames, t, step, camera=truck_and_dolly):
    """Share of the pixels whose vector is known, all of them being right."""
    found, known = read(source, frames, t, step)
    np.testing.assert_allclose(found[known], vectors(camera, t, step)[known], atol=0.05)
    assert not found[~known].any()
    return known.mean()


@pytest.mark.parametrize("form", FORMATS, ids=str)
def test_every_format_is_found_by_the_pixels(tmp_path, form):
    """The table expects another one, and both directions are then right."""
    frames = shot(tmp_path, form, "velocity")
    source = find_motion(frames[0], frames[1])
    assert source.kind == "vectors", source.text
    assert right_share(source, frames, 1, form.hop) == 1
    # The opposite vectors come from the neighbour: right wherever the neighbour shows the surface.
    assert right_share(source, frames, 1, -form.hop) > 0.85


@pytest.mark.parametrize(("renderer", "words"), TABLE, ids=lambda v: v if isinstance(v, str) else "")
def test_what_the_table_expects_is_what_is_found(tmp_path, renderer, words):
    form = MotionFormat(**words)
    form = replace(form, scale=40.0, offset=0.5) if form.offset and form.unit == "pixels" else form
    alpha = {"A": np.full((HEIGHT, WIDTH), 0.5, np.float32)} if form.premultiplied else {}
    frames = []
    for t in (0, 1):
        values = encode(vectors(truck_and_dolly, t, form.hop), form) * (0.5 if form.premultiplied else 1)
        name = "motionvec" if form.premultiplied else "velocity"
        frames.append(frame(tmp_path, t, layer(name, values) | alpha))
    source = find_motion(*frames)
    (found,) = source.fields
    assert source.kind == "vectors", source.text
    assert (found.format.to, found.format.offset, found.format.premultiplied) == (
        form.to,
        form.offset,
        form.premultiplied,
    )
    factors = [f.pixels_per_unit(WIDTH, HEIGHT) for f in (found.format, form)]
    np.testing.assert_allclose(*factors, rtol=0.02)


def test_cycles_writes_both_directions_in_one_layer(tmp_path):
    frames = []
    for t in (0, 1, 2):
        back, fore = (vectors(truck_and_dolly, t, step) for step in (-1, 1))
        stored = np.concatenate([back * (1, -1), fore * (-1, 1)], axis=-1).astype(np.float32)
        channels = layer("View.Vector", stored, "XYZW") | layer("View.Combined", stored[..., :3] ** 2 + 0.1, "RGB")
        frames.append(frame(tmp_path, t, channels, **{"cycles.View.samples": "4"}))
    source = find_motion(frames[0], frames[1])
    assert [each.name for each in source.fields] == ["Vector.XY", "Vector.ZW"]
    assert source.fields == frames[0].motion.fields, "the table knows it"
    assert [right_share(source, frames, 1, step) for step in (-1, 1)] == [1, 1]


def test_a_frame_without_the_layer_has_no_known_vectors(tmp_path):
    frames = shot(tmp_path, MotionFormat())
    source = find_motion(*shot(tmp_path, MotionFormat(), "forward")[:2])
    assert not read(source, frames, 0, 1)[1].any()


def test_even_movement_follows_the_table(tmp_path):
    """A camera of constant speed: vectors to the next frame are the opposite of those to the previous one."""
    steady = lambda t: np.array([0.03 * t, 0.02 * t, 1.0])  # noqa: E731
    for name, to in (("forward", "next"), ("backward", "previous")):
        frames = shot(tmp_path, MotionFormat(to), name, steady)
        (found,) = find_motion(frames[0], frames[1]).fields
        assert found.format == MotionFormat(to)


def test_a_sideways_movement_does_not_tell_y(tmp_path):
    """It does not matter there either, so the table's is taken."""
    frames = shot(tmp_path, MotionFormat(y="up"), "velocity", truck)
    source = find_motion(frames[0], frames[1])
    assert source.kind == "vectors" and source.fields[0].format.y == "up"
    assert right_share(source, frames, 0, 1, truck) == 1


def test_zeros_are_not_believed_if_the_picture_moves(tmp_path):
    frames = shot(tmp_path, MotionFormat(), "forward", change=np.zeros_like)
    source = find_motion(frames[0], frames[1])
    assert source.kind == "none"
    assert "forward.XY: is zero everywhere, though the picture moves" in source.text
    with pytest.raises(InputError, match="motion blur is on"):
        find_motion(frames[0], frames[1], required=True)


def test_encoded_vectors_are_recognised_and_their_ends_are_not_believed(tmp_path):
    """0.5 is no motion, and 1 is so many pixels as nobody says; longer vectors are clamped."""
    form = MotionFormat(unit="pixels", scale=14.0, offset=0.5)
    frames = shot(tmp_path, form, "velocity", change=lambda values: values.clip(0, 1))
    clamped = (np.abs(encode(vectors(truck_and_dolly, 1, 1), form) - 0.5) >= 0.5).any(axis=-1)
    source = find_motion(frames[0], frames[1])
    assert source.fields[0].format.scale == pytest.approx(14, rel=0.02)
    found, known = read(source, frames, 1, 1)
    np.testing.assert_array_equal(known, ~clamped)
    assert 0.05 < clamped.mean() < 0.8
    np.testing.assert_allclose(found[known], vectors(truck_and_dolly, 1, 1)[known], atol=0.2)


@pytest.mark.parametrize("name", ["motionvec", "velocity"])
def test_premultiplied_vectors_are_divided_by_alpha(tmp_path, name):
    """The table knows it of one layer. Of the other one, the pixels show it."""
    alpha = np.linspace(0, 1, WIDTH, dtype=np.float32) * np.ones((HEIGHT, 1), np.float32)
    form = MotionFormat(unit="screen", y="up")
    frames = [
        frame(tmp_path, t, layer(name, encode(vectors(truck_and_dolly, t, 1), form) * alpha[..., None]) | {"A": alpha})
        for t in (0, 1)
    ]
    source = find_motion(*frames)
    assert source.fields[0].format.premultiplied
    assert right_share(source, frames, 0, 1) == pytest.approx(1 - 1 / WIDTH)


def test_broken_and_endless_vectors_are_not_believed(tmp_path):
    def damage(values):
        values[3, 4], values[5, 6, 0], values[7, 8, 1], values[9, 10] = np.nan, np.inf, -np.inf, 1e6
        return values

    frames = shot(tmp_path, MotionFormat(), "forward", change=damage)
    _, known = read(find_motion(frames[0], frames[1]), frames, 0, 1)
    assert sorted(zip(*np.nonzero(~known), strict=True)) == [(3, 4), (5, 6), (7, 8), (9, 10)]


def test_zeros_in_the_sky_are_not_believed_if_the_camera_moves(tmp_path):
    def sky(values):
        values[:20] = 0
        return values

    frames = shot(tmp_path, MotionFormat(), "forward", change=sky)
    _, known = read(find_motion(frames[0], frames[1]), frames, 0, 1)
    assert known[20:].all() and not known[:20].any()


@pytest.mark.parametrize("guides", [(), ("position",)])
def test_vectors_that_nothing_verifies_are_not_believed(tmp_path, guides):
    flat = {f"albedo.{c}": np.full((HEIGHT, WIDTH), 0.5, np.float32) for c in "RGB"}
    still = {f"position.{c}": np.ones((HEIGHT, WIDTH), np.float32) for c in "XYZ"} if guides else {}
    frames = [
        frame(tmp_path, t, layer("forward", vectors(truck_and_dolly, t, 1)) | flat | still, guides=()) for t in (0, 1)
    ]
    source = find_motion(*frames)
    assert source.kind == "none" and "--motion-format" in source.text
    with pytest.raises(InputError, match="--motion-format"):
        find_motion(*frames, required=True)
    source = find_motion(*frames, "layer=forward,to=next,x=right,y=down,unit=pixels", required=True)
    assert source.kind == "vectors" and "not verified" in source.text
    assert right_share(source, frames, 0, 1) == 1


def test_two_formats_that_fit_equally_well_are_ambiguous(tmp_path):
    """Stripes along x tell nothing of the movement along y, and here things do move along y."""
    frames = []
    for t in (0, 1):
        stripes = np.sin(np.arange(WIDTH) / 3 + t) * np.ones((HEIGHT, 1))
        albedo = np.repeat((0.5 + 0.4 * stripes)[..., None], 3, axis=-1).astype(np.float32)
        way = np.zeros((HEIGHT, WIDTH, 2), np.float32)
        way[..., 0], way[..., 1] = -3, 4
        frames.append(frame(tmp_path, t, layer("forward", way) | layer("albedo", albedo, "RGB"), guides=()))
    source = find_motion(*frames)
    assert source.kind == "none" and "fit it equally well" in source.text
    source = find_motion(*frames, "layer=forward,y=down,unit=pixels,scale=1")
    assert source.kind == "vectors"


def test_pixels_vote_where_noise_hides_the_margin(tmp_path, monkeypatch):
    """In noise the right format fits better than all others, but not 1.5 times as well."""
    rng = np.random.default_rng(2)
    slow = lambda t: np.array([0.012 * t, 0.0018 * t, 1.0])  # noqa: E731
    frames = []
    for t in (0, 1):
        plane = frame(tmp_path, t, {}, slow)
        albedo = plane.read(plane.data_window, ["albedo"])["albedo"]
        albedo = (albedo + rng.normal(0, 0.09, albedo.shape)).astype(np.float32)
        way = layer("forward", vectors(slow, t, 1))
        frames.append(frame(tmp_path, t, way | layer("albedo", albedo, "RGB"), slow, guides=()))
    assert find_motion(*frames).kind == "vectors"
    monkeypatch.setattr("oiio_msspl.fusion.motion.formats.SURE", np.inf)
    assert "fit it equally well" in find_motion(*frames).text


def test_vectors_that_fit_nothing_are_refused(tmp_path):
    noise = np.random.default_rng(1)
    frames = shot(tmp_path, MotionFormat(), "forward", change=lambda v: noise.normal(0, 4, v.shape).astype(np.float32))
    source = find_motion(frames[0], frames[1])
    assert source.kind == "none" and "no known format makes albedo, position of both frames agree" in source.text


def test_the_user_s_format_may_be_wrong(tmp_path):
    frames = shot(tmp_path, MotionFormat(), "velocity")
    assert find_motion(frames[0], frames[1], "layer=velocity,y=down").kind == "vectors"
    with pytest.raises(InputError, match="does not fit"):
        find_motion(frames[0], frames[1], "layer=velocity,to=next,x=left,y=up,unit=pixels")


def test_a_complete_description_that_the_pixels_contradict_is_refused(tmp_path):
    """The message names what fits better."""
    frames = shot(tmp_path, MotionFormat(y="up"), "velocity")
    described = "layer=velocity,to=next,x=right,unit=pixels,y="
    assert find_motion(*frames[:2], f"{described}up").kind == "vectors"
    better = "does not fit .*'to=next,x=right,y=up,unit=pixels' explains 100% of what changes, and this "
    for wrong in ("down", "up,scale=1.5"):
        with pytest.raises(InputError, match=better):
            find_motion(*frames[:2], described + wrong)


@pytest.mark.parametrize("scale", [1 / 24, 0.2, 5.0, 16.0, 24.0])
def test_a_shutter_may_have_any_length(tmp_path, scale):
    """The scale is found, and no other unit stands in for it."""
    frames = shot(tmp_path, MotionFormat(y="up", scale=scale), "velocity")
    source = find_motion(*frames[:2])
    (found,) = source.fields
    assert (found.format.x, found.format.y, found.format.unit) == ("right", "up", "pixels"), source.text
    assert found.format.scale == pytest.approx(scale, rel=0.01)
    assert right_share(source, frames, 0, 1) == 1


@pytest.mark.parametrize("y", ["up", "down"])
def test_what_frames_do_not_tell_is_what_is_expected_at_any_scale(tmp_path, y):
    frames = shot(tmp_path, MotionFormat(y=y, scale=7.0), "velocity", truck)
    expected = find_motion(*frames[:2]).fields[0].format
    assert expected.y == frames[0].motion.fields[0].format.y
    assert expected.scale == pytest.approx(7, rel=0.01)


def test_a_scale_that_no_shutter_has_is_not_found(tmp_path):
    frames = shot(tmp_path, MotionFormat(scale=0.01), "velocity")
    assert "no known format" in find_motion(*frames[:2]).text


def test_what_other_frames_have_shown_is_kept_unless_another_format_fits_better(tmp_path):
    """A sideways movement does not tell y. One upwards does."""
    sideways = shot(tmp_path, MotionFormat(y="up"), "velocity", truck)
    first = find_motion(*sideways[:2])
    assert first.silent == {"y"} and not first.tells_more(sideways[1])
    (tmp_path / "up").mkdir()
    lift = lambda t: np.array([0.0, 0.02 * t + 0.01 * t * t, 1.0])  # noqa: E731
    upwards = shot(tmp_path / "up", MotionFormat(y="up"), "velocity", lift)
    assert first.tells_more(upwards[0])
    second = find_motion(*upwards[:2], None, first.fields)
    assert second.silent == {"x"}
    assert second.fields[0].format.y == "up"
    wrong = [replace(each, format=replace(each.format, y="down")) for each in first.fields]
    assert find_motion(*upwards[:2], None, wrong).fields[0].format.y == "up"
    assert find_motion(*sideways[:2], None, wrong).fields[0].format.y == "down"


def test_a_standing_camera_needs_no_vectors(tmp_path):
    frames = [frame(tmp_path, t, {}, standing) for t in (0, 1)]
    source = find_motion(*frames, required=True)
    found, known = read(source, frames, 0, 1)
    assert source.kind == "static" and known.all() and not found.any()


def test_a_standing_camera_is_recognised_through_noise(tmp_path):
    """Albedo of few samples differs from frame to frame though nothing moves."""
    rng = np.random.default_rng(3)
    frames = []
    for t in (0, 1):
        plane = frame(tmp_path, t, {}, standing)
        albedo = plane.read(plane.data_window, ["albedo"])["albedo"]
        noisy = (albedo + rng.normal(0, 0.05, albedo.shape)).astype(np.float32)
        frames.append(frame(tmp_path, t, layer("albedo", noisy, "RGB"), standing, guides=()))
    assert find_motion(*frames).kind == "static"


def test_a_camera_that_starts_to_move_is_no_longer_static(tmp_path):
    """No source may say 'nothing moves' of frames that it has not seen."""
    start = lambda t: truck_and_dolly(max(t - 1, 0) * 2)  # noqa: E731
    for kind in ("no vectors", "vectors", "zeros"):
        frames = []
        for t in (0, 1, 2):
            way = vectors(start, t, 1) * np.float32(kind == "vectors")
            frames.append(frame(tmp_path, t, {} if kind == "no vectors" else layer("forward", way), start))
        # Between the first two frames nothing moves; vectors of the second one say that it is about to.
        source = find_motion(frames[0], frames[0] if kind == "vectors" else frames[1])
        assert source.kind == "static"
        assert read(source, frames, 0, 1)[1].all()
        assert not read(source, frames, 1, 1)[1].any()


def test_a_standing_camera_does_not_make_unclear_vectors_believed(tmp_path):
    """A few pixels move, too few to verify their vectors: they are left out, and the user may describe them."""
    frames = []
    for t in (0, 1):
        way = np.zeros((HEIGHT, WIDTH, 2), np.float32)
        way[40:44, 60:64] = 3, 2
        frames.append(frame(tmp_path, t, layer("forward", way), standing))
    source = find_motion(*frames, required=True)
    found, known = read(source, frames, 0, 1)
    assert source.kind == "static" and "--motion-format" in source.text
    assert np.count_nonzero(~known) == 16 and not known[40:44, 60:64].any() and not found.any()
    source = find_motion(*frames, "layer=forward,to=next,x=right,y=down,unit=pixels")
    found, known = read(source, frames, 0, 1)
    assert source.kind == "vectors" and known.all() and (found[40:44, 60:64] == (3, 2)).all()


@pytest.mark.parametrize("names", [("worldToScreen",), ("worldToCamera",), ("worldToCamera", "worldToNDC")])
def test_matrices_and_positions_give_the_camera_s_movement(tmp_path, names):
    """Karma is known to write the matrix to the camera as worldToNDC, too: the pixels tell."""
    frames = []
    for t in (0, 1, 2):
        made = {
            "worldToScreen": screen_matrix(truck_and_dolly, t),
            "worldToCamera": camera_matrix(truck_and_dolly, t),
            "worldToNDC": camera_matrix(truck_and_dolly, t),
        }
        frames.append(frame(tmp_path, t, {}, **{name: made[name] for name in names}))
    source = find_motion(frames[0], frames[1], required=True)
    assert source.kind == "camera", source.text
    assert [right_share(source, frames, 1, step) for step in (-1, 1)] == [1, 1]


def test_matrices_of_another_frame_are_not_used(tmp_path):
    """The positions do not lie where the matrix says."""
    wrong = np.array(screen_matrix(truck_and_dolly, 0))
    wrong[:, :2] = wrong[:, 1::-1]
    frames = [frame(tmp_path, t, {}, worldToScreen=wrong) for t in (0, 1)]
    assert find_motion(*frames).kind == "none"


def test_data_windows_may_differ(tmp_path):
    """The neighbour shows another part of the frame; vectors count in the display window."""
    windows = [{"x0": 10, "y0": 4, "height": 80, "width": 120}, {"x0": 20, "y0": 8, "height": 88, "width": 140}] * 2
    frames = [
        frame(tmp_path, t, layer("backward", vectors(truck_and_dolly, t, -1, **windows[t])), window=windows[t])
        for t in (0, 1, 2)
    ]
    source = find_motion(frames[0], frames[1])
    for step, share in ((-1, 1.0), (1, 0.6)):
        found, known = read(source, frames, 1, step)
        wanted = vectors(truck_and_dolly, 1, step, **windows[1])
        assert found.shape == wanted.shape and known.mean() >= share
        np.testing.assert_allclose(found[known], wanted[known], atol=0.02)


def test_frames_without_a_common_part_tell_nothing(tmp_path):
    frames = [frame(tmp_path, t, {}, window={"x0": 60 * t, "height": 40, "width": 40}) for t in (0, 1)]
    source = find_motion(*frames)
    assert source.kind == "none" and "no common part" in source.text


@pytest.mark.parametrize("size", [(1, WIDTH), (HEIGHT, 1)])
def test_frames_that_share_a_row_or_a_column_are_read(tmp_path, size):
    window = dict(zip(("height", "width"), size, strict=True))
    moving = layer("velocity", np.full((*size, 2), 2, np.float32))
    frames = [frame(tmp_path, t, moving, window=window) for t in (0, 1)]
    assert find_motion(*frames).kind in ("camera", "none")


def test_large_frames_are_verified_on_fewer_pixels(tmp_path, monkeypatch):
    """The vectors that are read stay whole."""
    monkeypatch.setattr("oiio_msspl.fusion.motion.guides.MAX_PIXELS", WIDTH * HEIGHT // 3)
    frames = shot(tmp_path, MotionFormat(unit="ndc", y="up"), "velocity")
    source = find_motion(frames[0], frames[1])
    assert right_share(source, frames, 1, 1) == 1


def test_optical_flow_is_the_last_resort(tmp_path, monkeypatch):
    pytest.importorskip("cv2")
    monkeypatch.setattr(motion, "has_optical_flow", lambda: True)
    frames = [frame(tmp_path, t, {}) for t in (0, 1)]
    source = find_motion(*frames)
    assert source.kind == "flow" and "less exact" in source.text
    with pytest.raises(ValueError, match="fused beauty"):
        read(source, frames, 0, 1)
    shown = [MotionFrame(each, each.read(each.data_window, ["rgb"])["rgb"]) for each in frames]
    found, known = source.read(*shown, 1)
    wrong = np.hypot(*np.moveaxis(found - vectors(truck_and_dolly, 0, 1), -1, 0))
    assert known.mean() > 0.7 and np.median(wrong[known]) < 0.2


@pytest.mark.parametrize("size", [(1, 1), (11, 300), (12, 300), (300, 5)])
def test_optical_flow_of_a_few_pixels_is_not_believed(size):
    pytest.importorskip("cv2")
    image, window = np.ones((*size, 3), np.float32), Window(0, 0, size[1], size[0])
    vectors, known = flow_vectors(image, image, window, window)
    assert vectors.shape == (*size, 2) and not vectors.any() and not known.any()


def test_without_anything_the_user_learns_what_to_render(tmp_path):
    frames = [frame(tmp_path, t, {}) for t in (0, 1)]
    source = find_motion(*frames)
    assert source.kind == "none" and "render motion vectors, or install opencv-python-headless" in source.text
    found, known = read(source, frames, 0, 1)
    assert not known.any() and not found.any()


@pytest.mark.parametrize(
    "text",
    ["velocity", "layer=none", "layer=velocity,to=later", "layer=velocity,scale=much", "layer=velocity,channels=XYZ",
     "layer=velocity,channels=QZ", "to=next", "layer=velocity,colour=red", "layer="],
)  # fmt: skip
def test_a_format_that_cannot_be_read_is_refused(tmp_path, text):
    frames = shot(tmp_path, MotionFormat(), "velocity")
    with pytest.raises(InputError, match="--motion-format"):
        find_motion(frames[0], frames[1], text)


def test_a_format_may_describe_two_layers(tmp_path):
    frames = [
        frame(
            tmp_path, t, layer("there", vectors(truck_and_dolly, t, 1)) | layer("back", vectors(truck_and_dolly, t, -1))
        )
        for t in (0, 1, 2)
    ]
    source = find_motion(frames[0], frames[1], "layer=there+layer=back,to=previous")
    assert [each.layer for each in source.fields] == ["there", "back"]
    assert [right_share(source, frames, 1, step) for step in (1, -1)] == [1, 1]


def test_a_format_takes_the_channels_that_lead_to_its_frame(tmp_path):
    """Cycles' layer has vectors to the previous frame in XY, and to the next one in ZW."""
    names = [
        f"ViewLayer.{name}" for name in ("Combined.R", "Combined.G", "Combined.B", *(f"Vector.{c}" for c in "XYZW"))
    ]
    blank = np.zeros((8, 8), np.float32)
    path = write_exr(tmp_path / "hr.exr", dict.fromkeys(names, blank), **{"cycles.ViewLayer.samples": "1"})
    layers = map_render(open_exr(path)).motion
    for words, channels in (("to=next", ["ZW"]), ("to=previous,y=down", ["XY"]), ("unit=pixels", ["XY", "ZW"])):
        found = user_fields(layers, f"layer=Vector,{words}")
        assert ["".join(each.components) for each in found] == channels


@pytest.mark.parametrize("word", ["premultiplied=false", "scale=nan", "scale=0", "offset=inf"])
def test_a_word_that_would_mean_something_else_is_refused(tmp_path, word):
    path = write_exr(tmp_path / "hr.exr", dict.fromkeys(["R", "G", "B", "v.X", "v.Y"], np.zeros((8, 8), np.float32)))
    with pytest.raises(InputError, match=word.partition("=")[0]):
        user_fields(map_render(open_exr(path)).motion, f"layer=v,{word}")


def test_vectors_that_are_zero_where_they_are_tried_explain_nothing(tmp_path):
    """The first frame of an animation has none; the user's description stands, and nothing verifies it."""
    frames = []
    for t in (0, 1):
        way = vectors(truck_and_dolly, t, 1)
        frames.append(frame(tmp_path, t, layer("forward", way if t else np.zeros_like(way)), truck_and_dolly))
    source = find_motion(*frames, "layer=forward,to=next,x=right,y=down,unit=pixels")
    assert source.kind == "vectors" and source.text.endswith("as --motion-format says, not verified; "
        "vectors to the previous frame are computed by inverting these")  # fmt: skip


@pytest.mark.parametrize(("turn", "followed"), [(0.2, True), (0.5, False)])
def test_what_turns_fast_is_not_followed(turn, followed):
    """A disc turns in front of a wall that moves. Its rim, and a line of a pixel, are borders of surfaces."""
    y, x = np.mgrid[-32:32, -32:32].astype(np.float32)
    disc = x**2 + y**2 < 24**2
    vectors = np.full((64, 64, 2), 3, np.float32)
    vectors[disc] = np.stack([-turn * y, turn * x], axis=-1)[disc]
    vectors[:, 2] = -3
    uneven = motion_vectors._uneven(vectors)
    assert not uneven[~disc].any()
    assert uneven[x**2 + y**2 < 22**2].all() != followed


@pytest.mark.filterwarnings("error")
def test_vectors_of_any_value_are_judged_without_a_warning():
    values = np.random.default_rng(0).uniform(-3e38, 3e38, (8, 8, 2)).astype(np.float32)
    values[0, 0], values[3, 3] = np.nan, np.inf
    motion_vectors._uneven(values)


@pytest.mark.parametrize("step", [1, -1])
def test_vectors_that_are_read_with_the_pixels_are_those_of_the_file(tmp_path, step):
    """Those of the other direction are inverted, from the vectors of both frames."""
    frames = shot(tmp_path, MotionFormat(), "forward")
    source = find_motion(frames[0], frames[1])
    loaded = []
    for hr in frames:
        pixels, stored = hr.load_with(source.channels(hr))
        loaded.append(MotionFrame(hr, vectors=source.vectors_of(hr, pixels, stored)))
    assert all(each.vectors.keys() == {1} for each in loaded)
    for ours, theirs in zip(source.read(loaded[1], loaded[1 + step], step), read(source, frames, 1, step), strict=True):
        assert theirs.any()
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("camera", [standing, truck_and_dolly], ids=["standing", "moving"])
def test_objects_that_move_by_themselves_are_found(tmp_path, camera):
    """An object comes in front of a wall. Single noisy pixels of the wall are none, nor are unknown ones."""
    rng = np.random.default_rng(3)
    frames = []
    for t in (0, 1):
        albedo = 0.4 + 0.3 * texture(*np.moveaxis(positions(camera, t)[..., :2], -1, 0))
        if t:
            albedo[30:50, 60:90] = 0.9, 0.2, 0.1
        noisy = (albedo + rng.normal(0, 0.03, albedo.shape)).astype(np.float32)
        noisy[70, 100] = np.nan
        matrix = {} if camera is standing else {"worldToScreen": screen_matrix(camera, t)}
        guides = () if camera is standing else ("position",)
        frames.append(frame(tmp_path, t, layer("albedo", noisy, "RGB"), camera, guides=guides, **matrix))
    source = find_motion(*frames, required=True)
    assert source.kind == ("static" if camera is standing else "camera")
    ahead, way = (MotionFrame(frames[1]), MotionFrame(frames[0])), read(source, frames, 1, -1)
    moved_objects = source.moved_objects(*ahead, *way)
    assert moved_objects[30:50, 60:90].all()
    far = moved_objects.copy()
    far[26:54, 56:94] = False
    assert far.mean() < 0.03
    unknown = way[1].copy()
    unknown[28:52, 58:92] = False
    assert not source.moved_objects(*ahead, way[0], unknown)[35:45, 65:85].any()
    found = source.moved_objects(*ahead[::-1], *read(source, frames, 0, 1))
    assert found.sum() > 500 and (camera is not standing or (found == moved_objects).all())


@pytest.mark.parametrize("size", [(2200, 2100), (1, 1), (3, 2)])
def test_without_layers_that_tell_no_object_is_found(tmp_path, size):
    height, width = size
    light = rgb(np.full((height, width, 3), 0.5, np.float32))
    for name in ("a", "b"):
        write_exr(tmp_path / f"{name}.exr", light)
    pair = [MotionFrame(map_render(open_exr(tmp_path / f"{name}.exr"))) for name in ("a", "b")]
    still, known = np.zeros((height, width, 2), np.float32), np.ones((height, width), bool)
    assert not MotionSource("static", "").moved_objects(*pair, still, known).any()
    assert not MotionSource("vectors", "").misleads(*pair, still + 2, known)
    assert MotionSource("flow", "").moved_objects(*pair, still, known) is None


def test_a_layer_of_an_unknown_name_is_told_by_the_pixels(tmp_path):
    """Unknown layers that are no vectors do no harm, and are named."""
    form = MotionFormat("previous", y="up")
    frames = shot(tmp_path, form, "motion")
    assert not frames[0].motion.fields and [field.name for field in frames[0].motion.guesses] == ["motion.XY"]
    source = find_motion(frames[0], frames[1])
    assert (source.kind, source.fields[0].name) == ("vectors", "motion.XY")
    assert right_share(source, frames, 1, -1) > 0.8
    (tmp_path / "other").mkdir()
    frames = shot(tmp_path / "other", form, "wear", change=lambda values: np.sqrt(np.abs(values)) % 1)
    source = find_motion(frames[0], frames[1])
    assert "motion vectors (by the pixels wear.XY holds none); " in source.text
    assert source.text.startswith("no ")


@pytest.mark.parametrize(("of_length", "misleads"), [(1, False), (0.8, False), (-1, True), (3, True)])
def test_vectors_that_no_motion_or_the_opposite_beats_mislead(tmp_path, of_length, misleads):
    pair = [MotionFrame(plane.frame(tmp_path, t, {}, guides=("albedo",))) for t in (0, 1)]
    way, known = plane.vectors(plane.truck_and_dolly, 0, 1), np.ones((plane.HEIGHT, plane.WIDTH), bool)
    assert MotionSource("vectors", "").misleads(*pair, of_length * way, known) == misleads
