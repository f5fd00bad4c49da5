"""One fuzz case: a broken input, what is done with it, and what came of it.

A case is its number: the same number is the same input, action and options in every run.
"""

from __future__ import annotations

import hashlib
import logging
import random
import shutil
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import click
from affine import Affine

import geodelreg
from benchmarks.robustness.mutations import mutate
from benchmarks.robustness.seeds import RATIO, TRUE, UTM, Seed, make_seeds
from geodelreg.errors import AlignmentRefusedError, GeodelregError
from geodelreg.options import AlignOptions, WriteOptions
from geodelreg.values.points import Gcp
from geodelreg.values.result import Correction

Row = dict[str, Any]

SHIFT = Affine.translation(-0.75, 0.5)
GCPS = [
    Gcp("1", 2.5, 3.25, 500_050.0, 3_999_950.0),
    Gcp("2", 15.0, 4.0, 500_250.0, 3_999_930.0, info="a & <b>"),
    Gcp("3", 5.0, 15.0, 500_090.0, 3_999_750.0),
]
TAGS = {"GEODELREG_VERSION": "fuzz"}
WRITE_OPTIONS: tuple[dict[str, Any], ...] = (
    {}, {}, {}, {"georef": "gcps"}, {"strip_rpc": True}, {"creation_options": ("COMPRESS=LZW",)},
    {"driver": "COG"}, {"driver": "VRT"}, {"warp": True}, {"warp": True, "warp_grid": "pan"},
)  # fmt: skip
GCP_EXTENSIONS = {
    "qgis": ".points", "gdal": ".gcp", "csv": ".csv", "geojson": ".geojson", "vrt": ".vrt",
    "envi": ".pts", "envi-map": ".txt", "gpkg": ".gpkg", "flatgeobuf": ".fgb",
}  # fmt: skip
ACTIONS = (
    *["write"] * 7, *["inplace"] * 6, *["align"] * 3, *["check"] * 3, *["gcps"] * 4, *["revert"] * 2
)  # fmt: skip
LARGE_SIDE = 192


@dataclass(slots=True)
class Case:
    """A broken input in a folder of its own.

    Attributes
    ----------
    folder : Path
        Holds ``ms`` and ``pan`` files; outputs go into its folder ``out``.
    ms, pan : Path
    parts : list of str
        Action, layout and mutations.
    """

    number: int
    folder: Path
    rng: random.Random
    action: str
    ms: Path
    pan: Path
    parts: list[str]
    broken: list[str] = field(default_factory=list)

    @property
    def out(self) -> Path:
        """Folder for outputs."""
        return self.folder / "out"


@cache
def seeds(is_pan: bool, side: int) -> tuple[Seed, ...]:
    """Sound rasters, made once a process."""
    return tuple(make_seeds(is_pan, side))


def prepare(number: int, folder: Path) -> Case:
    """Write the input files of a case."""
    rng = random.Random(number)
    action = rng.choice(ACTIONS)
    side = LARGE_SIDE if action == "align" and rng.random() < 0.15 else 80
    of_pan = action in ("align", "check") and rng.random() < 0.3
    chosen = {False: seeds(False, side)[0], True: seeds(True, side)[0]}
    chosen[of_pan] = rng.choice(seeds(of_pan, side))
    paths = {}
    for is_pan, seed in chosen.items():
        place = folder / ("pan" if is_pan else "ms")
        place.mkdir()
        for name, data in seed.files.items():
            (place / name).write_bytes(data)
        paths[is_pan] = place / seed.main
    (folder / "out").mkdir()
    case = Case(number, folder, rng, action, paths[False], paths[True], [action])
    if action in ("gcps", "revert"):
        return case
    seed, place = chosen[of_pan], paths[of_pan].parent
    aim = seed.main if rng.random() < 0.8 else rng.choice(list(seed.files))
    data, names = mutate(seed.files[aim], rng)
    (place / aim).write_bytes(data)
    case.parts += [("pan " if of_pan else "ms ") + seed.name, *names]
    return case


