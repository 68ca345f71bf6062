# SPDX-License-Identifier: Apache-2.0
"""Decides what becomes of results that exist: the one place that skips, replaces or refuses a frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_target
from oiio_msspl.exr.preview import is_our_preview
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.findings import Finding
from oiio_msspl.jobs.inputs import files_by_name
from oiio_msspl.jobs.plan import ShotPlan
from oiio_msspl.jobs.report import WEIGHTS_ATTRIBUTE
from oiio_msspl.jobs.sequence import FrameFiles, Shot
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.jobs.shot_report import FAILED, MISSING, OLDER, SKIPPED, FrameResult, result_of
from oiio_msspl.jobs.timeline import neighbours
from oiio_msspl.model.catalogue import model_files
from oiio_msspl.model.contract import ONE_SIZE, SCALES
from oiio_msspl.model.digests import as_text, digests


@dataclass(frozen=True)
class ExistingResults:
    """The results of a shot that exist already. Other runs may write some at any time."""

    settings: Settings
    plan: ShotPlan

    def skips(self, files: FrameFiles) -> bool:
        """Return whether a frame counts as done: its EXR exists and is not to be replaced."""
        return self.settings.skip_existing and files.output.is_file() and not self.replaces(files)

    def replaces(self, files: FrameFiles) -> bool:
        """Return whether an EXR that exists is replaced: always, or if an input is newer than it."""
        return self.settings.overwrite or (self.settings.update and bool(self.newer_inputs(files)))

    def replaces_preview(self, png: Path | None) -> bool:
        """Return whether a PNG that exists is replaced.

        If frames that exist are skipped, only a preview of ours is: a killed run may have left it, or it shows an EXR
        that is replaced.
        """
        return self.settings.overwrite or (self.settings.skip_existing and png is not None and is_our_preview(png))

    def newer_inputs(self, files: FrameFiles) -> list[Path]:
        """Return the inputs of a frame that were changed after its EXR was written. Without an EXR there are none."""
        if files.lr is None or files.hr is None or not files.output.exists():
            return []
        written = files.output.stat().st_mtime
        beside = neighbours(files.number, self.plan.count, self.plan.frames)
        renders = [path for frame in (files, *map(self.plan.frames.__getitem__, beside)) for path in frame.pair]
        paths = files_by_name(renders, self.settings.inputs, self.settings.model)
        return [path for path in paths if path.is_file() and path.stat().st_mtime > written]

    def known_result(self, files: FrameFiles, shot: Shot) -> FrameResult | None:
        """Return the result of a frame that need not or can't be fused; None for a frame to fuse."""
        if self.skips(files):
            newer = self.newer_inputs(files)
            text = f"is older than {newer[0]}; --update fuses such frames again" if newer else ""
            return result_of(files, SKIPPED, warnings=[Finding(OLDER, text)] if newer else [])
        sources = [("LRHS", files.lr, shot.lr), ("HRLS", files.hr, shot.hr)]
        if shot.has_one_render:
            sources = [("render", files.hr, shot.hr)]
        lacking = [f"{name} ({sequence.pattern})" for name, path, sequence in sources if path is None]
        if lacking:
            return result_of(files, MISSING, f"no {' and no '.join(lacking)} of this number", 2)
        try:
            self._check_targets(files)
        except InputError as error:
            return result_of(files, FAILED, str(error), error.exit_code)
        return None

    def check_weights(self, skipped: Iterable[FrameFiles]) -> None:
        """Check that frames that are skipped were fused by the weights that fuse the others now.

        An EXR without the digests of its weights passes: another program, or a version before 1.0, has written it.
        """
        model, device = self.settings.model, self.settings.device
        for files in skipped:
            scale, made_by = _made_by(files.output)
            if scale not in (ONE_SIZE, *SCALES) or not made_by:
                continue
            now = as_text(digests(model_files(scale, model), device))
            if made_by != now:
                raise InputError(
                    f"{files.output}: was fused by other weights ({made_by}) than the frames that are missing would be "
                    f"({now}); pass --overwrite to fuse all frames again, or name the model and device of the first run"
                )

    def _check_targets(self, files: FrameFiles) -> None:
        """Raise InputError if a result can't be written."""
        overwrite = self.replaces(files)
        if files.output.exists() and not files.output.is_dir() and not overwrite:
            raise InputError("the output exists; pass --skip-existing or --overwrite")
        check_target(files.output, overwrite=overwrite)
        if files.preview is not None:
            check_target(files.preview, overwrite=self.replaces_preview(files.preview))


def _made_by(path: Path) -> tuple[int, str]:
    """Return the scale and the weights in the header of a fused EXR; 0 and nothing if it does not say."""
    try:
        file = open_exr(path)
        file.close()
        return int(file.metadata["msspl/scale"]), file.metadata[WEIGHTS_ATTRIBUTE]
    except (InputError, KeyError, ValueError):
        return 0, ""
