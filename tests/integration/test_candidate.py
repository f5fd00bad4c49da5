"""What was refused is kept on request, and is not taken for a result."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

import geodelreg
from geodelreg.errors import AlignmentRefusedError, OutputExistsError, ReportError, UsageError
from geodelreg_cli.main import cli

SAMPLES = Path(__file__).parents[2] / "sample_tiles"
MS, PAN = SAMPLES / "ms.tif", SAMPLES / "pan.tif"


@pytest.fixture(scope="module")
def accepted() -> geodelreg.Alignment:
    return geodelreg.align(MS, PAN)


def test_the_command_keeps_what_was_refused(accepted: geodelreg.Alignment, tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    command = ["align", str(MS), str(PAN), "-o", str(tmp_path / "out.tif"), "--max-shift", "2"]
    run = CliRunner().invoke(cli, [*command, "--keep-candidate", str(folder)])
    assert isinstance(run.exception, AlignmentRefusedError)
    assert {path.name for path in tmp_path.iterdir()} == {"kept"}
    assert {path.suffix for path in folder.iterdir()} == {".json", ".geojson", ".png"}
    told = json.loads((folder / "refused_candidate.json").read_text("utf-8"))
    expected = accepted.correction.corrected.to_gdal()
    # pixels of 10 m; with the limit the search goes another way
    assert told["refused_geotransform"] == pytest.approx(expected, abs=0.1)
    assert "PAN px shift" in told["because"][0]
    points = json.loads((folder / "refused_candidate.geojson").read_text("utf-8"))
    assert len(points["features"]) > accepted.accuracy.kept / 2
    with pytest.raises(ReportError, match="no report"):
        geodelreg.apply(folder / "refused_candidate.json", MS, tmp_path / "out.tif")
    again = CliRunner().invoke(cli, [*command, "--keep-candidate", str(folder)])
    assert isinstance(again.exception, OutputExistsError)


def test_what_was_accepted_is_no_candidate(accepted: geodelreg.Alignment, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="was not refused"):
        geodelreg.write_candidate(accepted, tmp_path / "kept")
    assert not list(tmp_path.iterdir())
