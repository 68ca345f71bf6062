# SPDX-License-Identifier: Apache-2.0
"""Holds the command lines ``msspl-fuse``, ``msspl-render`` and ``msspl``.

A command parses, calls one library function, and prints.
"""
