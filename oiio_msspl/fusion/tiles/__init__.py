# SPDX-License-Identifier: Apache-2.0
"""Tiles of a pair: how both renders align, which features a tile has, and its guards against outliers."""
