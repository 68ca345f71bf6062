# SPDX-License-Identifier: Apache-2.0
"""The part of the gizmo that does not import nuke: file names, the command line of msspl-fuse, and its process.

It uses the standard library only and Python 3.9 syntax, because Nuke 14 runs it in its own Python.
"""


class FuseError(Exception):
    """A sentence for the artist that says what is wrong and what to do, and ends a fusion."""
