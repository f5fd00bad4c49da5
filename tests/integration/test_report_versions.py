"""Reports of earlier versions still correct rasters."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
import rasterio

import geodelreg
from geodelreg.errors import AlignmentRefusedError, ReportError
from geodelreg.product.report import report_dict, report_schema

OLD = Path(__file__).parents[1] / "data" / "reports" / "align_1.6.json"
SAMPLES = Path(__file__).parents[2] / "sample_tiles"


def test_a_report_of_schema_1_is_applied(tmp_path: Path) -> None:
    out = tmp_path / "out.tif"
    geodelreg.apply(OLD, SAMPLES / "ms.tif", out)
    said = json.loads(OLD.read_text("utf-8"))
    assert said["schema_version"] == "1.6"
    with rasterio.open(out) as dataset:
        expected = said["correction"]["corrected_geotransform"]
        assert dataset.transform.to_gdal() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("early", ["residual_rms_px", "residual_p95_px", "residual_interval_px"])
def test_what_an_early_report_lacks_is_not_known(tmp_path: Path, early: str) -> None:
    said = json.loads(OLD.read_text("utf-8")) | {"schema_version": "1.2"}
    del said["accuracy"][early]
    del said["options"]["on_local"]
    report = tmp_path / "early.json"
    report.write_text(json.dumps(said))
    geodelreg.apply(report, SAMPLES / "ms.tif", tmp_path / "out.tif")
    report.write_text(json.dumps(said | {"schema_version": "11.2"}))
    with pytest.raises(ReportError, match=r"of 11\.2"):
        geodelreg.apply(report, SAMPLES / "ms.tif", tmp_path / "again.tif")


def test_a_report_of_now_is_of_schema_2_and_a_refused_one_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(AlignmentRefusedError, match=r"uncertainty \(95 %\)") as refused:
        geodelreg.align(SAMPLES / "ms.tif", SAMPLES / "pan.tif", max_uncertainty_px=1e-4)
    alignment = refused.value.alignment
    assert alignment is not None
    report = json.loads(json.dumps(report_dict(alignment, tie_points=True)))
    jsonschema.validate(report, report_schema())
    assert report["schema_version"] == "2.0"
    assert "check" not in report["tie_points"]
    (reason,) = (r for r in report["verdict"]["reasons"] if r["name"] == "max_uncertainty")
    assert reason["value"] == pytest.approx(1.73 * alignment.accuracy.sigma_corner_px)
    assert "`max_uncertainty_px`" in refused.value.remedy
    for name, write in (("out.tif", geodelreg.write), ("out.points", geodelreg.export_gcps)):
        with pytest.raises(AlignmentRefusedError):
            write(alignment, tmp_path / name)
        assert not (tmp_path / name).exists()
