# SPDX-License-Identifier: Apache-2.0
"""Inspect a render: what the file holds, and which of its layers a model would read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.aovs.features import NORMAL, RADIANCE_FEATURES, RGB
from oiio_msspl.aovs.mapped_render import ROWS_PER_LOAD, MappedRender
from oiio_msspl.aovs.motion import user_fields
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import layers_of
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.findings import Finding, as_data
from oiio_msspl.fusion.checks.noise import is_noise_spread
from oiio_msspl.fusion.motion.source import MotionSource, find_motion
from oiio_msspl.fusion.passes.sums import check_sum
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.jobs.advice import advise
from oiio_msspl.jobs.inputs import InputOptions, map_hrls, map_other_hrls
from oiio_msspl.jobs.sequence import is_sequence, next_file
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.contract import SCALES, Contract


@dataclass
class Inspection:
    """Result of :func:`inspect_file`."""

    path: Path
    file: ExrFile | None = None
    """None if the headers can't be read."""
    render: MappedRender | None = None
    """The first view, or the requested one; None if the layers can't be mapped."""
    other_views: list[MappedRender] = field(default_factory=list)
    """The remaining views and view layers, unless one is requested."""
    contract: Contract | None = None
    """Contract of the model that would read the file."""
    facts: list[str] = field(default_factory=list)
    """Facts about the file, one line each."""
    motion: MotionSource | None = None
    """Source of the movement to the next frame; None if the next frame does not lie beside this one."""
    noise: str | None = None
    """``independent`` or ``spread`` over neighbouring pixels, by :func:`inspect_noise`; None if it is unknown."""
    advice: list[Finding] = field(default_factory=list)
    """What more would help, and what it costs, by :func:`inspect_noise`."""
    problems: list[str] = field(default_factory=list)
    """Reasons why the file can't be used, one sentence each; empty if it can."""

    @property
    def model(self) -> str:
        """Family of the model that would read the file, such as ``joint``."""
        return self.contract.name.removesuffix(f"-x{self.contract.scale}") if self.contract else ""

    def aovs(self, view: MappedRender | None = None) -> list[dict[str, str]]:
        """List the layers of ``render``, or of one of ``other_views``, that the model would read.

        Returns rows of ``MappedRender.table``.
        """
        render = view or self.render
        assert render is not None and self.contract is not None
        return render.table(render.features_read(self.contract.hrls, alone=True))

    @property
    def layers(self) -> list[dict[str, str]]:
        """All layers of the file: rows with ``layer``, ``view``, ``channels``, ``type`` and ``part``."""
        if self.file is None:
            return []
        rows = []
        for layer in layers_of(self.file, deep=True):
            channels = list(layer.channels.values())
            parts = dict.fromkeys(self.file.parts[channel.part] for channel in channels)
            rows.append({
                "layer": layer.name or "(unnamed)",
                "view": layer.view,
                "channels": " ".join(layer.channels),
                "type": "/".join(sorted({channel.type for channel in channels})),
                "part": ", ".join((part.name or "unnamed") + " (deep)" * part.deep for part in parts),
            })  # fmt: skip
        return rows

    def as_dict(self) -> dict[str, Any]:
        """Return the inspection as JSON values."""
        result: dict[str, Any] = {"file": str(self.path), "usable": not self.problems}
        result |= {"problems": self.problems, "facts": self.facts}
        if self.file is not None:
            result |= {
                "display_window": str(self.file.display_window),
                "pixel_aspect": self.file.pixel_aspect,
                "layers": self.layers,
                "parts": [
                    {
                        "name": part.name,
                        "view": part.view,
                        "data_window": str(part.data_window),
                        "compression": part.compression,
                        "tiled": part.tile != (0, 0),
                        "deep": part.deep,
                        "channels": {c.name: c.type for c in part.channels},
                    }
                    for part in self.file.parts
                ],
            }
        if self.render is not None:
            result |= {
                "renderer": self.render.renderer,
                "view": self.render.view or None,
                "other_views": self.render.other_views,
                "views": [{"view": view.view or None, "aovs": self.aovs(view)} for view in self.other_views],
                "spp": self.render.spp,
                "model": self.model,
                "aovs": self.aovs(),
                "notes": self.render.notes,
                "motion_layers": {vectors.name: str(vectors.format) for vectors in self.render.motion.fields},
                "noise": self.noise,
                "advice": [as_data(text) for text in self.advice],
                "motion": {"kind": self.motion.kind, "text": self.motion.text} if self.motion else None,
            }
        return result


