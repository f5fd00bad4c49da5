"""The notebook of the docs runs from a DataArray to a sharpened plot; it is kept without output."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from geodelreg import align

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "docs" / "notebooks" / "arrays.ipynb"


def outputs(cell: Any, kind: str) -> list[str]:
    return [out["data"][kind] for out in cell.outputs if kind in out.get("data", {})]


@pytest.fixture
def notebook() -> Any:
    return nbformat.read(NOTEBOOK, as_version=4)


def test_it_is_kept_without_what_it_printed(notebook: Any) -> None:
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in cells)
    assert NOTEBOOK.stat().st_size < 20_000


def test_it_runs_to_the_sharpened_plot(notebook: Any) -> None:
    folder = {"metadata": {"path": str(NOTEBOOK.parent)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=folder).execute()
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    tables = [text for cell in cells for text in outputs(cell, "text/html")]
    assert any("<th>verdict</th><td>aligned</td>" in table for table in tables)
    moved = next(cell for cell in cells if "apply" in cell.source)
    (text,) = outputs(moved, "text/plain")
    alignment = align(ROOT / "sample_tiles" / "ms.tif", ROOT / "sample_tiles" / "pan.tif")
    before, after = alignment.correction.original, alignment.correction.corrected
    centre = (0.5, 0.5)
    expected = np.subtract(after @ centre, before @ centre)
    assert [float(part) for part in text.strip("()").split(",")] == pytest.approx(
        expected, abs=1e-3
    )
    assert outputs(cells[-1], "image/png")
