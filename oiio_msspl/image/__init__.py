# SPDX-License-Identifier: Apache-2.0
"""Pixels in arrays: storage, filters, colour, measures, and work in parallel."""
