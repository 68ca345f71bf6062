# SPDX-License-Identifier: GPL-3.0-or-later
"""One sentence for the user."""


class Failure(Exception):
    """A job that can't be done; ``code`` is 2 for the caller's mistake, 1 for anything else."""

    def __init__(self, message, code=2):
        super().__init__(message)
        self.code = code


class Cancelled(Exception):
    """The user stopped it."""
