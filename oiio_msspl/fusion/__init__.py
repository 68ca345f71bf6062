# SPDX-License-Identifier: Apache-2.0
"""The method: align a pair, cut it into tiles, guard against outliers, run the network, check the pair."""
