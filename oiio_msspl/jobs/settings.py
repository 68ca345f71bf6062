# SPDX-License-Identifier: Apache-2.0
"""What the user has chosen for a job: inputs, output, model and memory. A model that is not named suits the pair."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender, ReadableRender
from oiio_msspl.errors import InputError
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.checks.noise import (
    CLEAN_AOVS,
    CLEAN_AOVS_OF_PAIR,
    has_clean_aovs,
    has_little_noise,
    has_little_spread_noise,
    is_noise_spread,
)
from oiio_msspl.fusion.neighbours.renders import RenderPair
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.model.catalogue import (
    DEFAULT_QUALITY,
    QUALITIES,
    family_of,
    for_little_noise,
    for_spread_noise,
    load_model,
)
from oiio_msspl.model.contract import CLEAN, ONE_SIZE, SPREAD
from oiio_msspl.model.session import Session

#: What notes say of noise, by the ending of the family that suits it.
NOISE = {
    SPREAD: "the pixel filter has spread the noise over neighbouring pixels",
    CLEAN: "there is little noise",
    SPREAD + CLEAN: "the pixel filter has spread the little noise there is over neighbouring pixels",
}


@dataclass(frozen=True)
class Settings:
    """The settings of :func:`oiio_msspl.jobs.shot.fuse_shot`, and the models that are loaded for them."""

    inputs: InputOptions = InputOptions()
    write: WriteOptions = WriteOptions()
    model: str | None = None
    device: str = "cpu"
    threads: int = 0
    max_memory: int = MAX_MEMORY
    view_transform: str | None = None
    overwrite: bool = False
    """Replace every result that exists."""
    skip_existing: bool = False
    """Leave frames alone whose EXR exists."""
    update: bool = False
    """Of these, fuse those again whose inputs are newer than their EXR."""
    strict: bool = False
    """Refuse a frame that has a warning, and write nothing."""
    sessions: dict[tuple[int, str | None], Session] = field(default_factory=dict)
    """Models that are loaded, by scale and ``model``."""

    def session(self, scale: int) -> Session:
        """Return the model for a scale. Each model is loaded once.

        Raises:
            InputError: there is no such model, the device can't be used, or the model does not make a layer that is
                asked for.
        """
        session = self.sessions.get((scale, self.model))
        if session is None:
            session = self.sessions[scale, self.model] = load_model(scale, self.model, self.device, self.threads)
        if self.write.error_layer:
            session.require_error()
        if self.write.data_passes:
            session.require_clean_aovs()
        return session


def bytes_of(size: int | str) -> int:
    """Return the number of bytes that ``3G``, ``800M`` or a number means."""
    if isinstance(size, int):
        return size
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?", size.strip(), re.IGNORECASE)
    if not match:
        raise InputError(f"--max-memory {size!r}: write it as 3G or 800M")
    number = float(match[1]) * 1024 ** " KMGT".index(match[2].upper() or " ")
    return int(min(number, 1 << 62))  # a slip may be infinite as a float


def choose_model(
    lr: MappedRender,
    hr: MappedRender,
    model: str | None,
    read: Callable[[], RenderPair] | None = None,
    *,
    error: bool = False,
) -> tuple[str, bool]:
    """Return the model to use, and whether the pair has noise that decides it: a black frame has none.

    For a quality, ``auto`` and None, the model is a family that suits the pair. ``best`` gains nothing without an
    albedo and a normal, and the default quality replaces it. Then :func:`family_for_noise` decides. Notes of the HRLS
    say so, and if a model that is named does not suit the noise.

    ``read`` gives the pair in memory; without it, small samples of the files are looked at. With ``error``, the model
    must predict its error.
    """
    alignment = align(lr, hr)

    def renders() -> tuple[ReadableRender, ReadableRender]:
        pair = RenderPair(lr, hr) if read is None else read()
        return pair.lr, pair.hr

    family = family_of(model)
    if family is None:
        assert model is not None
        suited = for_spread_noise(model)
        spread = suited is not None and is_noise_spread(*renders(), alignment)
        if spread:
            hr.notes.append(f"{NOISE[SPREAD]}, and {model} leaves such noise; use --model {suited}")
        return model, spread is not None
    suited = family_for_layers(hr, family)
    if suited != family:
        family = suited
        hr.notes.append(f"without an albedo and a normal, the quality best gains nothing, so the model is {family}")
    family, noise = family_for_noise(family, *renders(), alignment, error=error)
    if noise:
        hr.notes.append(f"{NOISE[noise]}, so the model is {family}")
    return family, noise is not None


def family_for_noise(
    family: str, lr: ReadableRender, hr: ReadableRender, alignment: Alignment, *, error: bool = False
) -> tuple[str, str | None]:
    """Return the counterpart of a family that suits the noise of a pair, and the kind of noise.

    It is a key of ``NOISE``; "" for noise that needs no counterpart, and None without noise. Noise that the pixel
    filter has spread needs weights of its own, unless there is less of it in renders of one size. Where there is little
    noise, a denoiser of the HRLS at full size is more accurate, which the LRHS only corrects; it predicts no ``error``.
    If noise is not spread, it needs a clean albedo and normal, except that of ``best`` for renders of one size, which
    denoises them before.
    """
    spread, scale = is_noise_spread(lr, hr, alignment), alignment.scale
    little, less = has_little_spread_noise(lr, hr, alignment) if spread else (False, False)
    kind = SPREAD if spread and not less else ""
    clean = None if error else for_little_noise(family + kind, scale)
    denoises_aovs = family == QUALITIES["best"]
    if clean and (little if spread else has_little_noise(lr, hr, alignment, denoises_aovs=denoises_aovs)):
        least = CLEAN_AOVS if scale == ONE_SIZE else CLEAN_AOVS_OF_PAIR
        if spread or (denoises_aovs and scale == ONE_SIZE) or has_clean_aovs(hr, alignment, least):
            return clean, kind + CLEAN
    return family + kind, None if spread is None else kind


def family_for_layers(hr: MappedRender, family: str) -> str:
    """Return the family; the default quality's in place of that of ``best`` for an HRLS without albedo and normal."""
    lacks = family == QUALITIES["best"] and hr.features.keys().isdisjoint((ALBEDO, NORMAL))
    return QUALITIES[DEFAULT_QUALITY] if lacks else family
