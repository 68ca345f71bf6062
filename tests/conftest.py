# SPDX-License-Identifier: Apache-2.0
"""Small renders and models that the tests make for themselves; nothing here needs files from outside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from oiio_msspl.model.contract import METADATA_KEY, SCALES, Contract
from oiio_msspl.model.encoding import MAX_RADIANCE

SHARED = Path(__file__).resolve().parents[2] / "shared"
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
#: OpenEXR 3.3 returns no headers without pixels.
HEADER_ONLY = not OpenEXR.__version__.startswith("3.3.")


#: Files and folders whose tests start programs, train, or run every model.
SLOW = (
    *("cli", "jobs/farm", "blender_addon/test_in_blender.py", "nuke_gizmo/test_msspl_nuke.py", "research/training"),
    *("model/test_devices.py", "model/test_joint_models.py", "test_package.py", "test_pages.py"),
    *("jobs/test_over_time.py", "jobs/test_over_time_views.py", "fusion/passes/test_fuse.py"),
)


def pytest_collection_modifyitems(config, items):
    """Leave out slow tests if neither a path nor a marker is given: the quick ones take about five minutes."""
    slow = tuple(Path(__file__).parent / name for name in SLOW)
    for item in items:
        if any(item.path.is_relative_to(path) for path in slow):
            item.add_marker(pytest.mark.slow)
    if not config.option.file_or_dir and not config.option.markexpr:
        config.hook.pytest_deselected(items=[item for item in items if item.get_closest_marker("slow")])
        items[:] = [item for item in items if not item.get_closest_marker("slow")]


def pytest_addoption(parser):
    parser.addoption("--at-least", type=int, default=0, metavar="N", help="fail if fewer than N tests pass")


def pytest_sessionfinish(session):
    """Tests that were not collected, or skipped for want of a package, must not look like success."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    least = session.config.getoption("--at-least")
    if reporter is not None and len(reporter.stats.get("passed", ())) < least:
        reporter.write_line(f"fewer than {least} tests passed", red=True)
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED


def needs_shared(*parts: str):
    """Mark a test that reads other people's files, which lie beside the project on some machines only."""
    path = SHARED.joinpath(*parts)
    return pytest.mark.skipif(not path.exists(), reason=f"{'/'.join(('shared', *parts))} is not here")


def write_exr(path, parts, *, display=None, compression=OpenEXR.ZIP_COMPRESSION, **attributes):
    """Write an EXR with OpenEXR's own module.

    ``parts``: a list of (name, {channel: array}, (x, y) of the data window), or one {channel: array}. Types follow the
    arrays' dtypes. A part may have attributes of its own, in a fourth place.
    """
    if isinstance(parts, dict):
        parts = [("", parts, (0, 0))]
    made, shown = [], display
    for name, channels, (x, y), *own in parts:
        height, width = next(iter(channels.values())).shape
        window = (np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32))
        shown = shown or window  # the parts of a file share one
        header = {
            "compression": compression,
            "type": OpenEXR.scanlineimage,
            "dataWindow": window,
            "displayWindow": shown,
            **attributes,
            **(own[0] if own else {}),
        }
        made.append(OpenEXR.Part(header, {k: np.ascontiguousarray(v) for k, v in channels.items()}, name))
    with OpenEXR.File(made) as file:
        file.write(str(path))
    return path


def rgb(values, prefix="", names="RGB"):
    """{channel name: plane} of an (h, w, c) array."""
    return {f"{prefix}{c}": values[..., i] for i, c in enumerate(names)}


