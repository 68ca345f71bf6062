# SPDX-License-Identifier: Apache-2.0
"""Find the layers (AOVs) of a render that are the features of a network, and read them in documented units."""
