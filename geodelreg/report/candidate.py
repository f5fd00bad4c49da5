"""What was refused, kept for who looks into it: files that no command takes for a result."""

from __future__ import annotations

from importlib.util import find_spec
from os import PathLike
from pathlib import Path

from geodelreg.errors import UsageError
from geodelreg.geotiff.atomic import together, write_text_atomically
from geodelreg.geotiff.targets import check_replaceable
from geodelreg.product.gcps import gcp_context, gcps_from_alignment, write_gcps
from geodelreg.product.report import json_text, plain
from geodelreg.report.figures import draw_figure
from geodelreg.values.result import Alignment
from geodelreg.writing import inputs_of

_NAME = "refused_candidate"
_NO_RESULT = (
    "The images do not support this correction: it was refused. It is kept to be looked at, and "
    "no file should be corrected by it."
)


def candidate_files(folder: Path) -> list[Path]:
    """What `write_candidate` writes into a folder: a figure only where matplotlib is there."""
    suffixes = [".json", ".geojson", *([".png"] if find_spec("matplotlib") else [])]
    return [folder / f"{_NAME}{suffix}" for suffix in suffixes]


def has_candidate(alignment: Alignment) -> bool:
    """True of a refused alignment that came as far as a correction."""
    return not alignment.verdict.accepted and alignment.solution.model != "none"


def write_candidate(
    alignment: Alignment, folder: str | PathLike[str], overwrite: bool = False
) -> list[Path]:
    """Keep the correction that a refusal refused, its control points and a figure of them.

    Parameters
    ----------
    alignment : Alignment
        That `AlignmentRefusedError` holds.
    folder : path
        Made where it is missing.  Its files are ``refused_candidate.json`` (the reasons, and the
        map or geotransform that was refused), ``.geojson`` (all tie points, with status and
        residual) and, where matplotlib is installed and the rasters are files, ``.png``.
    overwrite : bool

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    UsageError
        The alignment was not refused, or nothing was found that could be.
    OutputExistsError, OutputIsInputError, OutputUnwritableError, FileLockedError
    """
    if not has_candidate(alignment):
        what = "was not refused" if alignment.verdict.accepted else "found no correction at all"
        raise UsageError(
            f"there is no refused candidate to keep: the alignment {what}",
            "An accepted one is written by `write`, `export_gcps` and `write_report`.",
        )
    text, points, *figures = files = candidate_files(Path(folder))
    if alignment.source.in_memory or alignment.reference.in_memory:
        files, figures = files[:2], []
    Path(folder).mkdir(exist_ok=True)
    for path in files:
        check_replaceable(path, overwrite)
    gcps, context = gcps_from_alignment(alignment, every=True), gcp_context(alignment, every=True)
    with together(inputs=lambda: inputs_of(alignment)):
        for figure in figures:
            draw_figure(alignment, "arrows", figure, overwrite)
        write_gcps(points, gcps, "geojson", context=context, overwrite=overwrite)
        write_text_atomically(text, json_text(_told(alignment)) + "\n", overwrite)
    return files


def _told(alignment: Alignment) -> dict[str, object]:
    """The candidate in words and numbers; the keys are none of a report's."""
    solution, header = alignment.solution, alignment.source.grid.transform
    affine = solution.map.as_affine()
    told = {
        "refused": _NO_RESULT,
        "because": [r.message for r in solution.verdict.reasons if not r.passed],
        "refused_ms": alignment.source.paths,
        "refused_pan": alignment.reference.paths,
        "refused_model": solution.model,
        "refused_pixel_map": solution.map.to_json(),
        "refused_geotransform": None if affine is None else (header @ affine).to_gdal(),
        "original_geotransform": header.to_gdal(),
    }
    return dict(plain(told))
