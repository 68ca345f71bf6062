# SPDX-License-Identifier: Apache-2.0
"""The page of `msspl compare --html`: what it holds, and what a browser shows of it."""

import base64
import json
import re
import zlib
from html import unescape
from urllib.parse import urlencode

import numpy as np
import OpenEXR
import pytest

from oiio_msspl.compare import error_colours, error_levels, open_comparison, upsample_bicubic
from oiio_msspl.compare_page import CODES_PER_STOP, STOPS_BELOW_ONE, pack, to_codes, write_page
from oiio_msspl.errors import InputError
from oiio_msspl.image.colour import ACESCG, REC709, conversion, srgb
from oiio_msspl.image.metrics import psnr, relmse
from tests.browser import BROWSER, dump_dom
from tests.conftest import downsample, noisy, picture, rgb, write_exr
from tests.exr.sources import behind_a_deep_part

needs_browser = pytest.mark.skipif(not BROWSER, reason="needs Chromium")


def from_codes(codes):
    """The inverse of `to_codes`, after the description in the module."""
    stops = codes.astype(np.float64) / CODES_PER_STOP - STOPS_BELOW_ONE
    return (np.exp2(stops) - 2.0**-STOPS_BELOW_ONE).astype(np.float32)


def test_codes_are_off_by_half_a_percent_at_most():
    light = np.concatenate([[0], np.geomspace(1e-9, 3e38, 100_000)]).astype(np.float32)
    error = np.abs(from_codes(to_codes(light)).astype(np.float64) - light)
    assert (error <= 0.0055 * (light + 2.0**-12)).all()
    assert from_codes(to_codes(np.float32([[0, -1, np.nan]]))).tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("exposure", [-4, 0, 4])
def test_a_gradient_has_no_bands(exposure):
    """At any exposure, a smooth gradient is off by less than a step of the 8-bit picture, and leaves out at most one
    value in a row."""
    gradient = np.linspace(0, 2.0**-exposure, 50_000, dtype=np.float32)
    display = 255 * srgb(from_codes(to_codes(gradient)) * np.float32(2**exposure))
    assert np.abs(display - 255 * srgb(gradient * np.float32(2**exposure))).max() < 0.65
    assert np.diff(np.unique(np.round(display))).max() <= 2


