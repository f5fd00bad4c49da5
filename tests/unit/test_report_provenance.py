"""Fingerprints and provenance tags."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import pytest

from geodelreg.product.provenance import fingerprint, provenance_tags, source_date
from geodelreg.product.report import report_dict
from tests.unit.alignment_sample import alignment, refused

MIB = 1 << 20


def test_fingerprint_of_a_small_file_is_a_hash_of_size_and_contents(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(b"pixels")
    expected = hashlib.sha256((6).to_bytes(8, "little") + b"pixels").hexdigest()
    assert fingerprint(path) == f"sha256:{expected}"


def test_fingerprint_does_not_depend_on_the_name(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(b"same")
    assert fingerprint(tmp_path / "a") == fingerprint(tmp_path / "b")


@pytest.mark.parametrize("size", [6 * MIB, 6 * MIB + 1, 50 * MIB + 12345])
def test_fingerprint_sees_changes_of_the_ends_and_the_size(tmp_path: Path, size: int) -> None:
    path = tmp_path / "large.tif"

    def changed(at: int) -> str:
        with path.open("wb") as stream:
            stream.truncate(size)
            if at >= 0:
                stream.seek(at)
                stream.write(b"x")
        return fingerprint(path)

    plain = changed(-1)
    assert plain.startswith("sha256:" if size == 6 * MIB else "sha256-sampled:")
    assert plain == changed(-1)
    for at in (0, MIB - 1, MIB, size - 1, size - MIB, size - MIB - 1):
        assert changed(at) != plain, at
    os.truncate(path, size + 1)
    assert fingerprint(path) != plain


def test_fingerprint_of_a_huge_file_reads_little(tmp_path: Path) -> None:
    """20 sparse GiB, which would take a minute to read, are sampled."""
    path = tmp_path / "huge.tif"
    with path.open("wb") as stream:
        stream.truncate(20 << 30)
    assert fingerprint(path).startswith("sha256-sampled:")


@pytest.mark.parametrize("name", ["/vsizip/a.zip/ms.tif", "https://example.org/ms.tif", "none"])
def test_what_is_no_local_file_has_no_fingerprint(name: str) -> None:
    assert fingerprint(name) == ""


def test_date_is_that_of_the_source_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    assert source_date() is None
    assert "GEODELREG_DATE" not in provenance_tags(alignment())
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    assert source_date() == "2023-11-14T22:13:20Z"
    assert provenance_tags(alignment())["GEODELREG_DATE"] == "2023-11-14T22:13:20Z"
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    assert source_date() is None
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "9" * 30)
    assert source_date() is None


def test_tags_name_inputs_model_accuracy_and_verdict(tmp_path: Path) -> None:
    bands = [tmp_path / "deep" / name for name in ("B2.tif", "B3.tif")]
    bands[0].parent.mkdir()
    for path in bands:
        path.write_bytes(path.name.encode())
    made = alignment()
    made = replace(
        made,
        source=replace(
            made.source,
            paths=tuple(map(str, bands)),
            fingerprints=tuple(map(fingerprint, bands)),
        ),
        reference=replace(
            made.reference, paths=(str(bands[0]),), fingerprints=(fingerprint(bands[0]),)
        ),
    )
    tags = provenance_tags(made)
    assert tags["GEODELREG_MS"] == "B2.tif; B3.tif"
    assert tags["GEODELREG_MS_FINGERPRINT"] == "; ".join(map(fingerprint, bands))
    assert tags["GEODELREG_PAN_FINGERPRINT"] == fingerprint(bands[0])
    assert tags["GEODELREG_MODEL"] == "shift"
    assert tags["GEODELREG_VERDICT"] == "aligned"
    assert tags["GEODELREG_CHECK_RMSE_PX"] == "0.0512346"
    assert tags["GEODELREG_TIE_POINTS"] == "4"
    assert tags["GEODELREG_GEOTRANSFORM_AFTER"] == "500006.0 8.0 0.0 1299997.0 0.0 -8.0"
    assert list(tags) == sorted(tags)
    assert all(name.startswith("GEODELREG_") and text for name, text in tags.items())
    assert str(tmp_path) not in "".join(tags.values())


def test_tags_leave_out_what_is_not_known() -> None:
    tags = provenance_tags(refused())
    assert "GEODELREG_CHECK_RMSE_PX" not in tags
    assert "GEODELREG_MS_FINGERPRINT" not in tags
    assert tags["GEODELREG_TIE_POINTS"] == "0"


def test_fingerprints_taken_before_an_edit_in_place_count(tmp_path: Path) -> None:
    path = tmp_path / "ms.tif"
    path.write_bytes(b"before")
    taken = fingerprint(path)
    path.write_bytes(b"after")
    made = alignment()
    made = replace(made, source=replace(made.source, paths=(str(path),), fingerprints=(taken,)))
    assert provenance_tags(made)["GEODELREG_MS_FINGERPRINT"] == taken
    file = report_dict(made)["inputs"]["source"]["files"][0]
    assert file == {"path": str(path), "size_bytes": 5, "fingerprint": taken}
