# SPDX-License-Identifier: Apache-2.0
"""What is reported of a fused frame."""

import json
from types import SimpleNamespace

import pytest

from oiio_msspl import Contract, InputOptions, fuse_files
from oiio_msspl._version import full_version
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.jobs.report import provenance, spp_warnings
from oiio_msspl.model.digests import digest
from tests.conftest import write_exr
from tests.shots import layers, low_layers


@pytest.fixture
def report_of(tmp_path, bilinear_models):
    """Fuse a x4 pair and return its report."""
    write_exr(tmp_path / "lr.exr", low_layers(1))
    write_exr(tmp_path / "hr.exr", layers(1))

    def report_of(lr_spp, hr_spp):
        return fuse_files(
            tmp_path / "lr.exr",
            tmp_path / "hr.exr",
            tmp_path / "out.exr",
            inputs=InputOptions(lr_spp=lr_spp, hr_spp=hr_spp),
            model=str(bilinear_models[4]),
            overwrite=True,
        )

    return report_of


def test_the_average_spp_counts_the_lrhs_by_its_pixels(report_of):
    """Section 5.1 of the paper: spp_LRHS / s^2 + spp_HRLS, and nothing if one of them is unknown."""
    assert report_of(64, 2).spp_avg == 64 / 16 + 2
    assert report_of(64, None).spp_avg is None


@pytest.mark.parametrize(
    ("lr_spp", "hr_spp", "message"),
    [
        (64, 2, None),
        (None, 2, None),
        (8, 4, None),  # a ninth of all samples
        (2, 2, "the LRHS has 2 spp and the HRLS 2: the method expects more in the low-resolution render"),
        (256, 2, "the LRHS has 256 spp; x was trained on 2 to 64"),
        (64, 0.5, "the HRLS has 0.5 spp; x was trained on 1 to 4"),
    ],
)
def test_spp_that_the_method_or_the_model_was_not_made_for_is_a_warning(lr_spp, hr_spp, message):
    contract = Contract(name="x", scale=4, training_spp={"hrls": [1, 4], "lrhs": [2, 64]})
    lr, hr = SimpleNamespace(spp=lr_spp), SimpleNamespace(spp=hr_spp)
    assert spp_warnings(lr, hr, contract) == ([message] if message else [])


def test_a_feature_of_the_file_that_the_model_does_not_read_is_unused(report_of):
    report = report_of(64, 2)
    rows = {row["feature"]: row for row in report.aovs()}
    assert (rows["albedo"]["status"], rows["variance"]["status"]) == ("found", "default")
    report.features = frozenset({"rgb"})
    rows = {row["feature"]: row for row in report.aovs()}
    assert (rows["albedo"]["status"], rows["albedo"]["source"]) == ("unused", "albedo")
    assert "variance" not in rows


def test_the_exr_says_what_it_was_made_from(report_of, bilinear_models):
    report = report_of(64, 2)
    stored = open_exr(report.output).metadata
    for name, value in provenance(report).items():
        assert stored[name] == value
    assert stored["msspl/spp_average"] == "6"
    assert stored["msspl/provider"] == "CPUExecutionProvider"
    model = bilinear_models[4]
    assert stored["msspl/weights"] == f"{model.stem} {digest(model)}"
    assert stored["msspl/version"] == report.as_dict()["version"] == full_version()
    assert report.as_dict()["weights"] == {model.stem: digest(model)}
    assert json.loads(json.dumps(report.as_dict()))["spp"] == {"lrhs": 64, "hrls": 2, "average": 6}
