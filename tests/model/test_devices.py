# SPDX-License-Identifier: Apache-2.0
"""Which file and which execution providers a device gets, and what is said if it cannot run the model."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest

from oiio_msspl import Session, find_model
from oiio_msspl.errors import InputError
from oiio_msspl.model import devices, runtime, session
from oiio_msspl.model.catalogue import WEIGHTS
from oiio_msspl.model.contract import ONE_SIZE, SCALES, Contract
from oiio_msspl.model.devices import PROVIDERS, file_for, gpu_file, providers, require_device
from oiio_msspl.model.encoding import encode_radiance
from tests.conftest import SHARED, needs_shared

CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
#: Files for GPUs, relative to the folder of the weights.
FAMILIES = tuple(family + noise for family in ("joint-small", "joint", "joint-large") for noise in ("", "-spread"))
GPU_FILES = [f"gpu/{path.name}" for path in sorted(WEIGHTS.glob("gpu/*.onnx"))]


def test_a_gpu_gets_the_file_that_was_made_for_it(tmp_path):
    for name in ("a.onnx", "b.onnx", "gpu/a.onnx"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    a, b = tmp_path / "a.onnx", tmp_path / "b.onnx"
    assert file_for(a, "cpu") == a
    assert file_for(a, "cuda") == file_for(a, "coreml") == tmp_path / "gpu" / "a.onnx"
    assert file_for(b, "cuda") == b and gpu_file(b) is None
    assert [gpu_file(find_model(scale)) for scale in SCALES] == [WEIGHTS / f"gpu/joint-x{s}.onnx" for s in SCALES]


@pytest.mark.parametrize("scale", (ONE_SIZE, *SCALES))
@pytest.mark.parametrize("family", FAMILIES)
def test_a_frame_has_the_same_tiles_on_a_gpu(family, scale):
    """Everything but the provenance is the same in the contracts of both files."""
    cpu, gpu = (Contract.of_file(path(find_model(scale, family))).__dict__ for path in (Path, gpu_file))
    assert "half floats" in gpu["provenance"]["precision"]
    assert cpu["provenance"].items() <= gpu["provenance"].items()
    assert cpu | {"provenance": None} == gpu | {"provenance": None}


@pytest.mark.parametrize("scale", (ONE_SIZE, *SCALES))
@pytest.mark.parametrize("family", FAMILIES)
def test_the_files_for_gpus_compute_the_same(family, scale):
    """To less than the noise of the pair takes: the file for CPUs has activations of 8 bits."""
    rng = np.random.default_rng(0)
    smooth = np.linspace(0.1, 0.9, 128)[:, None, None] * np.linspace(0.2, 1, 256)[None, :, None]
    colour = (smooth * rng.gamma(16, 1 / 16, (128, 256, 3))).astype(np.float32)
    aov = np.full_like(colour, 0.5)
    hrls = {"rgb": colour, "albedo": aov, "normal": aov}
    lrhs = {name: np.ascontiguousarray(image[::scale, ::scale]) for name, image in hrls.items()}
    lrhs["rgb"] = (smooth[::scale, ::scale] * rng.gamma(64, 1 / 64, lrhs["rgb"].shape)).astype(np.float32)
    on_cpu, on_gpu = (Session(path(find_model(scale, family))) for path in (Path, gpu_file))
    shares = dict.fromkeys(on_cpu.contract.lrhs, 0.6)
    error = (family, scale) != ("joint-large", ONE_SIZE)
    one, other = (s.run(lrhs, hrls, 1.0, shares, error=error, aovs=s.clean_aovs) for s in (on_cpu, on_gpu))
    assert one.keys() == other.keys() == {"fused", *(["error"] if error else []), *on_cpu.clean_aovs}
    encoded, gpu, samples = (encode_radiance(i, 1.0) for i in (one["fused"], other["fused"], colour))
    assert np.abs(encoded - gpu).mean() < 0.1 * np.abs(encoded - samples).mean()
    assert not error or np.abs(np.log(one["error"] / other["error"])).mean() < 0.2
    for name in on_cpu.clean_aovs:
        assert np.abs(one[name] - other[name]).mean() < 0.01


def test_onnxruntime_that_has_overwritten_the_package_for_gpus_is_named(monkeypatch):
    monkeypatch.setattr(devices, "usable_devices", lambda: ["cpu"])
    installed = [SimpleNamespace(name="onnxruntime"), SimpleNamespace(name="onnxruntime-gpu")]
    monkeypatch.setattr(devices, "distributions", lambda: installed)
    with pytest.raises(InputError, match="onnxruntime has overwritten onnxruntime-gpu; uninstall both"):
        require_device("cuda")
    monkeypatch.setattr(devices, "distributions", lambda: installed[:1])
    with pytest.raises(
        InputError, match="has no CUDAExecutionProvider; usable here: cpu; to add cuda, install onnxruntime-gpu"
    ):
        require_device("cuda")


def test_settings_of_the_providers(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tensorrt, settings), (cuda, _), (cpu, _) = providers("tensorrt")
    assert (tensorrt, cuda, cpu) == ("TensorrtExecutionProvider", CUDA, CPU)
    assert Path(settings["trt_engine_cache_path"]).is_dir() and settings["trt_engine_cache_enable"] == "1"
    assert providers("openvino")[0][1]["device_type"] == "AUTO:GPU,CPU"
    assert providers("coreml")[0][1] == {"ModelFormat": "MLProgram"}
    assert providers("cpu") == [(CPU, {})]


@pytest.fixture
def only_the_cpu(monkeypatch):
    """Every device can be asked for, and the CPU computes."""
    monkeypatch.setattr(session, "require_device", lambda device: None)
    monkeypatch.setattr(session, "providers", lambda device: [(CPU, {})])


def test_a_device_that_cannot_start_is_refused(only_the_cpu, bilinear_models):
    with pytest.raises(InputError, match="--device cuda could not start"):
        Session(bilinear_models[2], "cuda")


#: Older versions do not say where an operator runs.
says_where = pytest.mark.skipif(
    not hasattr(onnxruntime.InferenceSession, "get_provider_graph_assignment_info"),
    reason="this onnxruntime does not count convolutions",
)


@says_where
def test_convolutions_that_stay_on_the_cpu_are_refused(only_the_cpu, monkeypatch, caplog):
    """Where the device has operators for all of them; elsewhere a warning tells."""
    for device in ("cuda", "openvino"):
        monkeypatch.setitem(session.PROVIDERS, device, CPU)
    with pytest.raises(InputError, match=r"cuda: .*joint-x2.onnx: 38 of 38 convolutions stay on the CPU; use"):
        Session(find_model(2), "cuda")
    Session(find_model(2), "openvino")
    assert "38 of 38 convolutions stay on the CPU" in caplog.text


@says_where
def test_convolutions_are_counted():
    assert Session(find_model(2)).convolutions == {CPU: 36}
    assert Session(find_model(2, "paper")).convolutions.keys() == {CPU}


def test_the_predicted_error_is_computed_when_it_is_wanted():
    model, asked = Session(find_model(2, "joint")), []
    run = model._session.run
    model._session.run = lambda outputs, *others: asked.append(outputs) or run(outputs, *others)
    pair = {"rgb": np.zeros((32, 48, 3), np.float32)}, {"rgb": np.zeros((64, 96, 3), np.float32)}
    model.run(*pair, 1.0, {})
    asked.clear()  # the first run also releases memory
    assert model.run(*pair, 1.0, {}).keys() == {"fused"}
    assert model.run(*pair, 1.0, {}, error=True)["error"].shape == (64, 96, 1)
    assert asked == [["fused"], ["fused", "log_error"]]


def test_cuda_libraries_that_pip_installed_are_loaded(monkeypatch, capsys, bilinear_models):
    import onnxruntime

    calls = []
    monkeypatch.setattr(onnxruntime, "preload_dlls", lambda: calls.append(1) or print("Failed to load"), raising=False)
    runtime.load_network(bilinear_models[2], 1)
    assert not calls
    runtime._load_cuda()
    assert calls and not capsys.readouterr().out


# The real CUDA provider on libraries that do nothing. It divides a graph as on a machine with a GPU.


@pytest.fixture(scope="module")
def python_with_cuda():
    """A Python with onnxruntime-gpu and OpenImageIO: MSSPL_TEST_GPU, this one, or ~/venvs/gpu/bin/python."""
    named = os.environ.get("MSSPL_TEST_GPU")
    for python in [named] if named else [sys.executable, str(Path.home() / "venvs/gpu/bin/python")]:
        check = "import OpenImageIO, onnxruntime as o; assert 'CUDAExecutionProvider' in o.get_available_providers()"
        if Path(python).exists() and not subprocess.run([python, "-c", check], capture_output=True).returncode:
            return python
    pytest.skip("no Python with onnxruntime-gpu; name one in MSSPL_TEST_GPU")


@pytest.fixture(scope="module")
def stubs(python_with_cuda, tmp_path_factory):
    """A folder with CUDA libraries that do nothing."""
    if not shutil.which("gcc"):
        pytest.skip("no gcc")
    folder = tmp_path_factory.mktemp("stubs")
    tool = SHARED / "tools/cuda-stub/placement.py"
    subprocess.run([python_with_cuda, tool, "--build", folder], check=True, capture_output=True)
    return folder


@needs_shared("tools", "cuda-stub")
@pytest.mark.parametrize("name", GPU_FILES)
def test_every_operator_runs_on_the_gpu(name, python_with_cuda, stubs):
    """But those that compute sizes of images, and nothing is copied between GPU and CPU but the inputs and outputs."""
    tool = SHARED / "tools/cuda-stub/placement.py"
    command = [python_with_cuda, tool, "--stubs", stubs, WEIGHTS / name]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert not found["on_cpu"]
    assert found["nodes"][CUDA] > 10 * sum(found["on_cpu"].values()) and found["copies"] == 0


@needs_shared("tools", "cuda-stub")
def test_a_session_says_that_all_convolutions_run_on_the_gpu(python_with_cuda, stubs):
    code = (
        # It would load pip's CUDA library, which needs a GPU
        "import json, onnxruntime; onnxruntime.preload_dlls = lambda: None\n"
        "from oiio_msspl.model.session import Session; from oiio_msspl.model.catalogue import find_model\n"
        "print(json.dumps([Session(find_model(s), 'cuda').convolutions for s in (2, 4, 8)]))"
    )
    environment = os.environ | {"LD_LIBRARY_PATH": str(stubs), "PYTHONPATH": str(WEIGHTS.parents[2])}
    done = subprocess.run([python_with_cuda, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [counts.keys() for counts in found] == [{CUDA}] * 3
    assert all(counts[CUDA] > 30 for counts in found)


def test_only_tensorrt_makes_a_folder_for_its_engines(tmp_path, monkeypatch):
    """A worker of a farm may have no home that it can write to."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for device in set(PROVIDERS) - {"tensorrt"}:
        providers(device)
    assert not list(tmp_path.iterdir())
    assert providers("tensorrt")[0][1]["trt_engine_cache_path"] == str(tmp_path / "oiio_msspl" / "tensorrt")
