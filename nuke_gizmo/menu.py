# SPDX-License-Identifier: Apache-2.0
# Nuke runs this file after init.py when it starts with a user interface.
import nuke

nuke.menu("Nodes").addMenu("MSSPL").addCommand("MSSPLFuse", lambda: nuke.createNode("MSSPLFuse"))
