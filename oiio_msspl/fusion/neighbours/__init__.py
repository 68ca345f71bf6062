# SPDX-License-Identifier: Apache-2.0
"""Averages a frame with its neighbours, as renders and as fused frames."""
