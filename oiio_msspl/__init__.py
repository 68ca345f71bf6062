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
    from oiio_msspl.jobs.arrays import ArrayFrame, FusedArrays, fuse_array_shot, fuse_arrays
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

#: The public names of each module.
_NAMES = {
    "aovs.mapped_render": "MappedRender", "aovs.matching": "map_render", "errors": "InputError MssplError",
    "exr.reader": "open_exr", "exr.render": "Render Window", "exr.write_options": "WriteOptions", "findings": "Finding",
    "fusion.fuse": "FusedFrame fuse", "inspection": "Inspection inspect_file",
    "jobs.arrays": "ArrayFrame FusedArrays fuse_array_shot fuse_arrays",
    "jobs.farm.openjd": "Job make_job write_bundle", "jobs.files": "fuse_files",
    "jobs.fitting": "PairCheck ShotCheck check_files check_shot", "jobs.inputs": "InputOptions",
    "jobs.plan": "TemporalOptions", "jobs.report": "FrameReport", "jobs.sequence": "Shot find_shot",
    "jobs.shot": "fuse_shot", "jobs.shot_report": "FrameResult ShotReport",
    "model.catalogue": "find_model shipped_models", "model.contract": "Contract", "model.session": "Session",
}  # fmt: skip
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "ArrayFrame", "Contract", "Finding", "FrameReport", "FrameResult", "FusedArrays", "FusedFrame", "InputError",
    "InputOptions", "Inspection", "Job", "MappedRender", "MssplError", "PairCheck", "Render", "Session", "Shot",
    "ShotCheck", "ShotReport", "TemporalOptions", "Window", "WriteOptions", "__version__", "check_files", "check_shot",
    "find_model", "find_shot", "fuse", "fuse_array_shot", "fuse_arrays", "fuse_files", "fuse_shot", "inspect_file",
    "make_job", "map_render", "open_exr", "shipped_models", "write_bundle",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"oiio_msspl.{_MODULES[name]}"), name)
