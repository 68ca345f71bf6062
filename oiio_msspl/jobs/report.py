# SPDX-License-Identifier: Apache-2.0
"""Reports a fused frame: its inputs, the layers used, warnings, and the attributes written into the EXR."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl._version import full_version
from oiio_msspl.aovs.additive_sets import AdditiveLayer, AdditiveSet
from oiio_msspl.aovs.features import ALBEDO
from oiio_msspl.aovs.mapped_render import MappedRender, origin
from oiio_msspl.aovs.views import name_of
from oiio_msspl.exr.contents import dropped_channels
from oiio_msspl.exr.layers import layer_by_channel, layers_of
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.findings import Finding, codes_of
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.model.contract import ONE_SIZE, Contract
from oiio_msspl.model.digests import as_text
from oiio_msspl.model.session import Session

#: Samples of the LRHS below which a pair gets a warning, as a share of those of the HRLS, both per pixel of the frame.
LEAST_SHARE = 1 / 8
#: The attribute of a fused EXR that holds the digests of the weights, as :func:`.digests.as_text` writes them.
WEIGHTS_ATTRIBUTE = "msspl/weights"


@dataclass(repr=False)
class FrameReport:
    """The account of a fused pair, for people and, as :meth:`as_dict`, for programs."""

    lr: MappedRender
    hr: MappedRender
    scale: int
    model: str
    weights: dict[str, str]
    """The digests of the model and of those that fuse passes, by name."""
    provider: str
    """The ONNX Runtime execution provider that ran the model."""
    convolutions: dict[str, int]
    """Number of the model's convolutions on each execution provider; empty if ONNX Runtime does not say."""
    output: Path
    preview: Path | None
    """The PNG beside the EXR; None if none was written."""
    repaired: dict[str, int]
    """Number of values that were NaN or infinite, by layer, see :class:`oiio_msspl.fusion.fuse.FusedFrame`."""
    negative: dict[str, int]
    """Number of values that were negative and set to 0, by layer."""
    warnings: list[Finding]
    """What is wrong with the frame. Each is a sentence with a ``code``, see ``docs/api.md``."""
    tiles: int
    """Tiles of all views that were fused."""
    seconds: dict[str, float]
    """Wall time in seconds: ``read`` opens both files and loads the model, ``fuse`` reads pixels and fuses them,
    ``network`` is the part of ``fuse`` that the model's network took, and ``write`` writes EXR and preview."""
    features: frozenset[str]
    """Features of the HRLS that are read."""
    clipped: int = 0
    """Number of fused values that half could not hold; 0 if the beauty is stored as float."""
    lrhs_aovs: dict[str, str] = field(default_factory=dict)
    """Features of the LRHS that the model reads beside colour, with their layers; none for one render."""
    passes: dict[str, str] = field(default_factory=dict)
    """A sentence on each additive set, by name: fused or passed on."""
    trust: float | None = None
    """Mean share of what the network had removed and was put back, because both renders show it, or because the only
    render does, by the variance of its pixels or by its neighbours; None without trust."""
    frames_counted: float | None = None
    """How many frames a pixel is the mean of, in the mean over the first view; None without neighbours."""
    other_views: list[FrameReport] = field(default_factory=list)
    """The views and view layers that were fused beside the first one. Counts, warnings and passes of this report are
    about all views; those of another view than the first have its name in front."""
    fused_sets: list[AdditiveSet] = field(default_factory=list)
    """The additive sets that were fused."""
    sources: tuple[str, str] | None = None
    """What the result names as its LRHS and HRLS; None for their files."""
    layers: list[str] = field(default_factory=list)
    """The layers of the HRLS that are written beside the beauty, of all views, or their channels if they have no name.
    In a file with views (``left``) they are ``VIEW: LAYER``."""

    def __repr__(self) -> str:
        """Return one line; :meth:`as_dict` has everything."""
        return f"<{self.output}, fused at x{self.scale} with {self.model}, {len(self.warnings)} warnings>"

    @property
    def is_one_render(self) -> bool:
        """Whether the frame has one render, which is both ``lr`` and ``hr``."""
        return self.lr.file is self.hr.file

    @property
    def spp_avg(self) -> float | None:
        """Average samples: spp_LRHS / s^2 + spp_HRLS (section 5.1), or None if a header does not say."""
        if self.lr.spp is None or self.hr.spp is None or self.is_one_render:
            return self.hr.spp if self.is_one_render else None
        return self.lr.spp / self.scale**2 + self.hr.spp

    def aovs(self) -> list[dict[str, str]]:
        """List what the features of the HRLS are read from, see :meth:`.MappedRender.table`."""
        return self.hr.table(self.features)

    def fused_views(self) -> list[FrameReport]:
        """Return the reports of all views that were fused, the first one in front; none for a file with one view."""
        return [self, *self.other_views] if self.hr.other_views else []

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        return {
            "lrhs": None if self.is_one_render else self.lr.name,
            "hrls": self.hr.name,
            "output": str(self.output),
            "preview": str(self.preview) if self.preview else None,
            "renderer": self.hr.renderer,
            "view": self.hr.view or None,
            "other_views": self.hr.other_views,
            "fused_views": [{"view": view.hr.view or None, "aovs": view.aovs()} for view in self.fused_views()],
            "size": self.hr.display_window.size,
            "scale": self.scale,
            "spp": {"lrhs": None if self.is_one_render else self.lr.spp, "hrls": self.hr.spp, "average": self.spp_avg},
            "model": self.model,
            "weights": self.weights,
            "provider": self.provider,
            "convolutions": self.convolutions,
            "aovs": self.aovs(),
            "lrhs_aovs": self.lrhs_aovs,
            "passes": self.passes,
            "layers": self.layers,
            "notes": self.hr.notes,
            "repaired": self.repaired,
            "negative": self.negative,
            "clipped": self.clipped,
            "trust": None if self.trust is None else round(self.trust, 4),
            "warnings": self.warnings,
            "warning_codes": codes_of(self.warnings),
            "frames_counted": None if self.frames_counted is None else round(self.frames_counted, 2),
            "tiles": self.tiles,
            "seconds": {k: round(v, 3) for k, v in self.seconds.items()},
            "version": full_version(),
        }


