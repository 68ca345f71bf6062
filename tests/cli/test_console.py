# SPDX-License-Identifier: Apache-2.0
"""What people see on a terminal, and what a pipe gets."""

import json
import logging
import os
import subprocess
import sys

import pytest
from msspl_cli import console, options

from tests.shots import make_shot

LONG = "layer [bold] with a :smile: and a name that is much longer than the eighty columns of a terminal " * 2


def test_a_piped_table_is_plain_text(capsys):
    """Names are neither wrapped nor taken for rich's markup; columns are aligned, and no line ends in spaces."""
    console.table([("name", "b"), (LONG, "warning"), ("", "x")])
    lines = capsys.readouterr().out.splitlines()
    width = len(LONG)
    assert lines == [f"  {'name':{width}}  b", f"  {LONG}  warning", f"  {'':{width}}  x"]


def test_names_that_a_stream_can_not_encode_are_escaped(tmp_path):
    """Such a pipe is usual on Windows. The frames go on."""
    folder = make_shot(tmp_path / "\u65e5", 1)
    code = "from msspl_cli.app import msspl; msspl()"
    command = [sys.executable, "-c", code, "inspect", str(folder / "hr/beauty.1001.exr")]
    done = subprocess.run(command, capture_output=True, env=os.environ | {"PYTHONIOENCODING": "cp1252"})
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"\u65e5" in done.stdout


@pytest.mark.parametrize("closed", ["1", "2"])
def test_a_closed_stream_is_no_fault(tmp_path, bilinear_models, closed):
    """As a daemon has it."""
    folder = make_shot(tmp_path, 1)
    code = "from msspl_cli.app import msspl_fuse; msspl_fuse()"
    pair = [str(folder / name) for name in ("lr/lr.1001.exr", "hr/beauty.1001.exr")]
    command = [sys.executable, "-c", code, *pair, "-o", str(folder / "o.exr"), "--model", str(bilinear_models[4])]
    done = subprocess.run(["sh", "-c", f'exec "$@" {closed}>&-', "sh", *command])
    assert done.returncode == 0 and (folder / "o.exr").exists()


@pytest.mark.parametrize(
    ("row", "text"),
    [
        (("albedo", "default", ""), "none: expect blur, render an albedo (or name it with --map albedo=LAYER)"),
        (("variance", "default", ""), "none (optional)"),
        (("normal", "found", "N"), "found: N"),
        (("diffuse", "computed", "a + b"), "computed: a + b (scaled)"),
        (("variance", "unused", "v"), "not read: v"),
        (("alpha", "absent", ""), "none"),
    ],
)
def test_where_a_feature_comes_from_is_said_in_words(capsys, row, text):
    feature, status, source = row
    note = "scaled" if status == "computed" else ""
    console.aov_table([{"feature": feature, "status": status, "source": source, "note": note}], ["n"])
    assert capsys.readouterr().out == f"  {feature}  {text}\n  note: n\n"


def test_the_library_s_log_is_printed_like_all_other_messages(capsys, monkeypatch):
    """In lower case, as Nuke's node reads it, and on one line."""
    monkeypatch.setattr(logging.root, "handlers", [])
    monkeypatch.setattr(logging.root, "level", logging.root.level)
    options.set_up_logging(verbose=1, quiet=False)
    logging.getLogger("oiio_msspl.jobs.shot").warning("frame %d: a\nb", 3)
    logging.info("step 1 of 2")
    assert capsys.readouterr().err == "warning: frame 3: a\\nb\ninfo: step 1 of 2\n"


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
def test_progress_is_drawn_on_the_terminal_and_not_in_the_data(tmp_path, bilinear_models):
    """With standard error on a terminal and standard output in a pipe: a bar, whole messages, and clean JSON."""
    make_shot(tmp_path, 4)
    (tmp_path / "hr/beauty.1003.exr").write_text("no EXR")
    reader, terminal = os.openpty()
    code = "import sys; from msspl_cli.app import msspl_fuse as main; sys.argv[0] = 'msspl-fuse'; main()"
    options = ["--model", bilinear_models[4], "--no-preview", "--json"]
    arguments = [tmp_path / "lr", tmp_path / "hr", "-o", tmp_path / "out", *options]
    with subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=terminal,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "200"},
    ) as process:
        out = process.stdout.read()
    said = os.read(reader, 100_000).decode()
    assert json.loads(out)["counts"]["fused"] == 3
    assert "4 of 4 frames, 1 not fused" in said
    assert said.count("error: frame 1003: ") == 1
    assert said.rindex("\033[?25h") > said.index("\033[?25l")  # the cursor is shown again
