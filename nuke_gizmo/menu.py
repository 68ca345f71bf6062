# SPDX-License-Identifier: Apache-2.0
# Nuke runs this file after init.py when it starts with a user interface.
import msspl_nuke

msspl_nuke.add_menu()