def report_on(
    lr: MappedRender, hr: MappedRender, session: Session, fused: FusedFrame, output: Path, preview_path: Path | None
) -> FrameReport:
    """Report on a frame that is fused and not yet written: ``seconds`` are those of the network."""
    warnings = spp_warnings(lr, hr, session.contract)
    if ALBEDO in session.contract.hrls and ALBEDO not in hr.features:
        text = "no albedo was found, so textures blur; render one, or name its layer with --map albedo=LAYER"
        warnings.insert(0, Finding("no_albedo", text))
    one_render = lr.file is hr.file
    read = hr.features_read(session.contract.hrls, alone=one_render and fused.trust is not None)
    lrhs_aovs = () if one_render else session.contract.lrhs[1:]
    return FrameReport(
        lr=lr,
        hr=hr.for_model(read),
        scale=fused.alignment.scale,
        model=session.name,
        weights=session.weights,
        provider=session.provider,
        convolutions=session.convolutions,
        output=output,
        preview=preview_path,
        repaired=fused.repaired,
        negative=fused.negative,
        warnings=[*warnings, *fused.warnings, *_pass_warnings(hr, fused)],
        tiles=fused.tiles,
        seconds={"network": fused.seconds},
        features=frozenset(read),
        lrhs_aovs={name: lr.features[name].text for name in lrhs_aovs if name in lr.features},
        passes=_passes(fused),
        trust=None if fused.trust is None else float(fused.trust.mean()),
        frames_counted=None if fused.frames is None else float(fused.frames.mean(dtype=np.float64)),
        fused_sets=[job.written for job in fused.passes.jobs] if fused.passes else [],
    )


def add_other_views(report: FrameReport, views: Sequence[FrameReport], passed_on: Sequence[Finding]) -> None:
    """Add the reports of other views to that of the first one, and sentences on why further views are passed on."""
    report.warnings = [*merged({view.hr.view: view.warnings for view in (report, *views)}), *passed_on]
    report.other_views = list(views)
    for view in views:
        name = name_of(view.hr.view)
        report.passes |= {f"{name}: {key}": text for key, text in view.passes.items()}
        report.repaired |= {f"{name}: {key}": count for key, count in view.repaired.items()}
        report.negative |= {f"{name}: {key}": count for key, count in view.negative.items()}
        report.tiles += view.tiles
        report.seconds["network"] += view.seconds["network"]


def merged(sentences: Mapping[str, Sequence[Finding]]) -> list[Finding]:
    """Merge the sentences about several views. One that only some views share begins with the names of these."""
    views: dict[Finding, list[str]] = {}
    for view, texts in sentences.items():
        for text in texts:
            views.setdefault(text, []).append(name_of(view))
    return [text if len(who) == len(sentences) else text.about(", ".join(who)) for text, who in views.items()]