def inspect_file(
    path: Path, inputs: InputOptions, model: str | None = None, motion_format: str | None = None
) -> Inspection:
    """Open a file, map its layers and read all pixels of its features once.

    If the next frame lies beside the file, the two verify the motion vectors.

    Args:
        path: an EXR.
        inputs: the mapping of its layers; ``hr_spp`` says the samples per pixel.
        model: the model that would read it, see :func:`oiio_msspl.model.catalogue.find_model`. The models of a family
            read equal features at every scale.
        motion_format: the user's description of motion vectors, see :func:`oiio_msspl.aovs.motion.user_fields`.

    Returns:
        The inspection; ``problems`` says why a file can't be used.

    Raises:
        InputError: the model is unknown.
    """
    contract = Contract.of_file(find_model(SCALES[0], model))
    result = Inspection(path, contract=contract)
    try:
        if is_sequence(path) and not path.is_dir():
            raise InputError(f"{path}: is a pattern; name one of its files, and the next frame is found beside it")
        file = result.file = open_exr(path)
        result.facts = _facts(file)
        render = map_hrls(file, inputs)
        render = result.render = render.for_model(render.features_read(contract.hrls, alone=True))
        result.facts.append(_renderer_fact(render))
        result.facts += [*_pixel_facts(render), *_facts_of_sets(render)]
        for label in render.other_views if inputs.view is None else ():
            try:
                view = map_other_hrls(render, label, inputs).for_model(contract.hrls)
                facts = [*_pixel_facts(view), *_facts_of_sets(view)]
                result.other_views.append(view)
            except InputError as error:
                facts = [f"can't be fused: {str(error).removeprefix(f'{path}: ')}"]
            result.facts += [f"{name_of(label)}: {fact}" for fact in facts]
        _inspect_motion(result, render, inputs, motion_format)
    except InputError as error:
        result.problems.append(str(error).removeprefix(f"{path}: "))
    if result.file is not None:
        result.file.close()  # there may be thousands of files
    return result


def inspect_noise(inspections: Sequence[Inspection]) -> None:
    """Add to a render, or to the larger of a frame's two, whether the pixel filter has spread the noise, and advice.

    Nothing is added if there are more files, or the two are no pair.
    """
    renders = [(inspection.render, inspection) for inspection in inspections if inspection.render is not None]
    if len(renders) not in (1, 2) or len(renders) < len(inspections):
        return
    pair = sorted(2 * renders if len(renders) == 1 else renders, key=lambda item: item[0].display_window.width)
    (lr, low), (hr, high) = pair
    try:
        spread = is_noise_spread(lr, hr, align(lr, hr))
        high.advice = advise(lr, hr, spread, in_shot=next_file(high.path) is not None)
    except InputError:
        return
    if spread is None:
        return
    high.noise = "spread" if spread else "independent"
    text = "the pixel filter has spread it over neighbouring pixels" if spread else "independent in each pixel"
    compared = "" if low is high else f", compared with {low.path.name}"
    high.facts.append(f"noise{compared}: {text}")


def _facts_of_sets(render: MappedRender) -> list[str]:
    return [f"{each.name} ({each.layer_names}): {check_sum(render, each).text}" for each in render.additive_sets]


