# SPDX-License-Identifier: Apache-2.0
"""The main job on files: two EXRs in, one EXR and a preview out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl import assemble, preview, schema
from oiio_msspl._version import __version__
from oiio_msspl.aovs import Resolution, resolve
from oiio_msspl.assemble import WriteOptions
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr import ExrFile, open_exr
from oiio_msspl.fusion import MAX_MEMORY, Fused, fuse
from oiio_msspl.output import check_target
from oiio_msspl.pairing import pair
from oiio_msspl.session import Session, find_model


@dataclass(frozen=True)
class Inputs:
    """How the two files are to be understood, where they do not say it themselves."""

    mapping: Mapping[str, Any] = field(default_factory=dict)
    """The user's own layers by feature, see :func:`oiio_msspl.aovs.resolve`."""
    view: str | None = None
    """View or view layer; the first one of each file if None."""
    lr_spp: float | None = None
    hr_spp: float | None = None


@dataclass
class Report:
    """What was done, for the user and for machines."""

    lr: Resolution
    hr: Resolution
    scale: int
    model: str
    provider: str
    output: Path
    preview: Path | None
    repaired: dict[str, int]
    warnings: list[str]
    tiles: int
    seconds: dict[str, float]
    """Wall time of ``read`` (headers and model), ``fuse`` (reading pixels included), ``network`` in it, ``write``."""
    features: frozenset[str]
    """What the model reads of the HRLS."""
    low_aovs: tuple[str, ...] = ()
    """What it may read of the LRHS beside colour, if it is there."""

    @property
    def spp_avg(self) -> float | None:
        """Average samples: spp_LRHS / s^2 + spp_HRLS (section 5.1), or None if a header does not say."""
        if self.lr.spp is None or self.hr.spp is None:
            return None
        return self.lr.spp / self.scale**2 + self.hr.spp

    def aovs(self) -> list[dict[str, str]]:
        """As :meth:`oiio_msspl.aovs.Resolution.table`; but what the model does not read is ``unused``."""
        rows = self.hr.table()
        for row in rows:
            if row["feature"] not in {*self.features, "alpha"}:
                row |= {"source": ""} if row["status"] == "default" else {}
                row |= {"status": "unused"}
        return rows

    def found_low_aovs(self) -> dict[str, str]:
        """Those of ``low_aovs`` that the LRHS has, and the layers that they come from."""
        return {name: self.lr.features[name].text for name in self.low_aovs if name in self.lr.features}

    def as_dict(self) -> dict[str, Any]:
        return {
            "lrhs": self.lr.name,
            "hrls": self.hr.name,
            "output": str(self.output),
            "preview": str(self.preview) if self.preview else None,
            "renderer": self.hr.renderer,
            "view": self.hr.view or None,
            "scale": self.scale,
            "spp": {"lrhs": self.lr.spp, "hrls": self.hr.spp, "average": self.spp_avg},
            "model": self.model,
            "provider": self.provider,
            "aovs": self.aovs(),
            "lrhs_aovs": self.found_low_aovs(),
            "notes": self.hr.notes,
            "repaired": self.repaired,
            "warnings": self.warnings,
            "tiles": self.tiles,
            "seconds": {k: round(v, 3) for k, v in self.seconds.items()},
            "version": __version__,
        }


def resolve_pair(lr_path: str | Path, hr_path: str | Path, inputs: Inputs) -> tuple[Resolution, Resolution]:
    """Open and map both files. Of the LRHS, albedo and normal are welcome beside the beauty, and not missed.

    Raises:
        InputError: one of the files can't be used, or both are the same.
    """
    lr_path, hr_path = Path(lr_path), Path(hr_path)
    if lr_path.exists() and hr_path.exists() and lr_path.samefile(hr_path):
        raise InputError(f"{lr_path}: given twice; give the low-resolution render, then the high-resolution one")
    lr_file, hr_file = open_exr(lr_path), open_exr(hr_path)
    return _resolve_lrhs(lr_file, inputs), resolve(hr_file, inputs.mapping, view=inputs.view, spp=inputs.hr_spp)


def _resolve_lrhs(file: ExrFile, inputs: Inputs) -> Resolution:
    """Map the LRHS. The user's mapping is the HRLS's: what it names need not be in the LRHS, or is another file."""
    features = [name for name in (schema.ALBEDO, schema.NORMAL) if name not in inputs.mapping]
    rgb_only = {name: layer for name, layer in inputs.mapping.items() if name == schema.RGB}
    return resolve(file, rgb_only, view=inputs.view, spp=inputs.lr_spp, features=features)


