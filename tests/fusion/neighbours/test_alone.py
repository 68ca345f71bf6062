# SPDX-License-Identifier: Apache-2.0
"""What stands alone among averages of frames has the pixels that it would have without neighbours."""

import itertools

import numpy as np
import pytest

from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.fuse import fuse
from oiio_msspl.fusion.neighbours.alone import _boxes, fuse_alone
from oiio_msspl.fusion.neighbours.renders import RenderPair
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.session import Session
from tests.fusion.motion.moving_texture import texture

#: Rows and columns of the HRLS that no neighbour counts in, of a frame of 96 x 144 pixels.
OBJECT = np.s_[32:64, 48:96]
FAR = np.s_[:24]


def pair_of(scale, samples, seed):
    """A pair whose HRLS pixels are means of so many samples, (h, w, 1)."""
    rng, truth = np.random.default_rng(seed), texture()
    alpha = np.full_like(truth[..., :1], 0.5)
    layers = {"rgb": truth, "alpha": alpha, "albedo": truth, "normal": np.full_like(truth, 0.5)}
    noise = [(1 + rng.normal(0, 1, truth.shape) / np.sqrt(samples)).astype(np.float32) for _ in range(2)]
    high = {name: image * noise[0][..., :1] if name in ("rgb", "alpha") else image for name, image in layers.items()}
    low = {name: image * noise[1][..., :1] if name in ("rgb", "alpha") else image for name, image in layers.items()}
    low = {name: box_downsample(image, scale) for name, image in low.items()}
    return RenderPair(Render.from_arrays("low", **low), Render.from_arrays("high", **high))


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_an_object_that_stands_alone_has_the_pixels_of_a_single_frame(scale):
    session = Session(find_model(scale, "fast"))
    frames = np.full((*texture().shape[:2], 1), 9, np.float32)
    frames[OBJECT] = 1
    own = pair_of(scale, np.ones_like(frames), 1)
    averaged = pair_of(scale, frames, 1)  # has the pixels of ``own`` where frames is 1
    alone = fuse(own.lr, own.hr, session, error=True, share=0.5)
    frame = fuse(averaged.lr, averaged.hr, session, error=True, share=0.5)
    before, frame.frames = {name: getattr(frame, name).copy() for name in ("rgb", "alpha", "error", "trust")}, frames
    fuse_alone(own, frame, session, share=0.5)
    for name in ("rgb", "alpha", "error"):
        after, single = getattr(frame, name), getattr(alone, name)
        np.testing.assert_allclose(after[OBJECT], single[OBJECT], atol=0.02)
        assert (after[FAR] == before[name][FAR]).all()
    assert np.abs(before["rgb"][OBJECT] - alone.rgb[OBJECT]).max() > 0.05
    inside = tuple(slice(part.start // scale, part.stop // scale) for part in OBJECT)
    np.testing.assert_allclose(frame.trust[inside], alone.trust[inside], atol=0.05)


def test_single_pixels_and_whole_frames_that_stand_alone_are_not_fused_again(monkeypatch):
    session = Session(find_model(2, "fast"))
    pair = pair_of(2, 1.0, 1)
    frame = fuse(pair.lr, pair.hr, session)
    runs = []
    monkeypatch.setattr(session, "run", lambda *args, **kwargs: runs.append(args))
    for value, part in ((9, np.s_[40:42, 50:52]), (1, FAR)):
        frame.frames = np.full((*texture().shape[:2], 1), value, np.float32)
        frame.frames[part] = 1
        fuse_alone(pair, frame, session)
    frame.frames = None
    fuse_alone(pair, frame, session)
    assert not runs


def test_boxes_hold_all_places_and_lie_apart():
    rng = np.random.default_rng(3)
    places = np.zeros((300, 500), bool)
    for y, x in zip(rng.integers(0, 290, 12), rng.integers(0, 490, 12), strict=True):
        places[y : y + 7, x : x + 5] = True
    boxes = list(_boxes(places, gap=20))
    held = np.zeros_like(places)
    for box in boxes:
        assert places[box.y0 : box.y1, box.x0 : box.x1].any()
        held[box.y0 : box.y1, box.x0 : box.x1] = True
    assert (held >= places).all()
    assert len(boxes) > 6
    for first, second in itertools.combinations(boxes, 2):
        columns = max(first.x0, second.x0) - min(first.x1, second.x1)
        rows = max(first.y0, second.y0) - min(first.y1, second.y1)
        assert max(columns, rows) > 20
