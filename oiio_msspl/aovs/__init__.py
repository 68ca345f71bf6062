# SPDX-License-Identifier: Apache-2.0
"""AOVs: which layers of a render are the features that the network reads, and reading them in documented units."""