def fuse_files(
    lr_path: str | Path,
    hr_path: str | Path,
    output: str | Path,
    *,
    inputs: Inputs = Inputs(),
    write: WriteOptions = WriteOptions(),
    model: str | None = None,
    device: str = "cpu",
    threads: int = 0,
    max_memory: int = MAX_MEMORY,
    preview_path: Path | None = None,
    view_transform: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Fuse a pair of EXR files.

    Args:
        lr_path, hr_path: the low-resolution, high-spp render and the high-resolution, low-spp render of one frame.
        output: EXR to write.
        inputs, write: how files are understood and stored.
        model: name of a shipped model, a family of them (``paper``) or an ONNX file; None or ``auto``: see
            :func:`oiio_msspl.session.find_model`.
        preview_path: PNG to write, or None.
        view_transform: OpenColorIO view of the preview; None for the paper's sRGB curve.
        overwrite: replace existing files.
        progress: called with (tiles done, tiles in all).

    Raises:
        InputError, MssplError: see their messages; nothing was written.
    """
    start = time.perf_counter()
    output = check_target(output, overwrite=overwrite)
    if output.suffix.lower() != ".exr":
        raise InputError(f"{output}: the result is an EXR; name it .exr")
    if any(Path(p).exists() and output.exists() and output.samefile(p) for p in (lr_path, hr_path)):
        raise InputError(f"{output}: is one of the inputs; write the result elsewhere")
    if preview_path is not None:
        check_target(preview_path, overwrite=overwrite)
        if view_transform is not None:
            preview.check_view(view_transform)
    lr, hr = resolve_pair(lr_path, hr_path, inputs)
    assemble.dropped_channels(hr, write)  # a layer that is not there shows before the work, not after
    session = Session(find_model(pair(lr, hr).scale, model), device, threads)
    opened = time.perf_counter()

    fused = fuse(lr, hr, session, error=write.error_layer, max_memory=max_memory, progress=progress)
    computed = time.perf_counter()

    report = report_on(lr, hr, session, fused, output, preview_path)
    write_frame(report, fused, write, overwrite=overwrite)
    write_preview(report, fused, view_transform, overwrite=overwrite)
    report.seconds = {
        "read": opened - start,
        "fuse": computed - opened,
        "network": fused.seconds,
        "write": time.perf_counter() - computed,
    }
    return report


def report_on(
    lr: Resolution, hr: Resolution, session: Session, fused: Fused, output: Path, preview_path: Path | None
) -> Report:
    """The report of a frame that is fused and not yet written."""
    return Report(
        lr=lr,
        hr=hr,
        scale=fused.pairing.scale,
        model=session.contract.name,
        provider=session.provider,
        output=output,
        preview=preview_path,
        repaired=fused.repaired,
        warnings=[*_spp_warnings(lr, hr, session), *fused.warnings],
        tiles=fused.tiles,
        seconds={},
        features=frozenset(session.contract.features),
        low_aovs=session.low_aovs,
    )


def write_frame(report: Report, fused: Fused, options: WriteOptions, *, overwrite: bool) -> None:
    """Write the EXR that the report names, and add what there is to say about it."""
    report.warnings += assemble.write(
        report.output,
        report.hr,
        fused.rgb,
        fused.alpha,
        _provenance(report),
        options,
        error=fused.error,
        overwrite=overwrite,
    )


def write_preview(report: Report, fused: Fused, view: str | None, *, overwrite: bool) -> None:
    """Write the PNG that the report names, if any. A frame without its preview is still a frame: that is a warning."""
    if report.preview is None:
        return
    windows = (report.hr.data_window, report.hr.display_window)
    try:
        preview.write(report.preview, fused.rgb, *windows, view, overwrite=overwrite)
    except MssplError as error:
        report.warnings.append(f"no preview: {error}")
        report.preview = None


def _spp_warnings(lr: Resolution, hr: Resolution, session: Session) -> list[str]:
    warnings = []
    if lr.spp is not None and hr.spp is not None and lr.spp <= hr.spp:
        warnings.append(
            f"the LRHS has {lr.spp:g} spp and the HRLS {hr.spp:g}: the method expects more in the low-resolution render"
        )
    for name, key, spp in (("HRLS", "hrls", hr.spp), ("LRHS", "lrhs", lr.spp)):
        seen = session.contract.training_spp.get(key)
        if spp is not None and seen and not seen[0] <= spp <= seen[1]:
            warnings.append(
                f"the {name} has {spp:g} spp; {session.contract.name} was trained on {seen[0]} to {seen[1]}"
            )
    return warnings


def _provenance(report: Report) -> dict[str, str]:
    """Attributes of the fused part: what it was made from."""
    spp = report.spp_avg
    return {
        "msspl/version": __version__,
        "msspl/model": report.model,
        "msspl/scale": str(report.scale),
        "msspl/lrhs": report.lr.name,
        "msspl/hrls": report.hr.name,
        "msspl/spp_lrhs": "unknown" if report.lr.spp is None else f"{report.lr.spp:g}",
        "msspl/spp_hrls": "unknown" if report.hr.spp is None else f"{report.hr.spp:g}",
        "msspl/spp_average": "unknown" if spp is None else f"{spp:g}",
        "msspl/aovs": "; ".join(f"{row['feature']}: {row['status']} {row['source']}".strip() for row in report.aovs()),
    }
