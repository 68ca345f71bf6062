# SPDX-License-Identifier: Apache-2.0
"""What the user has chosen for a job: inputs, output, model and memory."""

from __future__ import annotations

from dataclasses import dataclass, field

from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.model.catalogue import load_model
from oiio_msspl.model.session import Session


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

    def load(self, scale: int) -> Session:
        """Return the model for a scale. Each model is loaded once.

        Raises:
            InputError: there is no such model, or the device can't be used.
        """
        session = self.sessions.get((scale, self.model))
        if session is None:
            session = self.sessions[scale, self.model] = load_model(scale, self.model, self.device, self.threads)
        return session

    def session(self, scale: int) -> Session:
        """Return the model for a scale, and check that it makes the layers that are asked for.

        Raises:
            InputError: there is no such model, or it does not make such a layer.
        """
        session = self.load(scale)
        if self.write.error_layer:
            session.require_error()
        if self.write.data_passes:
            session.require_clean_aovs()
        return session
