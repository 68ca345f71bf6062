# SPDX-License-Identifier: Apache-2.0
"""Warnings as data: a sentence for people, with a code for programs. ``docs/api.md`` has a table of the codes."""

from __future__ import annotations

from collections.abc import Iterable

from oiio_msspl.wording import worded


class Finding(str):
    """A sentence about a render, with a ``code`` that programs can test, one of those in ``docs/api.md``."""

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
