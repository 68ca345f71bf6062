# SPDX-License-Identifier: Apache-2.0
"""The tiles of a pair: alignment, cutting, features, guards, and the network that fuses them."""
