# SPDX-License-Identifier: Apache-2.0
"""Fuse a low-resolution, high-spp render (LRHS) with a high-resolution, low-spp render (HRLS) of the same frame.

    from oiio_msspl import fuse_files
    report = fuse_files("lr.exr", "hr.exr", "out.exr")

With arrays instead of files:

    from oiio_msspl import Render, Session, find_model, fuse
    lr = Render.from_arrays("lr", rgb=low)                      # (h, w, 3) float32, scene linear
    hr = Render.from_arrays("hr", rgb=high, albedo=albedo)      # (s*h, s*w, 3)
    fused = fuse(lr, hr, Session(find_model(scale=4))).rgb

Names are imported when they are first used: ``import oiio_msspl`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from oiio_msspl._version import __version__

if TYPE_CHECKING:
    from oiio_msspl.aovs import Resolution, resolve
    from oiio_msspl.assemble import WriteOptions
    from oiio_msspl.contract import Contract
    from oiio_msspl.errors import InputError, MssplError
    from oiio_msspl.exr import open_exr
    from oiio_msspl.files import Inputs, Report, fuse_files
    from oiio_msspl.fusion import Fused, fuse
    from oiio_msspl.render import Render, Window
    from oiio_msspl.session import Session, find_model, shipped_models
    from oiio_msspl.shot import FrameResult, ShotReport, fuse_shot

_HOME = {
    "Contract": "contract",
    "FrameResult": "shot",
    "Fused": "fusion",
    "InputError": "errors",
    "Inputs": "files",
    "MssplError": "errors",
    "Render": "render",
    "Report": "files",
    "Resolution": "aovs",
    "Session": "session",
    "ShotReport": "shot",
    "Window": "render",
    "WriteOptions": "assemble",
    "find_model": "session",
    "fuse": "fusion",
    "fuse_files": "files",
    "fuse_shot": "shot",
    "open_exr": "exr",
    "resolve": "aovs",
    "shipped_models": "session",
}

__all__ = [
    "Contract",
    "FrameResult",
    "Fused",
    "InputError",
    "Inputs",
    "MssplError",
    "Render",
    "Report",
    "Resolution",
    "Session",
    "ShotReport",
    "Window",
    "WriteOptions",
    "__version__",
    "find_model",
    "fuse",
    "fuse_files",
    "fuse_shot",
    "open_exr",
    "resolve",
    "shipped_models",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"oiio_msspl.{_HOME[name]}"), name)
