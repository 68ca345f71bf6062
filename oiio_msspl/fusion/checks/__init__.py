# SPDX-License-Identifier: Apache-2.0
"""Checks that both renders of a pair belong together."""
