# SPDX-License-Identifier: Apache-2.0
"""Remove the noise of one render, of two of the same size, or of a low-resolution, high-spp render (LRHS) and a
high-resolution, low-spp render (HRLS) of the same frame.

    from oiio_msspl import fuse_files
    report = fuse_files(None, "hr.exr", "out.exr")
    report = fuse_files("lr.exr", "hr.exr", "out.exr")

With arrays instead of files, (height, width, 3) float32, scene linear:

    from oiio_msspl import fuse_arrays
    clean = fuse_arrays(render, albedo=albedo, normal=normal, quality="best").rgb

A name's module is imported when the name is first used, so that ``import oiio_msspl`` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from oiio_msspl._version import __version__

if TYPE_CHECKING:
    from oiio_msspl.aovs.mapped_render import MappedRender
    from oiio_msspl.aovs.matching import map_render
    from oiio_msspl.errors import InputError, MssplError
    from oiio_msspl.exr.reader import open_exr
    from oiio_msspl.exr.render import Render, Window
    from oiio_msspl.exr.write_options import WriteOptions
    from oiio_msspl.findings import Finding
    from oiio_msspl.fusion.fuse import FusedFrame, fuse
    from oiio_msspl.inspection import Inspection, inspect_file
    from oiio_msspl.jobs.arrays import fuse_arrays
    from oiio_msspl.jobs.farm.openjd import Job, make_job, write_bundle
    from oiio_msspl.jobs.files import fuse_files
    from oiio_msspl.jobs.fitting import PairCheck, ShotCheck, check_files, check_shot
    from oiio_msspl.jobs.inputs import InputOptions
    from oiio_msspl.jobs.plan import TemporalOptions
    from oiio_msspl.jobs.report import FrameReport
    from oiio_msspl.jobs.sequence import Shot, find_shot
    from oiio_msspl.jobs.shot import fuse_shot
    from oiio_msspl.jobs.shot_report import FrameResult, ShotReport
    from oiio_msspl.model.catalogue import find_model, shipped_models
    from oiio_msspl.model.contract import Contract
    from oiio_msspl.model.session import Session

_MODULES = {
    "Contract": "model.contract",
    "Finding": "findings",
    "FrameReport": "jobs.report",
    "FrameResult": "jobs.shot_report",
    "FusedFrame": "fusion.fuse",
    "InputError": "errors",
    "InputOptions": "jobs.inputs",
    "Inspection": "inspection",
    "Job": "jobs.farm.openjd",
    "MappedRender": "aovs.mapped_render",
    "MssplError": "errors",
    "PairCheck": "jobs.fitting",
    "Render": "exr.render",
    "Session": "model.session",
    "Shot": "jobs.sequence",
    "ShotCheck": "jobs.fitting",
    "ShotReport": "jobs.shot_report",
    "TemporalOptions": "jobs.plan",
    "Window": "exr.render",
    "WriteOptions": "exr.write_options",
    "check_files": "jobs.fitting",
    "check_shot": "jobs.fitting",
    "find_model": "model.catalogue",
    "find_shot": "jobs.sequence",
    "fuse": "fusion.fuse",
    "fuse_arrays": "jobs.arrays",
    "fuse_files": "jobs.files",
    "fuse_shot": "jobs.shot",
    "inspect_file": "inspection",
    "make_job": "jobs.farm.openjd",
    "map_render": "aovs.matching",
    "open_exr": "exr.reader",
    "shipped_models": "model.catalogue",
    "write_bundle": "jobs.farm.openjd",
}

__all__ = [
    "Contract",
    "Finding",
    "FrameReport",
    "FrameResult",
    "FusedFrame",
    "InputError",
    "InputOptions",
    "Inspection",
    "Job",
    "MappedRender",
    "MssplError",
    "PairCheck",
    "Render",
    "Session",
    "Shot",
    "ShotCheck",
    "ShotReport",
    "TemporalOptions",
    "Window",
    "WriteOptions",
    "__version__",
    "check_files",
    "check_shot",
    "find_model",
    "find_shot",
    "fuse",
    "fuse_arrays",
    "fuse_files",
    "fuse_shot",
    "inspect_file",
    "make_job",
    "map_render",
    "open_exr",
    "shipped_models",
    "write_bundle",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"oiio_msspl.{_MODULES[name]}"), name)
