# SPDX-License-Identifier: Apache-2.0
"""EXR files: reading their headers and pixels, grouping channels into layers, writing the result and its preview."""
