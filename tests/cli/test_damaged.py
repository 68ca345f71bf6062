# SPDX-License-Identifier: Apache-2.0
"""Damaged and hostile files: names, windows and attributes that no renderer writes."""

import json
import subprocess
import sys

import numpy as np
import OpenEXR
import pytest

from oiio_msspl import InputError, WriteOptions, fuse_files
from oiio_msspl.errors import printable
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.write_options import LAYOUTS
from tests import mutants
from tests.conftest import picture, read_bits, rgb, write_exr
from tests.programs import fuse, run
from tests.shots import HEIGHT, WIDTH, layers, low_layers, make_shot

#: Fuses damaged pairs in one process and prints, for each, what was done and the error.
FUSE_MUTANTS = """
import json, sys, time
from pathlib import Path
from oiio_msspl import fuse_files
from oiio_msspl.errors import explain
from tests.mutants import mutants
folder, model, count = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
(folder / "damaged").mkdir()
pairs = [(path.with_name("lr.exr"), path) for path in sorted(folder.glob("*/hr.exr"))]
for what, lr, hr in mutants(pairs, folder / "damaged", count, 3):
    start, said, code = time.monotonic(), "", 0
    try:
        fuse_files(lr, hr, folder / "out.exr", model=model, overwrite=True, max_memory=1 << 30)
    except Exception as error:
        said, code = explain(error)
    print(json.dumps([what, said, code, time.monotonic() - start]), flush=True)
"""


def test_damaged_pairs_are_fused_or_refused_by_a_sentence(tmp_path, bilinear_models):
    """25 of the mutants that ``python -m tests.mutants`` makes."""
    clean = picture(HEIGHT, WIDTH)
    parts = [("rgba", layers(1), (0, 0)), ("albedo", rgb(clean), (0, 0)), ("crypto", {"id.X": clean[..., 0]}, (0, 0))]
    for name, hr in (("one", layers(1)), ("several", parts)):
        (tmp_path / name).mkdir()
        write_exr(tmp_path / name / "hr.exr", hr, owner="somebody", capDate="2024:01:01 10:00:00")
        write_exr(tmp_path / name / "lr.exr", low_layers(1))
    command = [sys.executable, "-c", FUSE_MUTANTS, str(tmp_path), str(bilinear_models[4]), "25"]
    code, output, _, peak = mutants.run(command)
    lines = [json.loads(line) for line in output.splitlines() if line.startswith("[")]
    assert code == 0 and len(lines) == 25, output
    assert [line for line in lines if "unexpected" in line[1] or line[2] == 1 or line[3] > 10] == []
    assert {line[2] for line in lines} == {0, 2}
    if sys.platform == "linux":
        assert peak < 1024
    assert sorted(path.name for path in tmp_path.glob(".*")) == []


def test_the_tool_finds_what_no_run_may_do(tmp_path):
    assert mutants.fault(0, "fine\n", 1, 100, 1000) == ""
    assert mutants.fault(-11, "", 1, 100, 1000) == "ended with -11"
    assert mutants.fault(2, "unexpected ValueError", 1, 100, 1000)
    assert mutants.fault(1, "Traceback (most", 1, 100, 1000)
    assert mutants.fault(0, "", 31, 100, 1000) == "took 31 s"
    assert mutants.fault(0, "", 1, 1001, 1000) == "took 1001 MiB"
    assert mutants.fault(0, "a\x1b[2J", 1, 1, 1000) and mutants.fault(0, "openjd_env: A=B", 1, 1, 1000)


# ------------------------------------------------------------------------------------------------ names


def renamed(path, old, new):
    """Replace a name in a file's header by one of the same length."""
    data = path.read_bytes()
    assert old in data and len(old) == len(new)
    path.write_bytes(data.replace(old, new))
    return path


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"Lamp.R", b"L\xe4mp.R"),
        (b"matte", b"m\xe4tte"),
        (b"extra", b"\xe4\xf6\xfc\xdf\xe9"),
        (b"Herr Muller", b"Herr M\xfcller"),
        (b"artist", b"k\xfcnstl"),
    ],
)
def test_latin_1_names_and_texts_are_read_and_written_as_utf_8(tmp_path, bilinear_models, layout, old, new):
    """As channels, parts, texts and names of attributes. The single-part layout refuses texts that it can't copy."""
    lr = write_exr(tmp_path / "lr.exr", low_layers(1))
    mask = {"matte": picture(HEIGHT, WIDTH)[..., 0], "Lamp.R": picture(HEIGHT, WIDTH)[..., 1]}
    parts = [("rgba", layers(1), (0, 0)), ("extra", mask, (0, 0))]
    hr = renamed(write_exr(tmp_path / "hr.exr", parts, artist="Herr Muller"), old, new)
    more = {"model": str(bilinear_models[4]), "write": WriteOptions(layout)}
    out = tmp_path / "out.exr"
    if layout == "multilayer" and old not in (b"matte", b"Lamp.R"):
        with pytest.raises(InputError, match="not UTF-8; use --layout spec"):
            fuse_files(lr, hr, out, **more)
        return
    fuse_files(lr, hr, out, **more)
    file = open_exr(out)
    names = {name for part in file.parts for name in (part.name, *(c.name for c in part.channels))}
    if old not in (b"Herr Muller", b"artist"):
        assert any(new.decode("latin-1").removesuffix(".R") in name for name in names), names
    else:
        assert "Herr M\xfcller" in file.metadata.values() or "k\xfcnstl" in file.metadata


