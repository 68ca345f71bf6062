# SPDX-License-Identifier: Apache-2.0
"""Warnings as data: a sentence for people, with a code for programs."""

from __future__ import annotations

from collections.abc import Iterable

from oiio_msspl.wording import worded

#: The codes of warnings, and what they mean.
CODES = {
    "no_albedo": "no albedo was found, so textures blur",
    "not_averaged": "the frames of a shot are fused one by one, although neighbours were wanted",
    "missing_neighbour": "a neighbour is missing, can't be read or can't be averaged",
    "neighbours_differ": "neighbours are averaged and hardly count",
    "same_seed": "two frames have the same noise",
    "flicker": "a frame has other layers, another size or another model than the first fused one",
    "older": "a result that is kept is older than one of its inputs",
    "repaired": "values were NaN or infinite",
    "broken_aov": "most of an albedo or normal is NaN or infinite",
    "clipped": "values are too bright for half",
    "spp": "the samples per pixel are not what the method or the model was made for",
    "passes": "passes are not fused, or with more noise",
    "no_alpha": "an alpha stays noisy",
    "view_not_fused": "a view or view layer stays as it was rendered",
    "deep": "a deep part was left out",
    "no_preview": "the preview could not be written",
    "black": "both renders are black",
    "region": "a render is black outside of a rectangle",
    "failed_bucket": "a bucket of a render failed",
    "same_noise": "the small render was made from the large one",
    "mirrored": "one render is mirrored",
    "unlike": "the two renders hardly look alike",
    "exposure": "one render is brighter than the other",
    "colours": "the renders are in different colour spaces, or white balances",
    "shifted": "one render is shifted against the other",
    "zoomed": "one render is framed tighter than the other",
    "different_place": "a part of the frame shows different things",
    "shifted_aov": "an albedo or normal is shifted against the picture",
    "foreign_aov": "an albedo or normal is not of this frame",
    "negated_normal": "the normals of one render are those of the other one, negated",
    "not_judged": "something could not be judged",
}

#: The codes of advice, and what it is about.
ADVICE = {
    "add_albedo": "an albedo is missing",
    "add_motion": "motion vectors are missing",
    "box_filter": "another pixel filter",
    "second_seed": "a second render of the same size",
    "more_hr_samples": "more of the samples in the full-resolution render",
    "no_lrhs": "a low-resolution render does not pay",
}


class Finding(str):
    """A sentence about a render, with a ``code`` that programs can test: a key of ``CODES`` or ``ADVICE``."""

    code: str
    _text: str

    def __new__(cls, code: str, text: str) -> Finding:
        """Make a finding. The text may name options, see :func:`oiio_msspl.wording.worded`."""
        finding = super().__new__(cls, worded(text))
        finding.code, finding._text = code, text
        return finding

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        """Return what a copy is made of. A worker's finding is worded by the process that reads it."""
        return self.code, self._text

    def about(self, what: str) -> Finding:
        """Return the finding with the name of what it is about in front."""
        return Finding(self.code, f"{what}: {self._text}")


def codes_of(warnings: Iterable[str]) -> list[str]:
    """Return the code of each warning. One without a code was told by another program: ``other``."""
    return [getattr(warning, "code", "other") for warning in warnings]


def as_data(finding: Finding) -> dict[str, str]:
    """Return a finding as JSON values."""
    return {"code": finding.code, "text": finding}
