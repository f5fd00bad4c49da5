"""What geodelreg is asked to do in a hostile case: through the Python API, or the command."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import geodelreg
from benchmarks.robustness.fuzz_cases import GCPS, SHIFT, TAGS
from benchmarks.robustness.hostile.plan import Plan
from benchmarks.robustness.witness import COMMAND
from geodelreg.errors import GeodelregError
from geodelreg.options import AlignOptions, WriteOptions
from geodelreg.values.result import Correction

_PATIENCE_S = 120.0
"""For the command; what is waited for a warm worker is longer."""
_ENDINGS = (0, 1, 2, 3, 4)


class CommandFailedError(GeodelregError):
    """The command has ended with a message."""


class HungError(Exception):
    """The command did not end."""


def do(plan: Plan) -> None:
    """Do in the current folder what a case asks for.

    Raises
    ------
    GeodelregError, click.ClickException
        As geodelreg refuses it.
    HungError
    """
    if plan.by_command:
        _by_command(plan)
    else:
        DOING[plan.action](plan)


def _options(plan: Plan) -> AlignOptions:
    masks = (plan.mask,) if plan.mask else ()
    return AlignOptions(masks=masks, threads=1, max_keypoints=500)


def _check(plan: Plan) -> None:
    geodelreg.check(plan.ms, plan.pan, _options(plan))


def _correction(plan: Plan) -> Correction:
    from geodelreg.raster.reader import open_raster

    with open_raster(plan.ms) as reader:
        grid = reader.grid
    return Correction("affine", grid.crs_wkt, grid.transform, grid.transform @ SHIFT)


def _write(plan: Plan) -> None:
    from geodelreg.geotiff.corrected import write_corrected

    if not plan.is_about_crs:  # for PAN is in another
        _check(plan)
    options = WriteOptions(overwrite=plan.overwrite)
    write_corrected(Path(plan.ms), Path(plan.target), _correction(plan), GCPS, TAGS, options)


def _in_place(plan: Plan) -> None:
    from geodelreg.geotiff.inplace import edit_in_place

    if not plan.is_about_crs:
        _check(plan)
    edit_in_place(Path(plan.ms), _correction(plan), GCPS, TAGS)


def _revert(plan: Plan) -> None:
    geodelreg.revert(plan.ms)


def _command_here(plan: Plan) -> None:
    from geodelreg_cli.main import cli

    cli.main(arguments(plan), standalone_mode=False)


DOING: dict[str, Callable[[Plan], None]] = {
    "check": _check,
    "write": _write,
    "inplace": _in_place,
    "revert": _revert,
    "align": _command_here,
    "report": _command_here,
    "points": _command_here,
    "gcps": _command_here,
}


def arguments(plan: Plan) -> list[str]:
    """Those of the command that do what the API would."""
    align = ["align", "-q", "-j", "1", *(["--mask", plan.mask] if plan.mask else [])]
    overwrite = ["--overwrite"] if plan.overwrite else []
    pair = ["--", plan.ms, plan.pan]
    if plan.action == "check":
        return ["check", *align[1:], *pair]
    if plan.action == "revert":
        return ["revert", "-q", "--", plan.ms]
    if plan.action == "gcps":  # the points are in the place of PAN
        known = Path(plan.target).suffix in (".geojson", ".points", ".txt")
        wanted = [] if known else ["--to", "geojson"]
        return [
            "gcps",
            "-q",
            *wanted,
            *overwrite,
            "--raster",
            plan.ms,
            "--",
            *pair[2:],
            plan.target,
        ]
    if plan.action == "inplace":
        return [*align, "--in-place", *overwrite, *pair]
    if plan.action in ("write", "align"):
        return [*align, "-o", plan.target, *overwrite, *pair]
    if plan.action == "report":
        return [*align, "--dry-run", "--report", plan.target, *overwrite, *pair]
    return [
        *align,
        "--dry-run",
        "--gcp-format",
        "geojson",
        "--gcps",
        plan.target,
        *overwrite,
        *pair,
    ]


def _by_command(plan: Plan) -> None:
    command = [sys.executable, *COMMAND, *arguments(plan)]
    try:
        ended = subprocess.run(
            command,
            capture_output=True,
            check=False,
            timeout=_PATIENCE_S,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
    except subprocess.TimeoutExpired as error:
        raise HungError(f"{arguments(plan)}: stopped after {_PATIENCE_S:g} s") from error
    text = ended.stderr.decode("utf-8", "replace")
    if ended.returncode not in _ENDINGS or "Traceback" in text or "internal error" in text:
        raise RuntimeError(f"{arguments(plan)}: exit code {ended.returncode}: {text}")
    if ended.returncode and not (plan.action == "check" and ended.returncode in (3, 4)):
        raise CommandFailedError(" ".join(text.split()), "as it says")


def crs_of(path: str) -> str | None:
    """WKT of a raster's CRS, as rasterio sees it; None where it sees none."""
    import rasterio
    from rasterio.enums import WktVersion
    from rasterio.errors import RasterioError

    try:
        with rasterio.open(path) as dataset:
            crs = dataset.crs
            return str(crs.to_wkt(version=WktVersion.WKT2_2019)) if crs else None
    except RasterioError:
        return None


def is_same_crs(one: str | None, other: str | None) -> bool:
    """Whether two CRSs place things alike."""
    from pyproj import CRS

    if one is None or other is None:
        return one == other
    return bool(CRS.from_wkt(one).equals(CRS.from_wkt(other)))
