# SPDX-License-Identifier: Apache-2.0
"""The version that every result names."""

import shutil
import subprocess
import sys

import pytest

from oiio_msspl import __version__, _version


def version_of(folder):
    """full_version() of a copy of the package in a folder."""
    package = folder / "oiio_msspl"
    package.mkdir()
    shutil.copy(_version.__file__, package / "_version.py")
    (package / "__init__.py").touch()
    code = "from oiio_msspl._version import full_version; print(full_version())"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env={"PATH": "/usr/bin:/bin"}, capture_output=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.decode().strip()


@pytest.mark.skipif(shutil.which("git") is None, reason="there is no git")
def test_the_version_names_the_commit_in_a_checkout_only(tmp_path):
    """A package that is installed inside of a repository of something else has no commit."""
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "first"], check=True)
    commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], check=True, capture_output=True).stdout.decode()
    installed = tmp_path / "site-packages"
    installed.mkdir()
    assert version_of(tmp_path) == f"{__version__}+{commit.strip()}"
    assert version_of(installed) == __version__


def test_a_checkout_without_git_has_only_the_version(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert _version.full_version.__wrapped__() == __version__