def unpack(data, height, width, channels):
    """The inverse of `pack`, after the description in the module."""
    low, high = np.frombuffer(zlib.decompress(data), np.uint8).reshape(2, channels, height, width).astype(np.int32)
    unsigned = low + 256 * high
    planes = np.where(unsigned % 2, -(unsigned + 1) // 2, unsigned // 2)
    planes = np.cumsum(planes, axis=-1)
    if channels == 3:
        planes = np.stack([planes[1] + planes[0], planes[0], planes[2] + planes[0]])
    return np.moveaxis(planes, 0, -1)


@pytest.mark.parametrize("channels", [1, 3])
def test_packing_loses_nothing(channels):
    """Of noise, of a smooth picture, and of the largest differences."""
    noise = np.random.default_rng(0).integers(0, 9000, (40, 50, channels)).astype(np.int16)
    extreme = np.where(np.indices((40, 50, channels)).sum(0) % 2, 8960, 0).astype(np.int16)
    ramp = np.outer(np.linspace(1, 3, 40), np.geomspace(0.01, 10, 50))[..., None] * np.ones(channels)
    smooth = to_codes(ramp.astype(np.float32))
    for codes in (noise, extreme, smooth):
        np.testing.assert_array_equal(unpack(pack(codes), *codes.shape), codes)


LIGHT_1, LIGHT_2 = 0.7 * picture(48, 64), 0.3 * picture(48, 64)[::-1]
LR, HR, REF = 2, 1, 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Images with two light groups, the second missing in the LRHS; the HRLS has depth and an object's number too."""
    folder = tmp_path_factory.mktemp("page")
    depth = np.tile(1 + 0.1 * np.arange(64, dtype=np.float32), (48, 1))
    depth[:, -4:] = 1e10  # the sky

    def write(name, light_1, light_2, **more):
        lights = rgb(light_1, "light_1.") | (rgb(light_2, "light_2.") if name != "lr.exr" else {})
        write_exr(folder / name, rgb(light_1 + light_2) | lights | more)

    write("out.exr", 1.1 * LIGHT_1, LIGHT_2)
    write("hr.exr", noisy(LIGHT_1, 1), LIGHT_2, Z=depth, **{"id.X": np.ones((48, 64), np.uint32)})
    write("lr.exr", downsample(LIGHT_1, 4), downsample(LIGHT_2, 4))
    write("ref.exr", LIGHT_1, LIGHT_2)
    return folder


@pytest.fixture(scope="module")
def page(folder):
    images = [folder / name for name in ("out.exr", "hr.exr", "lr.exr")]
    write_page(folder / "page.html", open_comparison(images, folder / "ref.exr"), layers=["light_*", "Z"])
    return folder / "page.html"


def manifest(page):
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="manifest">(.*?)</script>', text)[1])


def test_the_page_holds_layers_and_scores(page):
    made = manifest(page)
    assert made["pictures"] == ["out.exr", "hr.exr", "lr.exr", "ref.exr"]
    assert [layer["name"] for layer in made["layers"]] == ["beauty", "light_1", "light_2", "Z"]
    beauty, first, second, depth = made["layers"]
    assert first["images"]["0"]["psnr"] == pytest.approx(psnr(1.1 * LIGHT_1, LIGHT_1))
    low = upsample_bicubic(downsample(LIGHT_1, 4).astype(np.float32), 64, 48)
    assert first["images"]["2"]["relmse"] == pytest.approx(relmse(low, LIGHT_1))
    assert first["images"]["2"]["width"] == 16
    assert second["images"]["0"]["psnr"] is None  # no error
    assert set(second["images"]) == {"0", "1", "3"} and set(second["errors"]) == {"0", "1"}
    assert set(beauty["errors"]) == {"0", "1", "2"}
    assert set(depth["images"]) == {"1"} and not depth["errors"]
    assert depth["range"] == pytest.approx([1, 6.9], abs=0.1)  # without the sky


def test_the_page_shows_the_part_that_all_pictures_hold(tmp_path):
    display = (np.array([0, 0], np.int32), np.array([63, 47], np.int32))
    for name, top in (("image", 0), ("ref", 4)):
        part = ("rgba", rgb(LIGHT_1[top : top + 44]), (0, top))
        write_exr(tmp_path / f"{name}.exr", [part], display=display)
    write_page(tmp_path / "page.html", open_comparison([tmp_path / "image.exr"], tmp_path / "ref.exr"))
    made = manifest(tmp_path / "page.html")
    image = made["layers"][0]["images"]["0"]
    assert (made["height"], image["height"], image["relmse"]) == (40, 40, 0)


def test_the_page_needs_nothing_from_outside(page):
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"""https?://|\bsrc=|<link|@import|\burl\(""", text)


def test_by_default_the_page_shows_layers_that_sum_to_the_beauty(folder):
    image = open_comparison([folder / "hr.exr"])
    size, layers = write_page(folder / "sets.html", image, overwrite=True)
    assert layers == ["beauty", "light_1", "light_2"]
    assert size == (folder / "sets.html").stat().st_size
    assert write_page(folder / "sets.html", image, layers=["beauty"], overwrite=True)[1] == ["beauty"]
    everything = write_page(folder / "sets.html", image, layers=["*"], overwrite=True)[1]
    assert everything == ["beauty", "light_1", "light_2", "Z"]  # no numbers of objects


def test_a_deep_part_hides_no_layer(tmp_path):
    path = behind_a_deep_part(tmp_path / "a.exr", rgb(picture(16, 16)) | {"Z": picture(16, 16)[..., 0]})
    assert write_page(tmp_path / "page.html", open_comparison([path]), layers=["*"])[1] == ["beauty", "Z"]


def test_colours_are_those_of_srgb(tmp_path):
    write_exr(tmp_path / "aces.exr", rgb(picture(16, 16)), chromaticities=ACESCG.chromaticities)
    write_page(tmp_path / "page.html", open_comparison([tmp_path / "aces.exr"]))
    entry = manifest(tmp_path / "page.html")["layers"][0]["images"]["0"]
    text = re.search(rf'id="{entry["id"]}">(.*?)<', (tmp_path / "page.html").read_text(encoding="utf-8"))[1]
    light = from_codes(unpack(base64.b64decode(text), 16, 16, 3).astype(np.int16))
    expected = np.maximum(picture(16, 16) @ conversion(ACESCG, REC709).T, 0)
    assert np.abs(expected - picture(16, 16)).max() > 0.1
    np.testing.assert_allclose(light, expected, rtol=0.006, atol=1e-5)


