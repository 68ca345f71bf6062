# SPDX-License-Identifier: Apache-2.0
"""The gizmo's file, read by real Tcl interpreters."""

import pytest
from msspl_bridge.command import Settings

from oiio_msspl.aovs.features import FEATURES
from oiio_msspl.jobs.plan import MOST, TemporalOptions
from oiio_msspl.model.catalogue import DEFAULT_QUALITY, QUALITIES
from oiio_msspl.model.devices import PROVIDERS
from tests.nuke_gizmo.conftest import GIZMO
from tests.nuke_gizmo.gizmo_file import read_script, tcl_interpreters


def knob(nodes, name):
    return next(knob for knob in nodes[1].user_knobs if knob.name == name)


@pytest.mark.skipif(not tcl_interpreters(), reason="no Tcl interpreter: neither tkinter nor tclsh")
def test_every_tcl_interpreter_reads_the_same_gizmo():
    results = [read_script(GIZMO, interpreter) for interpreter in tcl_interpreters()]
    assert all(result == results[0] for result in results)


def test_inputs_are_in_order_and_the_output_is_the_hrls(nodes):
    assert [node.kind for node in nodes.values()] == ["Gizmo", "Input", "Input", "Output"]
    assert {node.parent for node in list(nodes.values())[1:]} == {1}
    inputs = sorted((int(n.knobs.get("number", 0)), n.knobs["name"]) for n in nodes.values() if n.kind == "Input")
    assert inputs == [(0, "HRLS"), (1, "LRHS")]
    (connected,) = nodes[4].inputs
    assert nodes[connected].knobs["name"] == "HRLS"


def test_every_knob_has_its_kind_its_default_and_a_tooltip(nodes):
    gizmo = nodes[1]
    kinds = {k.name: k.kind for k in gizmo.user_knobs if k.name}
    text, file, number, menu, tick, tab, button, shown, lines = 1, 2, 3, 4, 6, 20, 22, 26, 43
    assert kinds == {
        **{
            "msspl": tab,
            "output": file,
            "quality": menu,
            "device": menu,
            "mapping": lines,
            "layers": text,
            "passes": text,
            "temporal": menu,
        },
        **{"overwrite": tick, "fuse_frame": button, "frames": text, "fuse_range": button, "submit_range": button},
        **{"found": shown, "rebuild": button},
        **{"setup": tab, "program": file, "model": text, "options": text, "chunk": number, "submit": text},
    }
    assert {name: gizmo.knobs[name] for name in kinds if name in gizmo.knobs} == {
        "overwrite": "true",
        **{"quality": "balanced", "chunk": "10", "submit": "deadline bundle submit --yes"},
    }
    assert all("t" in k.options for k in gizmo.user_knobs if k.name and k.kind != tab), "a knob without a tooltip"
    assert "LRHS" in gizmo.knobs["help"]


def test_the_device_menu_lists_the_devices_of_msspl_fuse(nodes):
    assert knob(nodes, "device").items == list(PROVIDERS)


def test_the_menu_of_neighbours_has_what_msspl_fuse_takes(nodes):
    items = knob(nodes, "temporal").items
    assert items == ["auto", "off", *map(str, range(1, MOST + 1))]
    assert items[0] == Settings.temporal
    assert [TemporalOptions(item).count() for item in items] == [4, 0, *range(1, MOST + 1)]


def test_the_menu_of_qualities_has_the_names_of_the_command_line(nodes):
    assert knob(nodes, "quality").items == list(QUALITIES)
    assert nodes[1].knobs["quality"] == Settings.quality == DEFAULT_QUALITY


def test_the_tooltips_name_every_quality_and_every_feature(nodes):
    quality, model, mapping = (knob(nodes, name).options["t"] for name in ("quality", "model", "mapping"))
    assert set(QUALITIES) <= set(quality.replace(":", " ").split())
    assert {"joint-spread", "paper"} <= set(model.replace(":", " ").split())
    assert set(FEATURES) <= set(mapping.replace(",", " ").replace(".", " ").split())
