# SPDX-License-Identifier: Apache-2.0
"""Tables keep what was measured and what it was measured with; pages are stamped from it."""

import re

import pytest

pytest.importorskip("torch")

from oiio_msspl._version import full_version
from research.benchmarks import results, tables, timer

STAMPED = {"version": "1", "machine": "m", "date": "2026-01-02"}


def test_a_table_keeps_four_digits_and_leaves_out_empty_cells(tmp_path):
    path = tmp_path / "table.csv"
    results.write(path, [{"method": "a, b", "psnr": 31.05678} | STAMPED, {"method": "c", "count": 3} | STAMPED])
    assert path.read_text() == (
        'method,psnr,count,model,digest,version,machine,date\n"a, b",31.06,,,,1,m,2026-01-02\nc,,3,,,1,m,2026-01-02\n'
    )
    rows = [{"method": "a, b", "psnr": 31.06} | STAMPED, {"method": "c", "count": 3} | STAMPED]
    assert results.read(path) == rows
    results.write(path, [{"method": "c", "psnr": 1.0} | STAMPED, {"method": "d"} | STAMPED], ("method",))
    assert [row.get("psnr") for row in results.read(path)] == [31.06, 1, None]
    results.write(path, [{"method": "d"} | STAMPED])
    assert len(results.read(path)) == 1


def test_new_rows_are_stamped_and_old_ones_keep_their_stamp(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "shipped_digest", {"joint-x2": "abc", None: None}.get)
    path = tmp_path / "table.csv"
    results.write(path, [{"method": "x", "model": "joint-x2"}, {"method": "y"}, {"method": "z"} | STAMPED])
    ours, peer, old = results.read(path)
    assert (ours["model"], ours["digest"]) == ("joint-x2", "abc") and "digest" not in peer
    for row in (ours, peer):
        assert row["version"] == full_version() and row["machine"] == results.processor()
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", row["date"])
    assert old == {"method": "z"} | STAMPED


def test_a_table_says_which_rows_are_older_than_their_model(monkeypatch):
    monkeypatch.setattr(results, "shipped_digest", {"a-x2": "new", "b-x2": "new", "c-x2": "new"}.get)
    rows = [{"model": f"{name}-x2", "digest": digest} | STAMPED for name, digest in (("a", "new"), ("b", "old"))]
    rows += [{"model": "c-x2", **STAMPED, "date": "2025-12-31", "version": "0"}, {"method": "OIDN"} | STAMPED]
    assert results.stamp_note(rows) == (
        "*Measured 2025-12-31 to 2026-01-02 with version 0 to 1, on m.* "
        "**Older than the model that ships** are rows of `b-x2`, `c-x2`."
    )
    assert "Older" not in results.stamp_note([rows[0], rows[3]])
    assert ", partly on m." in results.stamp_note([rows[0], {"version": "1", "date": "2026-01-02"}])


def test_a_mean_is_as_old_as_its_oldest_row():
    rows = [{"digest": "b", "date": "2026-02-01"}, {"digest": "a", "date": "2026-01-01", "psnr": 1}]
    assert results.oldest_stamp(rows) == {"digest": "a", "date": "2026-01-01"}
    assert results.oldest_stamp([*rows, {"psnr": 2}]) == {}


@pytest.mark.parametrize("path", sorted(results.FOLDER.glob("*.csv")), ids=lambda path: path.stem)
def test_every_row_says_what_it_was_measured_with(path):
    for row in results.read(path):
        assert "version" in row and "date" in row
        assert ("model" in row) == ("digest" in row)
        if model := results.model_of(row.get("method", "")):
            assert row["model"].removeprefix("gpu/") == model["model"]


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        ("flags\t\t: fpu avx2", "X without VNNI"),
        ("flags\t\t: fpu avx_vnni", "X with VNNI"),
        ("flags\t\t: fpu avx_vnni amx_int8", "X with AMX"),
        ("", "X"),
    ],
)
def test_a_time_says_what_the_processor_has_for_networks(flags, name):
    assert results.processor_in(f"model name\t: X\n{flags}\n") == name


def test_every_table_can_be_laid_out():
    """Each line has as many cells as its head, and below the table stands what it was measured with."""
    for blocks in tables.TABLES.values():
        for name, block in blocks.items():
            text = block() if callable(block) else block.text()
            (lines,) = [found.splitlines() for found in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE)]
            head, rule, *body = lines
            assert rule.replace(" ", "") == "|" + "---|" * (head.count("|") - 1)
            assert body and {line.count("|") for line in body} == {head.count("|")}, name
            assert re.search(r"^.*\*Measured 2", text, re.MULTILINE), name


