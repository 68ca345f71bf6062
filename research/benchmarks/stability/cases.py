# SPDX-License-Identifier: Apache-2.0
"""Make pairs from analytic scenes, and the cases: what can go wrong with a pair, one function for each group."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, DIFFUSE, NORMAL, OPTIONAL_FEATURES, RGB, SPECULAR, VARIANCE
from oiio_msspl.exr.render import Render
from oiio_msspl.image.arrays import Array
from oiio_msspl.model.encoding import MAX_RADIANCE
from research.benchmarks.stability import analytic

#: The group in which both renders show different things, by a mistake of the user.
DISAGREE = "LRHS and HRLS disagree"


@dataclass(frozen=True, eq=False)
class Pair:
    """An LRHS, an HRLS and the reference (h, w, 3)."""

    lr: Render
    hr: Render
    reference: Array

    @property
    def scale(self) -> int:
        return self.hr.data_window.width // self.lr.data_window.width


@dataclass(frozen=True, eq=False)
class Base:
    """An analytic scene that gives pairs of any scale and spp."""

    name: str
    scene: analytic.Scene

    @cache  # noqa: B019 - undisturbed results are kept by pair, so equal arguments must give the same object
    def pair(
        self,
        scale: int,
        hr_spp: int = 1,
        lr_spp: int | None = None,
        lr_filter: analytic.Footprint | None = None,
        hr_filter: analytic.Footprint | None = None,
        lr_scene: analytic.Scene | None = None,
    ) -> Pair:
        """Render a pair.

        Args:
            lr_spp: spp of the LRHS; by default one for every HRLS pixel.
            lr_filter: pixel filter of the LRHS; by default a box, as that of the HRLS.
            lr_scene: what the LRHS shows, if it is another scene.
        """
        low_noise, high_noise = seeded(self.name, "LRHS", scale), seeded(self.name, "HRLS")
        low_scene, low_spp = lr_scene or self.scene, lr_spp or scale**2
        low = analytic.render(low_scene, low_spp, low_noise, footprint=lr_filter, scale=scale)
        high = analytic.render(self.scene, hr_spp, high_noise, footprint=hr_filter)
        return Pair(low, high, analytic.reference(self.scene, hr_filter))


def seeded(*key: object) -> np.random.Generator:
    """Return a random generator that is different for every key and the same in every run."""
    return np.random.default_rng(zlib.crc32(repr(key).encode()))


@cache
def room(size: int) -> Base:
    """Return the scene that most groups disturb."""
    return Base("room", analytic.room(size))


@dataclass(frozen=True, eq=False)
class Case:
    name: str
    pair: Pair
    clean: Pair | None = None
    """The pair before it was disturbed; None for a scene that is hard as it is."""
    factor: float = 1.0
    """The result should be the one for ``clean``, times this."""


def changed(render: Render, **layers: Array | None) -> Render:
    """Return a render with other layers; None removes one."""
    return Render.from_arrays(render.name, **{k: v for k, v in {**render.layers, **layers}.items() if v is not None})


def with_layers(pair: Pair, **layers: Array | None) -> Pair:
    """Return a pair whose HRLS has other layers; None removes one."""
    return replace(pair, hr=changed(pair.hr, **layers))


def scaled(pair: Pair, factor: float) -> Pair:
    """Return a pair with all light multiplied by a factor."""
    powers = dict.fromkeys((RGB, DIFFUSE, SPECULAR), 1) | {VARIANCE: 2}
    factors = {name: np.float32(factor**power) for name, power in powers.items()}

    def bright(render: Render) -> Render:
        return changed(render, **{k: v * factors[k] for k, v in render.layers.items() if k in factors})

    return Pair(bright(pair.lr), bright(pair.hr), pair.reference * np.float32(factor))


def with_pixels(render: Render, value: float, share: float, layers: tuple[str, ...] = (RGB,)) -> Render:
    """Set a share of the pixels, at least one and none at the border, to a value in some layers."""
    height, width = render.layers[RGB].shape[:2]
    rng = seeded("pixels", value, share, height)
    count = max(1, round(share * height * width))
    rows, columns = rng.integers(2, height - 2, count), rng.integers(2, width - 2, count)
    result = {}
    for name in layers:
        if name in render.layers:
            result[name] = render.layers[name].copy()
            result[name][rows, columns] = value
    return changed(render, **result)


def fireflies(size: int, scale: int) -> Iterator[Case]:
    clean = room(size).pair(scale)
    for value in (1e3, 1e6):
        hot = value * float(clean.reference.mean())
        lobes = (RGB, SPECULAR)
        hr, lr = with_pixels(clean.hr, hot, 1e-3, lobes), with_pixels(clean.lr, hot, 1e-3)
        times = f"{value:.0e}".replace("e+0", "e")
        yield Case(f"0.1 % of the HRLS, {times} times the mean", replace(clean, hr=hr), clean)
        yield Case(f"0.1 % of the LRHS, {times} times the mean", replace(clean, lr=lr), clean)


def broken_values(size: int, scale: int) -> Iterator[Case]:
    clean = room(size).pair(scale)
    every = (RGB, *OPTIONAL_FEATURES)
    for name, value in (("NaN", np.nan), ("Inf", np.inf), ("-Inf", -np.inf), ("-1", -1.0)):
        hr = with_pixels(clean.hr, value, 1e-3, every)
        yield Case(f"{name} in 0.1 % of the HRLS, all layers", replace(clean, hr=hr), clean)
    for name, value in (("NaN", np.nan), ("Inf", np.inf)):
        yield Case(f"{name} in 0.1 % of the LRHS", replace(clean, lr=with_pixels(clean.lr, value, 1e-3)), clean)
    holed = {k: v.copy() for k, v in clean.hr.layers.items()}
    height = clean.hr.data_window.height
    for values in holed.values():
        values[height // 4 : height // 4 + height // 8, height // 2 : height // 2 + height // 8] = np.nan
    yield Case("a bucket of the HRLS all NaN", with_layers(clean, **holed), clean)


def exposure(size: int, scale: int) -> Iterator[Case]:
    clean = room(size).pair(scale)
    for stops in (-10, -5, 5, 10):
        yield Case(f"2^{stops}", scaled(clean, 2.0**stops), clean, factor=2.0**stops)


def hot_pixel(size: int, scale: int) -> Iterator[Case]:
    """Yield pairs with one bright pixel. In ``clean`` it is one pixel further left."""
    clean = room(size).pair(scale)
    value = 1e4 * float(clean.reference.mean())

    def at(render: Render, column: int) -> Render:
        rgb = render.layers[RGB].copy()
        rgb[rgb.shape[0] // 3, column] = value
        return changed(render, rgb=rgb)

    middle = clean.hr.data_window.width // 2
    right, left = (replace(clean, hr=at(clean.hr, middle + step)) for step in (1, 0))
    yield Case("in the HRLS, moved by one pixel", right, left)
    right, left = (replace(clean, lr=at(clean.lr, middle // scale + step)) for step in (1, 0))
    yield Case("in the LRHS, moved by one pixel", right, left)


def layers(size: int, scale: int) -> Iterator[Case]:
    clean = room(size).pair(scale, 4)  # 4 spp: with 1 there is no variance to remove
    for name in OPTIONAL_FEATURES:
        yield Case(f"no {name}", with_layers(clean, **{name: None}), clean)
    yield Case("none at all", with_layers(clean, **dict.fromkeys(OPTIONAL_FEATURES)), clean)


def garbage(size: int, scale: int) -> Iterator[Case]:
    clean = room(size).pair(scale, 4)
    have = clean.hr.layers
    rng = seeded("garbage")
    noise = rng.random(have[RGB].shape, dtype=np.float32)
    turned = {k: np.ascontiguousarray(have[k][::-1, ::-1]) for k in (ALBEDO, NORMAL)}
    for name, layers in {
        "albedo of noise": {ALBEDO: noise},
        "normal of noise": {NORMAL: 2 * noise - 1},
        "albedo and normal exchanged": {ALBEDO: have[NORMAL], NORMAL: have[ALBEDO]},
        "albedo and normal of another frame": turned,
        "albedo and normal 0": {k: np.zeros_like(noise) for k in turned},
        "albedo 1000 times too large": {ALBEDO: have[ALBEDO] * 1000},
        "diffuse and specular of noise": {DIFFUSE: noise, SPECULAR: noise[::-1]},
        "every layer of noise": {k: rng.random(have[k].shape, dtype=np.float32) for k in OPTIONAL_FEATURES},
    }.items():
        yield Case(name, with_layers(clean, **layers), clean)


def variance(size: int, scale: int) -> Iterator[Case]:
    clean = room(size).pair(scale, 4)
    true = clean.hr.layers[VARIANCE]
    for name, values in {
        "constant": np.full_like(true, true.mean()),
        "0 everywhere": np.zeros_like(true),
        "10000 times too large": true * 1e4,
        "10000 times too small": true * 1e-4,
        "of another frame": np.ascontiguousarray(true[::-1, ::-1]),
    }.items():
        yield Case(name, with_layers(clean, variance=values), clean)


def unusual_spp(size: int, scale: int) -> Iterator[Case]:
    clean = room(size).pair(scale)
    for name, hr_spp, lr_spp in (
        ("LRHS 2", 1, 2),
        ("HRLS 8, LRHS 2", 8, 2),
        ("HRLS 64", 64, None),
        ("HRLS 64, LRHS 2", 64, 2),
        ("LRHS 1024", 1, 1024),
    ):
        yield Case(name, room(size).pair(scale, hr_spp, lr_spp), clean)


def footprints(size: int, scale: int) -> Iterator[Case]:
    base = room(size)
    yield Case("point: nearest-neighbour LRHS", base.pair(scale, lr_filter=analytic.point(scale)), base.pair(scale))


def overflow(size: int, scale: int) -> Iterator[Case]:
    """Yield light beyond 65504, the largest half float."""
    clean = room(size).pair(scale)
    bright = scaled(clean, 4 * MAX_RADIANCE / float(np.quantile(clean.reference, 0.999)))

    def stored(render: Render) -> Render:
        return changed(render, **{k: v.astype(np.float16).astype(np.float32) for k, v in render.layers.items()})

    # The largest value that such a file can hold
    bright = replace(bright, reference=np.minimum(bright.reference, MAX_RADIANCE))
    with np.errstate(over="ignore"):
        held = replace(bright, lr=stored(bright.lr), hr=stored(bright.hr))
    yield Case("a frame that reaches 4 times the largest half", held, bright)


def hard(*scenes: tuple[str, str, Callable[[int], analytic.Scene]]) -> Callable[[int, int], Iterator[Case]]:
    """Return the cases of scenes that are hard as they are: a name, a name that the noise follows from, the scene."""

    def cases(size: int, scale: int) -> Iterator[Case]:
        for name, base, scene in scenes:
            yield Case(name, Base(base, scene(size)).pair(scale))

    return cases


def rare_light(size: int, scale: int) -> Iterator[Case]:
    """Yield scenes where a bound to the brightest sample around makes holes: often no sample around is lit."""
    for samples in (20, 50):
        made = Base(f"door ajar {samples}", analytic.door_ajar(size, 1 / samples))
        yield Case(f"a room lit through a door ajar: 1 sample of {samples} is lit", made.pair(scale))
    yield Case("a lamp seen through a slit", Base("slit", analytic.slit(size, 100.0)).pair(scale))
    dim = Base("dark room", analytic.dark_room(size))
    yield Case("a dark room at 1 spp", dim.pair(scale))
    yield Case("a dark room, 1 spp in both", dim.pair(scale, 1, 1))


def filters(size: int, scale: int) -> Iterator[Case]:
    base = room(size)
    clean = base.pair(scale)
    wide, low = analytic.blackman_harris(), analytic.blackman_harris(scale)
    yield Case("Blackman-Harris in both", base.pair(scale, hr_filter=wide, lr_filter=low), clean)
    yield Case("Blackman-Harris LRHS, box HRLS", base.pair(scale, lr_filter=low), clean)
    yield Case("box LRHS, Blackman-Harris HRLS", base.pair(scale, hr_filter=wide), clean)


def disagreement(size: int, scale: int) -> Iterator[Case]:
    """Yield pairs whose HRLS is right and whose LRHS shows something else."""
    base = room(size)
    clean = base.pair(scale)
    hairs = analytic.hairy(size)
    assert hairs.front is not None and hairs.coverage is not None
    stranger = analytic.Scene(*(part[::-1, ::-1] for part in (hairs.back, hairs.front, hairs.coverage)))
    yield Case("another scene", base.pair(scale, lr_scene=stranger), clean)
    ball = analytic.room(size, ball=(0.41, 0.5))
    yield Case("another frame: the ball 6 % further", base.pair(scale, lr_scene=ball), clean)
    for factor in (0.25, 0.67, 1.5, 4.0):
        lr = changed(clean.lr, rgb=clean.lr.layers[RGB] * np.float32(factor))
        yield Case(f"LRHS {factor:g} times as bright", replace(clean, lr=lr), clean)
    for pixels in sorted({1, 2, 3, scale, 2 * scale, 3 * scale}):
        moved = analytic.moved(base.scene, pixels, pixels)
        unit = f"{pixels} HRLS pixel{'s' * (pixels > 1)}"
        yield Case(f"shifted by {unit}, x and y", base.pair(scale, lr_scene=moved), clean)


RARE = "1 sample of 200 finds the light"
GROUPS: dict[str, Callable[[int, int], Iterator[Case]]] = {
    "fireflies": fireflies,
    "NaN, Inf, negative": broken_values,
    "exposure": exposure,
    "a hot pixel moves": hot_pixel,
    "missing layers": layers,
    "garbage layers": garbage,
    "wrong variance": variance,
    "spp outside training": unusual_spp,
    "pixel footprint": footprints,
    "16-bit overflow": overflow,
    "lights and emitters": hard(
        ("small lights up to 1e2", "lights 100.0", partial(analytic.small_lights, radiance=1e2)),
        ("small lights up to 1e4", "lights 10000.0", partial(analytic.small_lights, radiance=1e4)),
        ("small lights up to 1e6", "lights 1000000.0", partial(analytic.small_lights, radiance=1e6)),
        ("visible emitters, one behind a grille", "emitters", analytic.emitters),
    ),
    "near-black": hard(
        (RARE, "near black", analytic.near_black),
        (f"{RARE}, traces of 1e-3 to 1e-40 elsewhere", "near black", partial(analytic.near_black, traces=1e-3)),
    ),
    "rare light": rare_light,
    "pixel filter": filters,
    "depth of field, motion blur": hard(
        ("depth of field", "depth of field", analytic.defocused), ("motion blur", "motion blur", analytic.moving)
    ),
    "hair, glass": hard(
        ("hairs of 0.1 to 0.8 pixels", "hairs", analytic.hairy),
        ("glass that no layer sees through", "glass", analytic.glassy),
    ),
    DISAGREE: disagreement,
}
"""A group's name -> its cases, by the side of the frame in pixels and the scale."""
