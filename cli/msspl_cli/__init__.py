# SPDX-License-Identifier: Apache-2.0
"""The command lines ``msspl-fuse`` and ``msspl``. A command parses, calls one library function, and prints."""