def test_what_can_not_be_shown_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match="no image has such a layer; they have: beauty, light_1, light_2, Z"):
        write_page(tmp_path / "page.html", open_comparison([folder / "hr.exr"]), layers=["nothing"])
    write_exr(tmp_path / "small.exr", rgb(picture(20, 20)))
    with pytest.raises(InputError, match=r"small.exr is 20x20, but .*hr.exr is 64x48"):
        write_page(tmp_path / "page.html", open_comparison([tmp_path / "small.exr", folder / "hr.exr"]))
    assert [path.name for path in tmp_path.iterdir()] == ["small.exr"]


def look(page, **wanted):
    """What the browser shows: the screen's pixel, the values and the texts at the place that the address names."""
    html = dump_dom(f"{page.as_uri()}#{urlencode(wanted)}")
    readout = re.search(r'id="readout"[^>]*>(.*?)<', html)[1]
    screen = re.search(r'data-screen="([\d ]+)"', html)[1]
    values = {side: list(map(float, text.split())) for side, text in re.findall(r"(left|right) ([\d. e+-]+)", readout)}
    elements = re.findall(r'id="((?:caption|missing)-\w+)"[^>]*>(.*?)<', html, re.DOTALL)
    texts = {name: unescape(text) for name, text in elements}
    return np.array([int(v) for v in screen.split()][:3]), values, texts


def assert_shows(screen, light, exposure=0):
    """The screen shows the light, but for the rounding of codes and of 8 bits."""
    np.testing.assert_allclose(screen, 255 * srgb(np.float32(light) * np.float32(2**exposure)), atol=1.2)


@needs_browser
@pytest.mark.parametrize(
    ("layer", "exposure", "wipe", "expected", "at"),
    [
        ("beauty", 0, 1, 1.1 * LIGHT_1 + LIGHT_2, (10, 40)),
        ("light_1", 0, 0, LIGHT_1, (10, 40)),
        ("light_2", 4, 1, LIGHT_2, (10, 40)),
        ("beauty", -4, 0, LIGHT_1 + LIGHT_2, (30, 20)),
    ],
)
def test_the_browser_shows_the_pixels_of_the_files(page, layer, exposure, wipe, expected, at):
    """The first picture is left of the wipe, the reference right of it. The last place is brighter than 1."""
    place = f"{at[0]},{at[1]}"
    screen, values, texts = look(page, layer=layer, left=1, right=REF + 1, exposure=exposure, wipe=wipe, at=place)
    light = expected[at[1], at[0]]
    assert_shows(screen, light, exposure)
    np.testing.assert_allclose(values["left" if wipe else "right"], light, rtol=0.011, atol=1e-5)
    assert texts["caption-left"].startswith("out.exr\nPSNR ") and texts["caption-right"] == "ref.exr"


def act(page, script, tmp_path, **wanted):
    """What the screen shows around the place (10, 40) after a script has sent events, as sRGB codes (21, 21, 3).

    The script may use ``at(x, y)``: where a point of the picture lies on the screen, as the coordinates of an event.
    """
    helpers = """
      const at = (x, y) => {
        const box = stage.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
        const [left, top] = [camera.x + x * camera.scale * page.pixelAspect, camera.y + y * camera.scale];
        return { clientX: box.left + left / ratio, clientY: box.top + top / ratio, bubbles: true, cancelable: true };
      };
      const press = (key) => document.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
    """
    look = """
      const [x, y] = [camera.x + 10.5 * camera.scale * page.pixelAspect, camera.y + 40.5 * camera.scale];
      const around = context.getImageData(Math.floor(x) - 10, Math.floor(y) - 10, 21, 21).data;
      document.body.dataset.around = Array.from(around).join(" ");
    """
    copy = tmp_path / "acted.html"
    # The page decodes and paints in the background.
    code = f"{helpers} setTimeout(() => {{ {script} setTimeout(() => {{ {look} }}, 1000); }}, 1000);"
    html = page.read_text(encoding="utf-8").replace("</body>", f"<script>{code}</script></body>")
    copy.write_text(html, encoding="utf-8")
    page = dump_dom(f"{copy.as_uri()}#{urlencode(wanted)}")
    codes = re.search(r'data-around="([\d ]+)"', page)[1].split()
    return np.array(codes, int).reshape(21, 21, 4)[..., :3]


