# SPDX-License-Identifier: Apache-2.0
"""The exception that ends a fusion."""


class FuseError(Exception):
    """A sentence for the artist that says what is wrong and what to do."""