def run_case(number: int, folder: Path) -> Row:
    """Run one mutated case in an empty folder.

    Returns
    -------
    dict
        ``outcome``: ok, error (one of geodelreg's), traceback or memory; ``detail``; ``broken``:
        promises not kept; ``seconds``.
    """
    case = prepare(number, folder)
    row, error = ended(lambda: DOING[case.action](case))
    if error is not None:
        check_message(error, case.broken)
    return row | {"number": number, "name": ", ".join(case.parts), "broken": case.broken}


def ended(doing: Callable[[], None]) -> tuple[Row, Exception | None]:
    """Do something: its ``outcome``, ``detail`` and ``seconds``, and its clean error."""
    started, detail, clean = time.perf_counter(), "", None
    try:
        with _quiet():
            doing()
        outcome = "ok"
    except (GeodelregError, click.ClickException) as error:
        outcome, detail, clean = "error", f"{type(error).__name__}: {error}", error
    except MemoryError:
        outcome, detail = "memory", traceback.format_exc(limit=-3)
    except Exception:
        outcome, detail = "traceback", traceback.format_exc(limit=-6)
    detail = detail[:3000].encode("utf-8", "replace").decode()
    return {"outcome": outcome, "detail": detail, "seconds": time.perf_counter() - started}, clean


@contextmanager
def _quiet() -> Iterator[None]:
    logging.getLogger().handlers = [logging.NullHandler()]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def check_message(error: Exception, broken: list[str]) -> None:
    """What every error of geodelreg's has: a remedy, and a cause that a terminal can show."""
    if isinstance(error, GeodelregError) and not error.remedy:
        broken.append("an error without a remedy")
    if isinstance(error, GeodelregError) and not error.cause.isprintable():
        broken.append("an error message with control characters")


def _state(folder: Path) -> dict[str, str]:
    """Every file below a folder, also hidden ones, with a digest."""
    return {
        path.relative_to(folder).as_posix(): (
            hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        )
        for path in folder.rglob("*")
    }


@contextmanager
def _promises(case: Case, may_change: bool = False) -> Iterator[None]:
    """Inputs stay as they are; after an error there is no output; no temporaries stay."""
    before = _state(case.folder)
    try:
        yield
    except BaseException as error:
        after = _state(case.folder)
        changed = {name for name in before | after if before.get(name) != after.get(name)}
        if isinstance(error, AlignmentRefusedError):
            changed.discard("out/report.json")
        if changed:
            case.broken.append(f"changed on error: {sorted(changed)[:5]}")
        raise
    after = _state(case.folder)
    if not may_change and any(after.get(name) != value for name, value in before.items()):
        case.broken.append("an input was changed")
    if any(".geodelreg" in name and "undo" not in name for name in after):
        case.broken.append("a temporary was left")


def _correction(case: Case) -> Correction:
    """Of the header as it is; sometimes of a sound one, for what comes after `open_raster`.

    Not of a VRT: `open_raster` is what bounds its size.
    """
    from geodelreg.raster.reader import open_raster

    if case.rng.random() < 0.3 and case.ms.suffix != ".vrt":
        case.parts.append("unchecked")
        transform = TRUE @ Affine.translation(3, -2) @ Affine.scale(RATIO)
        return Correction("affine", _wkt(), transform, transform @ SHIFT)
    with open_raster(case.ms) as reader:
        grid = reader.grid
    return Correction("affine", grid.crs_wkt, grid.transform, grid.transform @ SHIFT)


@cache
def _wkt() -> str:
    from rasterio.crs import CRS

    return str(CRS.from_string(UTM).to_wkt())


def _write(case: Case) -> None:
    from geodelreg.geotiff.corrected import write_corrected
    from geodelreg.product.warp import write_warped
    from geodelreg.values.raster import Grid

    options = WriteOptions(**case.rng.choice(WRITE_OPTIONS))
    target = case.out / "out.tif"
    if options.driver == "VRT":
        target = case.out / "out.vrt"
    with _promises(case):
        correction = _correction(case)
        if options.warp:
            pan = Grid(TRUE, (80, 80), _wkt())
            write_warped(case.ms, target, correction, pan, TAGS, options)
        else:
            write_corrected(case.ms, target, correction, GCPS, TAGS, options)


def _in_place(case: Case) -> None:
    from geodelreg.geotiff.inplace import edit_in_place, revert

    before = _state(case.folder)
    with _promises(case, may_change=True):
        correction = _correction(case)
        edit_in_place(case.ms, correction, GCPS, TAGS)
    with _promises(case, may_change=True):
        revert(case.ms)
    if _state(case.folder) != before:
        case.broken.append("revert has not brought the old files back")


