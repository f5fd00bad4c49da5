"""All results in one file: CSV, Parquet, and footprints as GeoJSON or GeoPackage."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import Any

from geodelreg.batch.job import FIGURES, PairResult
from geodelreg.errors import MissingExtraError, UsageError
from geodelreg.flags import as_typed
from geodelreg.geotiff.atomic import staged

_BEFORE = ("number", "sources", "reference", "output", "outcome", "error", "reason", "warnings")
_AFTER = ("duration_s", "attempts", "host")
COLUMNS = (*_BEFORE, *FIGURES, *_AFTER)
LISTS = ("sources", "warnings")
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")
_ROWS_AT_ONCE = 10_000

assert {f.name for f in fields(PairResult)} == {*_BEFORE, *_AFTER, "figures", "footprint"}


def values_of(result: PairResult) -> dict[str, Any]:
    """`COLUMNS` of a result."""
    return {n: result.figures.get(n) if n in FIGURES else getattr(result, n) for n in COLUMNS}


def check_format(path: Path) -> None:
    """Refuse a table whose extension says no format, or whose format needs what is not installed.

    Raises
    ------
    UsageError, MissingExtraError
    """
    suffix = path.suffix.lower()
    if suffix not in (*_WRITERS, ".html"):
        raise UsageError(
            f"{path}: the extension says no format of tables",
            f"Use one of: {', '.join((*_WRITERS, '.html'))}.",
        )
    if suffix == ".html":
        from geodelreg.report.html import check_jinja

        check_jinja(path.name)
    elif suffix == ".parquet":
        _needed("pyarrow", "parquet")
    elif suffix == ".gpkg":
        _needed("pyogrio", "vector")


def write_table(results: Iterable[PairResult], path: Path) -> None:
    """Write results to a file that appears whole or not at all; an existing one is replaced.

    Parameters
    ----------
    results : iterable of PairResult
    path : Path
        The extension is the format: ``.csv``, ``.parquet``, ``.geojson``, ``.gpkg``, or ``.html``
        for a page to look at, which links those of the pairs where they lie beside it.

    Raises
    ------
    UsageError, MissingExtraError, OutputUnwritableError
    """
    check_format(path)
    with staged(path, overwrite=True) as draft:
        if path.suffix.lower() == ".html":
            draft.write_text(_index(results, path.parent), encoding="utf-8")
        else:
            _WRITERS[path.suffix.lower()](results, draft)


def _index(results: Iterable[PairResult], folder: Path) -> str:
    """A page of all results, with links to the pages of the pairs in `folder`."""
    from geodelreg.report.index import PAGES, Row, index, page_name

    def row(result: PairResult) -> Row:
        name = f"{PAGES}/{page_name(result.number)}"
        first, *more = result.sources
        return Row(
            result.number,
            Path(first).name + (f" and {len(more)} more" if more else ""),
            Path(result.reference).name,
            result.outcome,
            as_typed(" ".join(text for text in (result.error, result.reason) if text)),
            result.figures,
            result.footprint,
            name if (folder / name).is_file() else "",
        )

    return index(map(row, results))


def harmless(text: str) -> str:
    """`text` as a cell that no spreadsheet takes for a formula."""
    return "'" + text if text.startswith(_FORMULA) else text


def _write_csv(results: Iterable[PairResult], path: Path) -> None:
    with path.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for result in results:
            values = values_of(result)
            cells = ("; ".join(v) if isinstance(v, tuple) else v for v in values.values())
            writer.writerow([harmless(c) if isinstance(c, str) else c for c in cells])


def _write_geojson(results: Iterable[PairResult], path: Path) -> None:
    with path.open("w", encoding="utf-8", errors="backslashreplace") as file:
        file.write('{"type": "FeatureCollection", "features": [')
        comma = "\n"
        for result in results:
            feature = {
                "type": "Feature",
                "id": result.number,
                "geometry": result.footprint,
                "properties": values_of(result),
            }
            file.write(comma + json.dumps(feature, allow_nan=False))
            comma = ",\n"
        file.write("\n]}\n")


def _write_parquet(results: Iterable[PairResult], path: Path) -> None:
    pyarrow = _needed("pyarrow", "parquet")
    parquet = _needed("pyarrow.parquet", "parquet")
    kinds = {
        **dict.fromkeys(COLUMNS, pyarrow.string()),
        **dict.fromkeys(LISTS, pyarrow.list_(pyarrow.string())),
        **dict.fromkeys((*FIGURES, "duration_s"), pyarrow.float64()),
        **dict.fromkeys(("number", "attempts", "tie_points"), pyarrow.int64()),
        "model": pyarrow.string(),
    }
    schema = pyarrow.schema(list(kinds.items()))
    with parquet.ParquetWriter(path, schema) as writer:
        for rows in _chunks(map(values_of, results)):
            writer.write_table(pyarrow.Table.from_pylist(rows, schema))


def _write_gpkg(results: Iterable[PairResult], path: Path) -> None:
    raw = _needed("pyogrio.raw", "vector")
    import numpy as np
    from shapely import MultiPolygon, Polygon, to_wkb
    from shapely.geometry import shape

    def many(footprint: Any) -> bytes | None:
        if footprint is None:
            return None
        found = shape(footprint)
        return to_wkb(MultiPolygon([found]) if isinstance(found, Polygon) else found)

    texts = {n for n in COLUMNS if n not in (*FIGURES, *_AFTER, "number")} | {"model", "host"}
    for rows in _chunks((values_of(result), many(result.footprint)) for result in results):
        columns = []
        for name in COLUMNS:
            cells = [row[name] for row, _ in rows]
            cells = ["; ".join(cell) if isinstance(cell, tuple) else cell for cell in cells]
            kind = object if name in texts else np.float64
            columns.append(np.array(cells, dtype=kind))
        raw.write(
            path,
            geometry=np.array([outline for _, outline in rows], dtype=object),
            field_data=columns,
            fields=COLUMNS,
            geometry_type="MultiPolygon",
            crs="EPSG:4326",
            driver="GPKG",
            layer="footprints",
            append=path.exists(),
        )


def _chunks(items: Iterable[Any]) -> Iterator[list[Any]]:
    iterator = iter(items)
    while chunk := list(islice(iterator, _ROWS_AT_ONCE)):
        yield chunk


def _needed(module: str, extra: str) -> Any:
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"this format needs {module.partition('.')[0]}, which is not installed",
            f"Install it: pip install {module.partition('.')[0]} (in a clone: pip install "
            f"'.[{extra}]').",
        ) from error


_WRITERS: dict[str, Callable[[Iterable[PairResult], Path], None]] = {
    ".csv": _write_csv,
    ".parquet": _write_parquet,
    ".geojson": _write_geojson,
    ".gpkg": _write_gpkg,
}
