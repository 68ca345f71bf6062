# SPDX-License-Identifier: Apache-2.0
# Nuke runs this after init.py, where it has a user interface.
import msspl_nuke

msspl_nuke.add_menu()
