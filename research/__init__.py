# SPDX-License-Identifier: Apache-2.0
"""How the models were trained and measured. The library and the commands need nothing of it."""