def test_the_readme_has_one_table_of_six_rows_in_its_order():
    lines = tables.WHEN_IT_PAYS.text().splitlines()[2:8]
    names = [line.split("|")[1].strip() for line in lines]
    assert names[:4] == ["`--quality balanced`", "`--quality best`"] * 2
    assert names[4:] == ["OIDN on the HRLS, prefiltered", "OIDN at full resolution, prefiltered"]
    assert all(re.fullmatch(r"[\d.]+", cell.strip()) for line in lines for cell in line.split("|")[3:-1])


def test_a_page_has_its_tables_replaced():
    page = "a\n<!-- begin: table -->\nold\n<!-- end -->\nb\n"
    made = "a\n<!-- begin: table -->\n| new |\n<!-- end -->\nb\n"
    blocks = {"table": lambda: "| new |\n"}
    assert tables.laid_out(page, blocks) == made == tables.laid_out(made, blocks)
    with pytest.raises(SystemExit, match="no <!-- begin: table"):
        tables.laid_out("", blocks)


@pytest.mark.parametrize("path", tables.TABLES, ids=lambda path: path.name)
def test_pages_have_the_figures_that_were_measured(path):
    """`python -m research.benchmarks.tables` brings the pages up to date."""
    text = path.read_text()
    assert tables.laid_out(text, tables.TABLES[path]) == text


def test_a_page_that_is_out_of_date_fails_the_check(tmp_path, monkeypatch):
    page, measured = tmp_path / "page.md", tmp_path / "measured.csv"
    page.write_text("<!-- begin: t -->\nold\n<!-- end -->\n")
    measured.write_text(tables.measured_models())
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    monkeypatch.setattr(tables, "MEASURED", measured)
    monkeypatch.setattr(tables, "TABLES", {page: {"t": lambda: "new\n"}})
    monkeypatch.setattr("sys.argv", ["tables", "--check"])
    with pytest.raises(SystemExit, match=r"page\.md: out of date"):
        tables.main()
    monkeypatch.setattr("sys.argv", ["tables"])
    tables.main()
    assert page.read_text() == "<!-- begin: t -->\nnew\n<!-- end -->\n"


def test_a_finding_that_the_measures_dispute_is_no_agreement():
    def rows(*pairs):
        return [{"psnr": psnr, "relmse": relmse} for psnr, relmse in pairs]

    assert tables.verdict(rows((1, 0.5), (2, 0.4))) == "agrees"
    assert tables.verdict(rows((1, 0.5), (2, 0.6))) == "PSNR and RelMSE disagree"
    assert tables.verdict(rows((2, 0.5), (1, 0.6))) == "**differs**"
    assert "| PSNR and RelMSE disagree |" in tables.findings()


def job(log, name):
    """Append a name to a file; return the call that is timed."""
    with open(log, "a") as file:
        file.write(name)
    return lambda: sum(range(1000))


def test_jobs_take_turns_in_fresh_processes(tmp_path):
    log = str(tmp_path / "log")
    jobs = {name: timer.Function(f"{__name__}:job", (log, name), repeats=3) for name in "ab"}
    runs = timer.in_turn(jobs | {"c": ["true"]}, 2)
    assert (tmp_path / "log").read_text() == "abab"
    assert [len(run.seconds) for run in runs["a"]] == [3, 3] and len(runs["c"][0].seconds) == 1
    assert runs["a"][0].peak_mb > 5 and runs["a"][0].cpu_seconds > 0
    with pytest.raises(SystemExit, match="No module named nothing"):
        timer.run([timer.sys.executable, "-m", "nothing"])


def test_a_summary_is_the_median_of_all_calls_and_the_largest_memory():
    runs = [timer.Run((1.0, 9.0), 7.0, 10.0), timer.Run((2.0, 3.0), 9.0, 30.0), timer.Run((4.0,), 1.0, 20.0)]
    found = timer.summary(runs)
    assert (found["seconds"], found["fastest"], found["slowest"]) == (3.0, 1.0, 9.0)
    assert (found["cpu_seconds"], found["peak_mb"], found["rounds"]) == (7.0, 30.0, 3)