def _pass_warnings(hr: MappedRender, fused: FusedFrame) -> list[Finding]:
    """Warn of layers that the LRHS lacks, and of sets that the user has named and that could not be fused."""
    if fused.passes is None:
        return []
    refused = fused.passes.refused
    named = [additive.name for additive in hr.additive_sets if additive.by_user and additive.name in refused]
    texts = [f"--sum {name}: {refused[name]}; its layers of {hr.name} are passed on as they are" for name in named]
    return [*fused.passes.warnings, *(Finding("passes", text) for text in texts)]


def _passes(fused: FusedFrame) -> dict[str, str]:
    if fused.passes is None:
        return {}
    texts = {}
    for job in fused.passes.jobs:
        alone = f" ({job.hrls_alone} from the HRLS alone)" if job.hrls_alone else ""
        lacking = f"; {job.lacking:.1%} of the beauty's light is in none of them" if job.remainder else ""
        texts[job.layers.name] = f"fused: {job.written.layer_names}{alone}{lacking}"
    refused = {name: f"passed on: {reason}" for name, reason in fused.passes.refused.items() if name not in texts}
    return texts | refused


def spp_warnings(lr: MappedRender, hr: MappedRender, contract: Contract) -> list[Finding]:
    """Warn of samples per pixel that the method or the model was not made for."""
    if contract.scale == ONE_SIZE:
        return []
    warnings = []
    if lr.spp is not None and hr.spp is not None and lr.spp / contract.scale**2 < LEAST_SHARE * hr.spp:
        text = (
            f"the LRHS has {lr.spp:g} spp and the HRLS {hr.spp:g}: the method expects more in the low-resolution render"
        )
        warnings.append(Finding("spp", text))
    for name, key, spp in (("HRLS", "hrls", hr.spp), ("LRHS", "lrhs", lr.spp)):
        trained = contract.training_spp.get(key)
        # Where a network saw fewer samples, it removes detail, which the renders give back to all but the paper's.
        most = math.inf if contract.denoiser or trained is None else trained[1]
        if spp is not None and trained and not trained[0] <= spp <= most:
            text = f"the {name} has {spp:g} spp; {contract.name} was trained on {trained[0]} to {trained[1]}"
            warnings.append(Finding("spp", text))
    return warnings


def written_layers(hr: MappedRender, write: WriteOptions) -> list[str]:
    """Name what is written beside the beauty, sorted, see :attr:`FrameReport.layers`."""
    left_out = {*dropped_channels(hr.file, hr.beauty_channels, write.layers), *hr.beauty_channels}
    names = {
        (f"{layer.view}: " if layer.view else "") + (layer.name or component)
        for layer in layers_of(hr.file)
        for component, channel in layer.channels.items()
        if channel not in left_out
    }
    return sorted(names)


def provenance(report: FrameReport) -> dict[str, str]:
    """Return attributes of the fused part: model, inputs, spp and layers that the frame was made from.

    ``msspl/passes`` is JSON, the fused sets: ``[{"name": NAME, "layers": [[LAYER], [LIGHT, COLOUR], ...]}, ...]``. The
    sum of the layers, and of the products of light and colour, is the fused beauty. The names are those of the HRLS.
    """
    views = {"msspl/views": ", ".join(name_of(view.hr.view) for view in report.fused_views())}
    lrhs, hrls = report.sources or (report.lr.name, report.hr.name)
    second = {} if report.is_one_render else {"msspl/lrhs": lrhs, "msspl/spp_lrhs": _spp(report.lr.spp)}
    return (views if report.other_views else {}) | {
        **second,
        "msspl/version": full_version(),
        "msspl/model": report.model,
        WEIGHTS_ATTRIBUTE: as_text(report.weights),
        "msspl/provider": report.provider,
        "msspl/scale": str(report.scale),
        "msspl/hrls": hrls,
        "msspl/spp_hrls": _spp(report.hr.spp),
        "msspl/spp_average": _spp(report.spp_avg),
        "msspl/aovs": "; ".join(f"{row['feature']}: {origin(row)}" for row in report.aovs()),
        "msspl/trust": "off" if report.trust is None else f"{report.trust:.4f}",
        "msspl/passes": json.dumps(_fused_layers(report)),
    }


def _spp(spp: float | None) -> str:
    return "unknown" if spp is None else f"{spp:g}"


def _fused_layers(report: FrameReport) -> list[dict[str, Any]]:
    """List the fused sets, with the layers' full names, as :func:`provenance` describes them."""
    layer_of = layer_by_channel(report.hr.file)

    def names(layer: AdditiveLayer) -> list[str]:
        return [layer_of[channels[0]].name for channels in (layer.channels, layer.factor) if channels]

    return [{"name": additive.name, "layers": [*map(names, additive.layers)]} for additive in report.fused_sets]
