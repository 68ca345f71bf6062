# SPDX-License-Identifier: Apache-2.0
"""The exceptions that end a fusion."""


class FuseError(Exception):
    """A sentence for the artist that says what is wrong and what to do."""


class Cancelled(Exception):
    """The artist pressed cancel."""
