# SPDX-License-Identifier: Apache-2.0
"""How a fusion ends when it does not succeed."""


class FuseError(Exception):
    """One sentence for the artist that says what is wrong and what to do."""


class Cancelled(Exception):
    """The artist pressed cancel."""
