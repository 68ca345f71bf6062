# SPDX-License-Identifier: Apache-2.0
# Nuke runs this when the folder is on its plug-in path, farms included. Being there is all that the gizmo needs.
import sys

import nuke

if sys.version_info < (3, 9):  # noqa: UP036 (older Nukes run this file, too)
    nuke.tprint("MSSPLFuse needs Nuke 14 or later: this one has Python older than 3.9")
