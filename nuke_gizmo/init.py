# SPDX-License-Identifier: Apache-2.0
# Nuke runs this file at every start, also without a user interface, if the folder is on its plug-in path.
# Nuke finds the gizmo itself. This file imports no module of the folder, because an old Python could not parse it.
import sys

import nuke

if sys.version_info < (3, 9):  # noqa: UP036 (older versions of Nuke run this file too)
    nuke.tprint("MSSPLFuse needs Nuke 14 or later: the Python of this Nuke is older than 3.9")
