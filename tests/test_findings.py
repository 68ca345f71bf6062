# SPDX-License-Identifier: Apache-2.0
"""Warnings are text with a code."""

import pickle

from oiio_msspl.findings import Finding


def test_a_finding_of_a_worker_keeps_its_code():
    read = pickle.loads(pickle.dumps(Finding("clipped", "--float keeps them").about("left")))
    assert (read, read.code) == ("left: --float keeps them", "clipped")
