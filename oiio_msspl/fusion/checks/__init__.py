# SPDX-License-Identifier: Apache-2.0
"""Do both renders of a pair belong together?"""
