"""Rejected tie points are exported on request, and taken for control points by no reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import geodelreg
from geodelreg.errors import GcpFormatError
from geodelreg.product.gcps import gcp_context, read_gcps
from geodelreg_cli.main import cli

SAMPLES = Path(__file__).resolve().parents[2] / "sample_tiles"


@pytest.fixture(scope="module")
def alignment() -> geodelreg.Alignment:
    return geodelreg.align(SAMPLES / "ms.tif", SAMPLES / "pan.tif")


@pytest.mark.parametrize("name", ["all.points", "all.geojson"])
def test_readers_leave_the_rejected_ones_out(
    alignment: geodelreg.Alignment, tmp_path: Path, name: str
) -> None:
    points, out = alignment.tie_points, tmp_path / name
    geodelreg.export_gcps(alignment, out, points="all")
    text = out.read_text("utf-8")
    if name.endswith("points"):
        enabled = [line.split(",")[4] for line in text.splitlines()[2:]]
        assert set(enabled) == {"0", "1"}
        assert enabled.count("1") == points.kept.sum()
        assert len(enabled) > points.kept.sum()
    else:
        facts = [feature["properties"] for feature in json.loads(text)["features"]]
        kept = [fact for fact in facts if fact["status"] == 0]
        assert len(facts) > len(kept) == points.kept.sum()
        residual = [(fact["residual_right_px"], fact["residual_down_px"]) for fact in kept]
        rms = np.sqrt((np.array(residual) ** 2).sum(axis=1).mean())
        known = points.residual_px[points.kept]
        assert rms == pytest.approx(np.sqrt((known**2).sum(axis=1).mean()))
        assert all(0.5 < fact["correlation"] <= 1 for fact in kept)
    again, _ = read_gcps(out, context=gcp_context(alignment))
    plain = tmp_path / f"kept{out.suffix}"
    geodelreg.export_gcps(alignment, plain)
    expected, _ = read_gcps(plain, context=gcp_context(alignment))
    found, wanted = (
        np.array([(g.column, g.row, g.x, g.y) for g in of]) for of in (again, expected)
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_formats_without_room_for_them_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "all.txt"
    files = [str(SAMPLES / "ms.tif"), str(SAMPLES / "pan.tif")]
    command = ["align", *files, "--dry-run", "-q", "--points", "all", "--gcps", str(out)]
    run = CliRunner().invoke(cli, command)
    assert isinstance(run.exception, GcpFormatError)
    assert not out.exists()