def _options(case: Case) -> AlignOptions:
    method = case.rng.choice(("delaunay", "delaunay", "zhang2013", "sift"))
    return AlignOptions(method=method, threads=1, max_keypoints=500)


def _align(case: Case) -> None:
    from geodelreg.product.report import report_json

    options = WriteOptions(**case.rng.choice(WRITE_OPTIONS))
    alignment_options = _options(case)
    target = case.out / ("out.vrt" if options.driver == "VRT" else "out.tif")
    with _promises(case):
        alignment = geodelreg.align(case.ms, case.pan, alignment_options)
        geodelreg.write(alignment, target, options)
    report_json(alignment)
    name, suffix = case.rng.choice(list(GCP_EXTENSIONS.items()))
    geodelreg.export_gcps(alignment, case.out / f"points{suffix}", name)


def _check(case: Case) -> None:
    from geodelreg.product.check import check_json, check_text

    options = _options(case)
    with _promises(case):
        found = geodelreg.check(case.ms, case.pan, options, per_band=case.rng.random() < 0.2)
    check_json(found)
    check_text(found)


def _gcps(case: Case) -> None:
    from geodelreg.product.gcps import GcpContext, write_gcps
    from geodelreg.values.raster import Grid
    from geodelreg_cli.main import cli

    wanted, suffix = case.rng.choice(list(GCP_EXTENSIONS.items()))
    target, new_suffix = case.rng.choice(list(GCP_EXTENSIONS.items()))
    source = case.folder / f"points{suffix}"
    coarse = TRUE @ Affine.translation(3, -2) @ Affine.scale(RATIO)
    context = GcpContext(
        source=Grid(coarse, (20, 20), _wkt()),
        reference=Grid(TRUE, (80, 80), _wkt()),
        source_paths=(str(case.ms),),
        reference_path=str(case.pan),
    )
    write_gcps(source, GCPS, wanted, context=context)
    data, names = mutate(source.read_bytes(), case.rng)
    source.write_bytes(data)
    case.parts += [f"{wanted} to {target}", *names]
    files = [str(source), str(case.out / f"points{new_suffix}")]
    formats = ["--from", wanted, "--to", target] if case.rng.random() < 0.8 else []
    with _promises(case):
        cli.main(
            [
                "gcps",
                *files,
                "--raster",
                str(case.ms),
                "--reference",
                str(case.pan),
                "-q",
                *formats,
            ],
            standalone_mode=False,
        )


def _revert(case: Case) -> None:
    from geodelreg.geotiff.inplace import edit_in_place, revert
    from geodelreg.geotiff.undo import record_path

    seed = case.rng.choice([s for s in seeds(False, 80) if s.main == "ms.tif" and s.name != "cog"])
    shutil.rmtree(case.ms.parent)
    case.ms.parent.mkdir()
    case.ms = case.ms.with_name(seed.main)
    for name, data in seed.files.items():
        (case.ms.parent / name).write_bytes(data)
    original = case.ms.read_bytes()
    header = TRUE @ Affine.translation(3, -2) @ Affine.scale(RATIO)
    for _ in range(case.rng.choice((1, 1, 2))):
        edit_in_place(case.ms, Correction("shift", _wkt(), header, header @ SHIFT), GCPS, TAGS)
        header @= SHIFT
    aim = record_path(case.ms) if case.rng.random() < 0.8 else case.ms
    edited = case.ms.read_bytes()
    data, names = mutate(aim.read_bytes(), case.rng)
    aim.write_bytes(data)
    case.parts += [seed.name, aim.suffix, *names]
    with _promises(case, may_change=True):
        revert(case.ms)
    if case.ms.read_bytes() != original and aim != case.ms:
        case.broken.append("a damaged record has changed the raster")
    if aim == case.ms and case.ms.read_bytes()[: len(original)] == edited[: len(original)]:
        case.broken.append("revert has done nothing")


DOING: dict[str, Callable[[Case], None]] = {
    "write": _write,
    "inplace": _in_place,
    "align": _align,
    "check": _check,
    "gcps": _gcps,
    "revert": _revert,
}
