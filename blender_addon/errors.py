# SPDX-License-Identifier: GPL-3.0-or-later
"""How a job ends when it does not succeed."""


class Failure(Exception):
    """One sentence for the user. ``code`` is 2 for the caller's mistake and 1 for any other failure."""

    def __init__(self, message, code=2):
        super().__init__(message)
        self.code = code


class Cancelled(Exception):
    """The user cancelled the job."""
