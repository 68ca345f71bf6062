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

from oiio_msspl._version import __version__ as __version__

if TYPE_CHECKING:
    from oiio_msspl.aovs.mapped_render import MappedRender as MappedRender
    from oiio_msspl.aovs.matching import map_render as map_render
    from oiio_msspl.errors import InputError as InputError
    from oiio_msspl.errors import MssplError as MssplError
    from oiio_msspl.exr.reader import open_exr as open_exr
    from oiio_msspl.exr.render import Render as Render
    from oiio_msspl.exr.render import Window as Window
    from oiio_msspl.exr.write_options import WriteOptions as WriteOptions
    from oiio_msspl.findings import Finding as Finding
    from oiio_msspl.fusion.fuse import FusedFrame as FusedFrame
    from oiio_msspl.fusion.fuse import fuse as fuse
    from oiio_msspl.inspection import Inspection as Inspection
    from oiio_msspl.inspection import inspect_file as inspect_file
    from oiio_msspl.jobs.arrays import fuse_arrays as fuse_arrays
    from oiio_msspl.jobs.farm.openjd import Job as Job
    from oiio_msspl.jobs.farm.openjd import make_job as make_job
    from oiio_msspl.jobs.farm.openjd import write_bundle as write_bundle
    from oiio_msspl.jobs.files import fuse_files as fuse_files
    from oiio_msspl.jobs.inputs import InputOptions as InputOptions
    from oiio_msspl.jobs.pair_check import PairCheck as PairCheck
    from oiio_msspl.jobs.pair_check import check_files as check_files
    from oiio_msspl.jobs.plan import TemporalOptions as TemporalOptions
    from oiio_msspl.jobs.report import FrameReport as FrameReport
    from oiio_msspl.jobs.sequence import Shot as Shot
    from oiio_msspl.jobs.sequence import find_shot as find_shot
    from oiio_msspl.jobs.shot import fuse_shot as fuse_shot
    from oiio_msspl.jobs.shot_check import ShotCheck as ShotCheck
    from oiio_msspl.jobs.shot_check import check_shot as check_shot
    from oiio_msspl.jobs.shot_report import FrameResult as FrameResult
    from oiio_msspl.jobs.shot_report import ShotReport as ShotReport
    from oiio_msspl.model.catalogue import find_model as find_model
    from oiio_msspl.model.catalogue import shipped_models as shipped_models
    from oiio_msspl.model.contract import Contract as Contract
    from oiio_msspl.model.session import Session as Session

#: Module -> the public names that it defines.
_NAMES = {
    "aovs.mapped_render": ("MappedRender",),
    "aovs.matching": ("map_render",),
    "errors": ("InputError", "MssplError"),
    "exr.reader": ("open_exr",),
    "exr.render": ("Render", "Window"),
    "exr.write_options": ("WriteOptions",),
    "findings": ("Finding",),
    "fusion.fuse": ("FusedFrame", "fuse"),
    "inspection": ("Inspection", "inspect_file"),
    "jobs.arrays": ("fuse_arrays",),
    "jobs.farm.openjd": ("Job", "make_job", "write_bundle"),
    "jobs.files": ("fuse_files",),
    "jobs.inputs": ("InputOptions",),
    "jobs.pair_check": ("PairCheck", "check_files"),
    "jobs.plan": ("TemporalOptions",),
    "jobs.report": ("FrameReport",),
    "jobs.sequence": ("Shot", "find_shot"),
    "jobs.shot": ("fuse_shot",),
    "jobs.shot_check": ("ShotCheck", "check_shot"),
    "jobs.shot_report": ("FrameResult", "ShotReport"),
    "model.catalogue": ("find_model", "shipped_models"),
    "model.contract": ("Contract",),
    "model.session": ("Session",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [*_MODULES, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"oiio_msspl.{_MODULES[name]}"), name)
