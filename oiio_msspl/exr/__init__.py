# SPDX-License-Identifier: Apache-2.0
"""Read EXR files by rectangles, group channels into layers, and write the result and its preview."""
