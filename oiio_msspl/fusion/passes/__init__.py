# SPDX-License-Identifier: Apache-2.0
"""Fuses the passes of a frame so that they still sum to its beauty."""
