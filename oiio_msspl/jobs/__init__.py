# SPDX-License-Identifier: Apache-2.0
"""Jobs on files: a pair, a shot, and a shot on many machines."""