def test_a_path_that_is_not_utf_8_is_refused_by_a_sentence(tmp_path, bilinear_models):
    lr = write_exr(tmp_path / "lr.exr", low_layers(1))
    hr = write_exr(tmp_path / "hr.exr", layers(1)).rename(tmp_path / "h\udce4.exr")
    with pytest.raises(InputError, match="is not UTF-8"):
        fuse_files(lr, hr, tmp_path / "out.exr")
    with pytest.raises(InputError, match="is not UTF-8"):
        fuse_files(lr, lr, tmp_path / "o\udce4.exr")


@pytest.mark.parametrize("bad", ["\n", "\r", "\x1b[2J", "\x9b2J", "\x07", "\u2028", "\u202e", "\udce4", "\0"])
def test_control_characters_are_printed_as_escapes(bad):
    text = printable(f"layer {bad} in ä€名😀")
    assert text.startswith("layer \\") and text.endswith(" in ä€名😀") and len(text.splitlines()) == 1
    assert not set(bad) - set("[2J") & set(text)
    assert text.encode()


HOSTILE = b"\nopenjd_env: A=B\x1b[2J"


def hostile(path):
    return renamed(path, b"x" * len(HOSTILE), HOSTILE)


def test_names_out_of_files_reach_neither_terminal_nor_farm(tmp_path, bilinear_models):
    """Printed by every command: as a layer that is read, that is passed on, and in errors and their reports."""
    folder, name = make_shot(tmp_path, 1), "x" * len(HOSTILE)
    plane = picture(HEIGHT, WIDTH)
    frame = folder / "hr/beauty.1001.exr"
    hostile(write_exr(frame, layers(1) | rgb(plane, f"{name}.") | {f"{name}.Q": plane[..., 0]}))
    lr = folder / "lr/lr.1001.exr"
    bare = hostile(write_exr(folder / "bare.exr", {f"{name}.Q": plane[..., 0]}))
    albedo = ["--map", f"albedo={HOSTILE.decode()}"]
    commands = [
        run("msspl", "inspect", frame),
        run("msspl", "inspect", bare),
        fuse(lr, frame, "-o", folder / "a.exr", "--model", bilinear_models[4], *albedo, "-vv"),
        fuse(lr, frame, "-o", folder / "b.exr", "--model", bilinear_models[4], "--layers", "none", "--map", "normal=Z"),
        fuse(lr, frame, "-o", folder / "c.exr", "--layers", "nothing"),
        fuse(lr, bare, "-o", folder / "d.exr"),
        *(
            fuse(folder / "lr", folder / "hr", "-o", folder / f"o{form}", *more, "--model", bilinear_models[4], *albedo)
            for form, more in enumerate((["--progress", "openjd"], ["--progress", "json"], ["-v"], ["--json"]))
        ),
        fuse(folder / "lr", folder / "hr", "-o", folder / "e", "--progress", "openjd", "--layers", "nothing"),
    ]
    shown = 0
    for done in commands:
        output = done.stdout + done.stderr
        assert not any(line.startswith("openjd_env") for line in output.split("\n")), output
        assert all(line.isprintable() for line in output.split("\n")), output
        shown += "openjd_env" in output
    assert shown >= 7, [done.stdout + done.stderr for done in commands]


def test_thousands_of_channels_are_fused(tmp_path, bilinear_models):
    """OpenImageIO's own limit is 1,024."""
    lr, plane = write_exr(tmp_path / "lr.exr", low_layers(1)), np.zeros((HEIGHT, WIDTH), np.float16)
    hr = write_exr(tmp_path / "hr.exr", layers(1) | {f"lights.{i:04d}": plane for i in range(1100)})
    fuse_files(lr, hr, tmp_path / "out.exr", model=str(bilinear_models[4]), write=WriteOptions("multilayer"))
    assert len(read_bits(tmp_path / "out.exr")[0][1]) == len(layers(1)) + 1100


def test_what_a_file_claims_to_be_is_refused_in_words_that_help(tmp_path):
    """Not by advice for the programmers of the library."""
    path = write_exr(tmp_path / "hr.exr", layers(1), compression=OpenEXR.NO_COMPRESSION)
    data = bytearray(path.read_bytes())
    window = next(attribute for attribute in mutants.attributes(data) if attribute.name == "dataWindow")
    data[window.size + 12 : window.size + 16] = (2**24).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(InputError, match="can't be opened as an EXR") as caught:
        open_exr(path)
    assert "raise the" not in str(caught.value)


def test_an_error_that_quotes_bytes_of_the_file_is_reported(tmp_path, monkeypatch):
    """OpenImageIO's binding can't decode such a message."""

    class Source:
        def geterror(self):
            return b"Corrupt channel \xdf".decode("utf-8")

        def read_scanlines(self, *arguments):
            return None

    file = open_exr(write_exr(tmp_path / "hr.exr", layers(1)))
    monkeypatch.setitem(file.__dict__, "_input", Source())
    with pytest.raises(InputError, match=r"hr\.exr: part 0 .* can't be read \(its header or its pixels are damaged\)"):
        file.read(file.parts[0].channels, file.parts[0].data_window)


def test_the_tool_reports_exit_codes_and_signals_as_they_are():
    assert mutants.run([sys.executable, "-c", "print('on'); raise SystemExit(2)"])[:2] == (2, "on\n")
    if sys.platform != "win32":
        assert mutants.run([sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"])[0] == -9
    assert subprocess.run([sys.executable, "-m", "tests.mutants", "--help"], capture_output=True).returncode == 0