def read_bits(path):
    """[(part name, {channel: array})] with OpenEXR's own reader, in stored types."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [
            (part.header.get("name", ""), {k: v.pixels.copy() for k, v in part.channels.items()}) for part in file.parts
        ]


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def picture(height, width, seed=0):
    """A smooth coloured picture with edges and a highlight, (height, width, 3) float32."""
    y, x = np.mgrid[0:height, 0:width] / max(height, width)
    base = np.stack([0.2 + 0.5 * x, 0.3 + 0.3 * np.sin(6 * y), 0.1 + 0.4 * x * y], axis=-1)
    base[(x - 0.5) ** 2 + (y - 0.4) ** 2 < 0.02] = (4.0, 3.0, 1.0)
    base[(x > 0.7) & (y > 0.2)] *= 0.05
    return base.astype(np.float32)


def noisy(clean, spp, seed=0):
    """Multiplicative noise of unit mean whose variance falls with spp, as path tracing's does."""
    rng = np.random.default_rng(seed)
    return (clean * rng.gamma(spp, 1 / spp, clean.shape)).astype(np.float32)


def spread(image, sigma):
    """An image whose pixels are Gaussian means of their neighbours, as a filter of ``sigma`` pixels makes them."""
    taps = np.exp(-0.5 * (np.arange(-2, 3) / sigma) ** 2)
    for axis in (0, 1):
        padded = np.pad(image, [(2, 2) if a == axis else (0, 0) for a in range(3)], mode="edge")
        shifted = [np.take(padded, np.arange(i, i + image.shape[axis]), axis) for i in range(5)]
        image = np.tensordot(taps / taps.sum(), shifted, 1)
    return image.astype(np.float32)


def downsample(values, scale):
    """Box average over scale x scale pixels."""
    height, width = values.shape[0] // scale, values.shape[1] // scale
    return values[: height * scale, : width * scale].reshape(height, scale, width, scale, -1).mean((1, 3))


@pytest.fixture(scope="session")
def bilinear_models(tmp_path_factory):
    """{scale: ONNX file} of models that upsample the LRHS bilinearly and ignore the HRLS: exact, local, no weights.
    They expect to be off by 0.1 everywhere."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    folder = tmp_path_factory.mktemp("models")
    made = {}
    for scale in SCALES:
        contract = Contract(name=f"bilinear-x{scale}", scale=scale, overlap=2, bytes_per_pixel=300)
        nodes = [
            helper.make_node("Mul", ["lrhs.rgb", "exposure"], ["exposed"]),
            helper.make_node("Clip", ["exposed", "nothing", "largest"], ["clipped"]),
            helper.make_node("Div", ["clipped", "exposure"], ["linear"]),
            helper.make_node("Resize", ["linear", "", "scales"], ["up"], mode="linear"),
            # Reads the HRLS without using it: a graph must use its inputs.
            helper.make_node("Mul", ["hrls.rgb", "nothing"], ["none"]),
            helper.make_node("Add", ["up", "none"], ["fused"]),
            helper.make_node("Slice", ["none", "zero", "one", "one"], ["plane"]),
            helper.make_node("Add", ["plane", "error"], ["log_error"]),
        ]
        constants = [
            helper.make_tensor("scales", TensorProto.FLOAT, [4], [1, 1, scale, scale]),
            helper.make_tensor("zero", TensorProto.INT64, [1], [0]),
            helper.make_tensor("one", TensorProto.INT64, [1], [1]),
            helper.make_tensor("nothing", TensorProto.FLOAT, [], [0.0]),
            helper.make_tensor("largest", TensorProto.FLOAT, [], [MAX_RADIANCE]),
            helper.make_tensor("error", TensorProto.FLOAT, [], [np.log(0.1)]),
        ]
        graph = helper.make_graph(
            nodes,
            "bilinear",
            [
                helper.make_tensor_value_info(
                    name, TensorProto.FLOAT, [1, count, *("hw" if name.startswith("lrhs") else "HW")] if count else []
                )
                for name, count in contract.inputs.items()
            ],
            [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, "H", "W"])
                for name, channels in (("fused", 3), ("log_error", 1))
            ],
            constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
        helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
        made[scale] = folder / f"bilinear-x{scale}.onnx"
        onnx.save(model, made[scale])
    return made
