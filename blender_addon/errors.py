# SPDX-License-Identifier: GPL-3.0-or-later
"""The exceptions that end a job."""


class Failure(Exception):
    """A sentence for the user. ``code`` is 2 for the caller's mistake and 1 for any other failure."""

    def __init__(self, message: str, code: int = 2) -> None:
        super().__init__(message)
        self.code = code


class Cancelled(Exception):
    """The user cancelled the job."""
