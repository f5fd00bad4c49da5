"""The fields of the JSON report, from its schema, with the names that Python has for them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from geodelreg.option_checks import knob_help
from geodelreg.options import AlignOptions
from geodelreg.product.report import report_schema

NO_NAME = {
    "schema_version", "tool", "tool.name", "created", "inputs", "step_counts[]",
    "step_counts[].step", "step_counts[].points",
}  # fmt: skip
"""What only the document has."""
OTHER_NAMES = {
    "tool.version": "geodelreg.__version__",
    "correction.map_transform": "alignment.correction.map_transform.to_gdal()",
    "correction.pixel_map": "alignment.solution.map.to_json()",
    "found.pixel_map": "alignment.found.map.to_json()",
    "found.sigma_source_px": "alignment.found.map.sigma_at(xy)",
    "tie_points.total": "len(alignment.tie_points)",
    "tie_points.points": "alignment.tie_points",
    "tie_points.points[]": "",
    "tie_points.points[].status": "Status(alignment.tie_points.status[i]).name.lower()",
    "verdict.outcome": "alignment.verdict.outcome.value",
    "check.outcome": "check.outcome.value",
    "check.raster_outcome": "check.raster_outcome.value",
    "check.bands[].outcome": "check.bands[i].outcome.value",
}
INPUT_NAMES = {
    "files": "paths", "files[]": "", "files[].path": "paths[i]", "files[].size_bytes": "",
    "files[].fingerprint": "fingerprints[i]", "width": "grid.shape[1]", "height": "grid.shape[0]",
    "geotransform": "grid.transform.to_gdal()", "crs_wkt": "grid.crs_wkt",
}  # fmt: skip
HEAD = "| field | type | meaning | Python |\n|---|---|---|---|\n"
INTRODUCTION = """# JSON report

`--report FILE.json`, `--json` and `geodelreg.write_report` give one document for each pair.
`geodelreg check --json` adds the block `check`. This page is made from the schema of the document,
which is installed as `geodelreg/product/schema/report.schema.json`.

- Pixel positions are (column, row). The **outer corner** of the upper left pixel is (0, 0).
- `_px` means pixels of PAN unless something else is said. `_m` means metres on the ground.
- `null` means that a value is not known. In Python that is NaN.
- *Python* is the name of the same value, for `alignment = geodelreg.align(…)` or `check =
  geodelreg.check(…)`, where the evidence is `alignment = check.alignment`. `i` counts from 0, and
  `Status` is `geodelreg.values.points.Status`.
- [Reports of version 1](how-to/reports.md#reports-of-version-1) lists what changed.
"""


@dataclass(frozen=True)
class ReportField:
    """One field: its path, ``[]`` for each of a list, its part of the schema, Python's name."""

    path: str
    schema: dict[str, Any]
    python: str

    @property
    def meaning(self) -> str:
        """Of the schema; options are documented where they are defined."""
        if self.path.startswith("options."):
            return knob_help(AlignOptions, self.path.removeprefix("options."))
        return str(self.schema.get("description", ""))

    @property
    def kind(self) -> str:
        """Type, or the values there are."""
        if "const" in self.schema:
            return f"`{self.schema['const']}`"
        if "enum" in self.schema:
            return ", ".join(f"`{value}`" for value in self.schema["enum"])
        if "anyOf" in self.schema:
            return "list of 6 numbers, or null"
        kind = self.schema["type"]
        return " or ".join([kind] if isinstance(kind, str) else kind)


def report_fields() -> list[ReportField]:
    """All fields, in the order of the schema."""
    schema = report_schema()
    return list(_fields(schema, schema, ""))


def _fields(schema: dict[str, Any], node: dict[str, Any], path: str) -> Iterator[ReportField]:
    node = _resolved(schema, node)
    if path:
        yield ReportField(path, node, _python(path))
    items = _resolved(schema, node.get("items", {}))
    if "properties" in items:
        yield from _fields(schema, items, f"{path}[]")
    for name, part in node.get("properties", {}).items():
        yield from _fields(schema, part, f"{path}.{name}".lstrip("."))


def _resolved(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """A part of the schema, with what it refers to; its own words win."""
    target = schema
    if "$ref" not in node:
        return node
    for key in node["$ref"].removeprefix("#/").split("/"):
        target = target[key]
    return target | {key: value for key, value in node.items() if key != "$ref"}


def _python(path: str) -> str:
    """Name of the same value in Python; empty where there is none."""
    if path in NO_NAME or path.startswith(("tie_points.by_status", "bands[]")):
        return ""
    if path in OTHER_NAMES:
        return OTHER_NAMES[path]
    top, _, rest = path.partition(".")
    if top == "inputs":
        role, _, field = rest.partition(".")
        name = INPUT_NAMES[field] if field else ""
        return f"alignment.{role}.{name}".rstrip(".") if name or not field else ""
    if path.startswith("tie_points.points[]."):
        return f"alignment.tie_points.{path.rpartition('.')[2]}[i]"
    if path.startswith("correction.at_centre"):
        path = path.removeprefix("correction.")
    name = path.replace("[]", "[i]")
    return name if top == "check" else f"alignment.{name}"


def report_page() -> str:
    """Markdown with every field."""
    parts = [INTRODUCTION]
    for field in report_fields():
        if "." not in field.path and "[" not in field.path:
            parts.append(f"\n## {field.path}\n\n{HEAD}")
        python = f"`{field.python}`" if field.python else ""
        parts.append(f"| `{field.path}` | {field.kind} | {_cell(field.meaning)} | {python} |\n")
    return "".join(parts)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("_", "\\_")
