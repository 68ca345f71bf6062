# SPDX-License-Identifier: Apache-2.0
"""Pixels in arrays: storage, filters, sampling, colour, measures, and work on several cores."""