@needs_browser
def test_the_wheel_zooms_around_the_cursor(page, tmp_path):
    """Enlarged pixels keep their edges: after zooming, one pixel fills what several did."""
    light = (1.1 * LIGHT_1 + LIGHT_2)[40, 10]
    before, after = (
        act(page, script, tmp_path, layer="beauty", left=1, wipe=1)
        for script in ("", 'stage.dispatchEvent(new WheelEvent("wheel", { ...at(10.5, 40.5), deltaY: -600 }));')
    )
    assert (before[10, 10] == after[10, 10]).all() and np.ptp(before, axis=(0, 1)).any()
    assert not np.ptp(after, axis=(0, 1)).any()
    assert_shows(after[10, 10], light)


@needs_browser
def test_dragging_the_line_wipes_and_keys_change_the_exposure(page, tmp_path):
    drag = """
      const line = (share) => at((share * screen.width - camera.x) / (camera.scale * page.pixelAspect), 5);
      const send = (type, share) => stage.dispatchEvent(new PointerEvent(type, { ...line(share), pointerId: 1 }));
      send("pointerdown", 1);
      send("pointermove", 0.01);
      send("pointerup", 0.01);
      press("+");
      press("+");
    """
    shown = act(page, drag, tmp_path, layer="light_1", left=1, right=REF + 1, wipe=1)
    assert_shows(shown[10, 10], LIGHT_1[40, 10], 1)


@needs_browser
def test_the_browser_shows_the_lrhs_with_its_own_pixels(page):
    screen, *_ = look(page, layer="light_1", left=LR + 1, wipe=1, at="11,23")
    assert_shows(screen, downsample(LIGHT_1, 4)[5, 2])


@needs_browser
def test_the_browser_shows_error_maps(page):
    """They come after the four pictures; exposure does not change them."""
    screen, *_ = look(page, layer="light_1", left=5, wipe=1, exposure=3, at="30,20")
    expected = 255 * error_colours(error_levels(1.1 * LIGHT_1, LIGHT_1))[20, 30]
    np.testing.assert_allclose(screen, expected, atol=4)  # of 64 levels
    assert expected.max() > 100


@needs_browser
def test_the_browser_says_which_layer_a_picture_lacks(page):
    texts = look(page, layer="light_2", left=LR + 1, right=7, at="0,0")[2]
    assert texts["missing-left"] == texts["missing-right"] == "lr.exr has no layer light_2"
    texts = look(page, layer="Z", left=HR + 1, right=6, at="0,0")[2]
    assert texts["missing-left"] == "" and texts["missing-right"] == "ref.exr has no layer Z"


@needs_browser
def test_the_browser_shows_data_from_black_to_white(page):
    screen, values, _ = look(page, layer="Z", left=HR + 1, wipe=1, at="30,20")
    lowest, highest = manifest(page)["layers"][3]["range"]
    assert values["left"] == [pytest.approx(4, rel=0.01)]
    assert_shows(screen, [(4 - lowest) / (highest - lowest)] * 3)


@needs_browser
def test_names_out_of_files_are_texts(tmp_path):
    """Markup in a layer's name does nothing."""
    name = "</script><h1>light_1"
    channels = rgb(picture(16, 16)) | rgb(picture(16, 16), f"{name}.")
    write_exr(tmp_path / "a.exr", channels, compression=OpenEXR.ZIP_COMPRESSION)
    write_page(tmp_path / "page.html", open_comparison([tmp_path / "a.exr"]), layers=["*"])
    html = dump_dom((tmp_path / "page.html").as_uri())
    assert "<h1>" not in html.split('id="manifest"')[0]
    assert "&lt;/script&gt;&lt;h1&gt;light_1</option>" in html


def test_the_page_tells_no_paths(tmp_path):
    """Of files with one name, the folders tell them apart."""
    for folder in ("secret/one", "secret/two"):
        (tmp_path / folder).mkdir(parents=True)
        write_exr(tmp_path / folder / "out.exr", rgb(picture(16, 16)))
    paths = [tmp_path / "secret" / name / "out.exr" for name in ("one", "two")]
    write_page(tmp_path / "page.html", open_comparison(paths, None, None))
    text = (tmp_path / "page.html").read_text()
    assert '"one/out.exr", "two/out.exr"' in text and "secret" not in text
