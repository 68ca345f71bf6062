# SPDX-License-Identifier: Apache-2.0
"""Networks: what they read (contract, encoding), where they are (catalogue, weights/), and what runs them (session)."""
