"""Each error class is provoked once: its message names the file or option, and a remedy."""

from __future__ import annotations

import inspect
import os
import re
import signal
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine

from geodelreg import AlignOptions, Grid, __version__, align, errors, refit
from geodelreg.batch import run
from geodelreg.batch.job import Pair, Task
from geodelreg.batch.supervisor import Child
from geodelreg.errors import GeodelregError
from geodelreg.geo.maps.affine import IDENTITY
from geodelreg.geotiff.atomic import exclusive, write_text_atomically
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.geotiff.inplace import edit_in_place
from geodelreg.options import WriteOptions
from geodelreg.product.figures import check_drawable
from geodelreg.product.gcps import read_gcps
from geodelreg.product.reading import read_report
from geodelreg.product.stored import StoredCorrection
from geodelreg.product.vectors import write_vector
from geodelreg.raster.reader import open_raster
from tests.integration.raster_samples import GCPS, TAGS, UTM18, correction_of, make_cog

ROOT = Path(__file__).resolve().parents[2]
GROUND = Affine(2.0, 0.0, 500_000.0, 0.0, -2.0, 4_000_000.0)
ENGINEERING = (
    'ENGCRS["local",EDATUM["x"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],UNIT["m",1]]'
)


def raster(folder: Path, name: str, **profile: Any) -> Path:
    """Noise on a small grid; with ``constant=True`` a single value."""
    constant = profile.pop("constant", False)
    options = {"driver": "GTiff", "width": 80, "height": 80, "count": 1, "dtype": "uint8"}
    options |= {"crs": UTM18, "transform": GROUND, **profile}
    data = np.random.default_rng(len(name)).integers(1, 255, (80, 80)).astype("uint8")
    with rasterio.open(folder / name, "w", **options) as dataset:
        dataset.write(np.full_like(data, 7) if constant else data, 1)
    return folder / name


def aligned(folder: Path, options: AlignOptions | None = None, **profile: Any) -> object:
    return align(raster(folder, "ms.tif", **profile), raster(folder, "pan.tif"), options)


def written(folder: Path, target: str, **options: Any) -> object:
    ms = raster(folder, "ms.tif")
    given = WriteOptions(**options)
    return write_corrected(ms, folder / target, correction_of(ms), GCPS, TAGS, given)


def with_existing_output(folder: Path) -> object:
    (folder / "out.tif").touch()
    return written(folder, "out.tif")


def locked(folder: Path) -> object:
    with exclusive(folder / "out.txt"):
        return write_text_atomically(folder / "out.txt", "x", overwrite=True)


def bands_of_two_crss(folder: Path) -> object:
    return open_raster([raster(folder, "ms.tif"), raster(folder, "b2.tif", crs="EPSG:32633")])


def text_file(folder: Path, name: str) -> Path:
    (folder / name).write_text("nothing of use")
    return folder / name


def points_file(folder: Path, name: str) -> Path:
    """One point, which determines nothing."""
    (folder / name).write_text("column,line,x,y\n1,2,500003,3999997\n")
    return folder / name


def edited_cog(folder: Path) -> object:
    cog = make_cog(folder / "ms.tif")
    return edit_in_place(cog, correction_of(cog), GCPS, TAGS)


def without_matplotlib(folder: Path) -> object:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib", None)
        return check_drawable(folder / "figure.png")


def listed(folder: Path, *rows: dict[str, str], **settings: Any) -> list[object]:
    return list(run(rows, out_root=folder, **settings))


ROW = {"ms": "ms.tif", "pan": "pan.tif", "out": "out.tif"}


def with_existing_ledger(folder: Path) -> object:
    (folder / "batch.ledger").touch()
    return listed(folder, ROW)


def without_workers(folder: Path) -> object:
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    return listed(folder, ROW, executor=executor)


def in_child(
    folder: Path,
    timeout_s: float | None = None,
    memory_mb: int | None = None,
    killed: bool = False,
) -> object:
    pair = Pair((str(raster(folder, "ms.tif")),), str(raster(folder, "pan.tif")))
    task = Task(1, pair, "check", 0.5, timeout_s, memory_mb, {}, __version__)
    child = Child({})
    if killed:
        os.kill(child.pid, signal.SIGKILL)
    return child.run(task)


def stored(folder: Path) -> StoredCorrection:
    """A correction that moves nothing."""
    grid = Grid(GROUND, (80, 80), rasterio.crs.CRS.from_string(UTM18).to_wkt())
    return StoredCorrection(folder / "report.json", grid, grid, "shift", IDENTITY, {})


@dataclass(frozen=True)
class Case:
    """What provokes an error, and which of these words its cause must name."""

    provoke: Callable[[Path], object]
    names: tuple[str, ...] = ("ms.tif",)