def _inspect_motion(result: Inspection, render: MappedRender, inputs: InputOptions, motion_format: str | None) -> None:
    """Find the layers of motion vectors, and verify them with the next frame if it exists."""
    path = next_file(result.path)
    if path is None:
        if render.motion.fields:
            layers = " and ".join(f"{vectors.name} ({vectors.format})" for vectors in render.motion.fields)
            result.facts.append(f"motion: {layers} expected; the next frame beside this one would verify it")
        elif guesses := ", ".join(field.name for field in render.motion.guesses):
            result.facts.append(f"motion: {guesses} may hold vectors; the next frame beside this one would tell")
        return
    if motion_format:
        user_fields(render.motion, motion_format, render.name)
    following = None
    try:
        following = map_hrls(open_exr(path), inputs)
        result.motion = find_motion(render, following, motion_format)
    except InputError as error:
        if following and not str(error).startswith(tuple(f"{file}: " for file in (path, *following.file.siblings))):
            raise  # the error is about this frame, or about the format
        # The next frame may still be rendered.
        result.facts.append(f"motion: not verified, because the next frame can't be read: {error}")
    else:
        result.facts.append(f"motion, checked with {path.name}: {result.motion.text}")


def _renderer_fact(render: MappedRender) -> str:
    spp = "unknown spp" if render.spp is None else f"{render.spp:g} spp"
    others = f"; also {', '.join(map(name_of, render.other_views))}" if render.other_views else ""
    view = f", {render.view}" if render.view else ""
    return f"renderer: {render.renderer}, {spp}{view}{others}"


def _facts(file: ExrFile) -> list[str]:
    """Describe the windows, and the types and storage of the parts; parts that are alike share a line."""
    aspect = "" if file.pixel_aspect == 1 else f", pixel aspect {file.pixel_aspect:g}"
    facts = [f"display window {file.display_window}{aspect}"]
    if made := {key.removeprefix("msspl/"): value for key, value in file.metadata.items() if key.startswith("msspl/")}:
        renders = " and ".join(str(made[name]) for name in ("lrhs", "hrls") if name in made)
        facts.append(
            f"a result, fused with {made.get('model', 'an unknown model')} from {renders or 'unknown renders'}"
        )
    alike: dict[str, list[str]] = {}
    for part in file.parts:
        kind = "deep" if part.deep else f"tiled {part.tile[0]}x{part.tile[1]}" if part.tile != (0, 0) else "scan lines"
        types = "/".join(sorted({c.type for c in part.channels}))
        window = "" if part.data_window == file.display_window else f", data window {part.data_window}"
        alike.setdefault(f"{types}, {part.compression}, {kind}{window}", []).append(part.name or "unnamed")
    for description, names in alike.items():
        some = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
        parts = f"part {some}" if len(names) == 1 else f"{len(names)} parts ({some})"
        facts.append(f"{parts}: {description}")
    return facts


def _pixel_facts(render: MappedRender) -> list[str]:
    """Read all features once: count values that are not finite or negative, and name features that are all zero."""
    brightest: dict[str, float] = {}
    not_finite: Counter[str] = Counter()
    negative: Counter[str] = Counter()
    for rows in render.data_window.bands(ROWS_PER_LOAD):
        for name, values in render.read(rows).items():
            finite = np.isfinite(values)
            not_finite[name] += int(values.size - np.count_nonzero(finite))
            if name != NORMAL:
                negative[name] += int(np.count_nonzero(finite & (values < 0)))
            brightest[name] = max(brightest.get(name, 0.0), float(np.abs(values[finite]).max(initial=0.0)))
    if brightest[RGB] == 0:
        bright = ", ".join(name for name, value in brightest.items() if value > 0 and name != "alpha")
        hint = f", though others are not: {bright}; check which layer it is (--map rgb=LAYER)" if bright else ""
        render.notes.append(f"the beauty is black everywhere{hint}")
    counts = [f"{name}: {n} values are NaN or infinite; fusing repairs them" for name, n in not_finite.items() if n]
    for name, count in negative.items():
        if count:
            reason = " (colours out of gamut)" if name in RADIANCE_FEATURES else ""
            counts.append(f"{name}: {count} values are negative{reason}; fusing sets them to 0")
    return counts + [f"{name}: all zero" for name, value in brightest.items() if value == 0]
