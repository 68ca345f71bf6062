# SPDX-License-Identifier: Apache-2.0
"""Pages as Chromium shows them."""

import shutil
import subprocess

#: Its program; None where it is not installed.
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def dump_dom(address):
    """The HTML of a page after its scripts have run for up to 10 s of the page's own time."""
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--window-size=800,600", "--virtual-time-budget=10000")
    command = [BROWSER, *options, "--dump-dom", address]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