CASES = {
    errors.UsageError: Case(lambda folder: AlignOptions(method="x"), ("method",)),
    errors.RasterNotFoundError: Case(lambda folder: open_raster(folder / "ms.tif")),
    errors.RasterUnreadableError: Case(lambda folder: open_raster(text_file(folder, "ms.tif"))),
    errors.AccessNotAllowedError: Case(
        lambda folder: open_raster("https://127.0.0.1:9/ms.tif"), ("https://127.0.0.1:9/ms.tif",)
    ),
    errors.MissingGeoreferenceError: Case(lambda folder: aligned(folder, transform=None)),
    errors.UnsupportedGeoreferenceError: Case(
        lambda folder: aligned(folder, transform=Affine(2, 0, 5e5, 0, 0, 4e6))
    ),
    errors.MissingCrsError: Case(lambda folder: aligned(folder, crs=None)),
    errors.CrsTransformError: Case(
        lambda folder: aligned(folder, crs=ENGINEERING), ("ms.tif", "pan.tif")
    ),
    errors.BandNumberError: Case(lambda folder: aligned(folder, AlignOptions(band=9))),
    errors.BandGridError: Case(bands_of_two_crss, ("ms.tif", "b2.tif")),
    errors.ArrayShapeError: Case(
        lambda folder: open_raster((np.zeros((9, 9)), Grid(GROUND, (9, 8), UTM18))), ("(9, 9)",)
    ),
    errors.NoDataError: Case(lambda folder: aligned(folder, constant=True)),
    errors.NoOverlapError: Case(
        lambda folder: aligned(folder, transform=Affine.translation(9e4, 9e4) @ GROUND),
        ("ms.tif", "pan.tif"),
    ),
    errors.OutputExistsError: Case(with_existing_output, ("out.tif",)),
    errors.OutputIsInputError: Case(lambda folder: written(folder, "ms.tif")),
    errors.OutputUnwritableError: Case(
        lambda folder: written(folder, "missing/out.tif"), ("missing/out.tif",)
    ),
    errors.LossyOutputError: Case(
        lambda folder: written(folder, "out.tif", creation_options=("COMPRESS=JPEG",)), ("out.tif",)
    ),
    errors.UnsafeInPlaceError: Case(edited_cog),
    errors.FileLockedError: Case(locked, ("out.txt",)),
    errors.GcpFormatError: Case(
        lambda folder: read_gcps(text_file(folder, "gcps.points")), ("gcps.points",)
    ),
    errors.PointsError: Case(
        lambda folder: refit(points_file(folder, "points.csv"), raster(folder, "ms.tif")),
        ("points.csv",),
    ),
    errors.CorrectionMisfitError: Case(
        lambda folder: stored(folder).check_share("mask.tif", 0.1), ("mask.tif", "report.json")
    ),
    errors.VectorUnreadableError: Case(
        lambda folder: write_vector(
            stored(folder), text_file(folder, "a.geojson"), folder / "b.geojson", False, False
        ),
        ("a.geojson",),
    ),
    errors.MaskError: Case(
        lambda folder: aligned(folder, AlignOptions(masks=(str(text_file(folder, "qa.tif")),))),
        ("qa.tif",),
    ),
    errors.ReportError: Case(
        lambda folder: read_report(text_file(folder, "result.json")), ("result.json",)
    ),
    errors.MissingExtraError: Case(without_matplotlib, ("matplotlib",)),
    errors.ManifestError: Case(
        lambda folder: listed(folder, {**ROW, "model": "x"}), ("row 1", "model")
    ),
    errors.LedgerError: Case(with_existing_ledger, ("batch.ledger",)),
    errors.ClusterError: Case(without_workers, ("executor",)),
    errors.PairTimeoutError: Case(
        lambda folder: in_child(folder, timeout_s=0.01), ("ms.tif", "0.01 s")
    ),
    errors.PairMemoryError: Case(lambda folder: in_child(folder, memory_mb=9), ("ms.tif", "9 MB")),
    errors.PairCrashedError: Case(lambda folder: in_child(folder, killed=True), ("ms.tif",)),
    errors.AlignmentRefusedError: Case(aligned, ("ms.tif", "pan.tif")),
}


def error_classes() -> set[type[GeodelregError]]:
    kinds = (kind for _, kind in inspect.getmembers(errors, inspect.isclass))
    return {kind for kind in kinds if issubclass(kind, GeodelregError)} - {GeodelregError}


def test_every_class_has_a_case_here_and_a_section_in_the_docs() -> None:
    assert set(CASES) == error_classes()
    page = (ROOT / "docs" / "when-it-refuses.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"^### `(\w+)`", page, re.M))
    assert explained == {kind.__name__ for kind in error_classes()}


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("kind", CASES, ids=lambda kind: kind.__name__)
def test_the_message_names_file_and_cause_and_a_remedy(
    tmp_path: Path, kind: type[GeodelregError]
) -> None:
    case = CASES[kind]
    with pytest.raises(kind) as caught:
        case.provoke(tmp_path)
    assert type(caught.value) is kind
    for name in case.names:
        assert name in caught.value.cause
    assert len(caught.value.cause) > len(max(case.names, key=len)) + 8
    assert caught.value.remedy.endswith(".")
    assert caught.value.remedy[0].isupper()
    assert str(caught.value) == f"{caught.value.cause}. {caught.value.remedy}"
