# SPDX-License-Identifier: Apache-2.0
"""Warnings as data: a sentence for people, with a code for programs. ``docs/api.md`` has a table of the codes."""

from __future__ import annotations

from collections.abc import Iterable


class Finding(str):
    """A sentence about a render, with a ``code`` that programs can test, one of those in ``docs/api.md``."""

    code: str

    def __new__(cls, code: str, text: str) -> Finding:
        finding = super().__new__(cls, text)
        finding.code = code
        return finding

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        """Return what a copy is made of: a worker's finding is pickled."""
        return self.code, str(self)

    def about(self, what: str) -> Finding:
        """Return the finding with the name of what it is about in front."""
        return Finding(self.code, f"{what}: {self}")


def codes_of(warnings: Iterable[str]) -> list[str]:
    """Return the code of each warning. One without a code was told by another program: ``other``."""
    return [getattr(warning, "code", "other") for warning in warnings]


def as_data(finding: Finding) -> dict[str, str]:
    """Return a finding as JSON values."""
    return {"code": finding.code, "text": finding}
