# SPDX-License-Identifier: Apache-2.0
"""Shots on many machines: Open Job Description and Dask."""
