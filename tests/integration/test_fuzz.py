"""Broken inputs end in an error of geodelreg's; those that once did not are kept in data/fuzz.

``python -m benchmarks fuzz`` runs many more.
"""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import click
import pytest

import geodelreg
from benchmarks.robustness.fuzz import Worker
from benchmarks.robustness.fuzz_cases import GCPS, SHIFT, TAGS, WRITE_OPTIONS, run_case, seeds
from benchmarks.robustness.hostile.families import is_hostile
from geodelreg.errors import GeodelregError
from geodelreg.geotiff.corrected import write_corrected
from geodelreg.geotiff.inplace import edit_in_place
from geodelreg.options import AlignOptions, WriteOptions
from geodelreg.product.warp import write_warped
from geodelreg.values.raster import Grid
from geodelreg.values.result import Correction
from geodelreg_cli.main import cli
from tests.integration.faults import names
from tests.integration.raster_samples import TRANSFORM, UTM18

CORPUS = sorted((Path(__file__).parents[1] / "data" / "fuzz").glob("*.*"))
RASTERS = [path for path in CORPUS if path.suffix in (".tif", ".vrt", ".png")]
POINTS = [path for path in CORPUS if path not in RASTERS]

HOSTILE_COUNT = 100
HOSTILE = list(filter(is_hostile, range(100_031, 101_000)))[:HOSTILE_COUNT]

needs_proc = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="watches processes through /proc"
)
# rasterio drops messages of GDAL that are no UTF-8 in this way
pytestmark = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning",
    "ignore::rasterio.errors.NotGeoreferencedWarning",
)


def sound(folder: Path, layout: str, is_pan: bool, side: int) -> Path:
    seed = next(seed for seed in seeds(is_pan, side) if seed.name == layout)
    for name, data in seed.files.items():
        (folder / name).write_bytes(data)
    return folder / seed.main


@pytest.mark.parametrize("broken", RASTERS, ids=lambda path: path.name)
def test_rasters_that_once_broke_it(tmp_path: Path, broken: Path) -> None:
    (tmp_path / "other").mkdir()
    sound(tmp_path, "tiled-deflate", False, 80)  # the file behind the VRTs
    path = Path(shutil.copy(broken, tmp_path / f"broken{broken.suffix}"))
    ms = sound(tmp_path / "other", "striped", False, 80)
    pan = sound(tmp_path / "other", "striped", True, 192 if "patch" in broken.name else 80)
    for pair in ((path, pan), (ms, path)):
        with suppress(GeodelregError):
            geodelreg.check(*pair, AlignOptions(threads=1))


@pytest.mark.parametrize(
    "broken", [path for path in RASTERS if path.suffix != ".vrt"], ids=lambda path: path.name
)
def test_rasters_that_once_broke_writing(tmp_path: Path, broken: Path) -> None:
    path = Path(shutil.copy(broken, tmp_path / f"broken{broken.suffix}"))
    before, refusals = names(tmp_path), []
    correction = Correction("affine", UTM18, TRANSFORM, TRANSFORM @ SHIFT)
    reference = Grid(TRANSFORM, (80, 80), UTM18)
    for number, given in enumerate(WRITE_OPTIONS):
        options = WriteOptions(**given)
        target = tmp_path / f"out{number}.{'vrt' if options.driver == 'VRT' else 'tif'}"
        try:
            if options.warp:
                write_warped(path, target, correction, reference, TAGS, options)
            else:
                write_corrected(path, target, correction, GCPS, TAGS, options)
        except GeodelregError as error:
            refusals.append(error)
            assert names(tmp_path) == before
        else:
            before = names(tmp_path)
    for error in refusals:
        assert path.name in str(error) or "out" in str(error)
        assert error.cause.isprintable()
    with suppress(GeodelregError):
        edit_in_place(path, correction, GCPS, TAGS)


@pytest.mark.parametrize("broken", POINTS, ids=lambda path: path.name)
def test_points_that_once_broke_it(tmp_path: Path, broken: Path) -> None:
    raster = sound(tmp_path, "striped", False, 80)
    args = ["gcps", str(broken), str(tmp_path / "out.gcp"), "--raster", str(raster), "-q"]
    with suppress(GeodelregError, click.ClickException):
        cli.main(args, standalone_mode=False)


@pytest.mark.parametrize("first", range(100_000, 100_275, 25))
def test_broken_inputs_end_cleanly(tmp_path: Path, first: int) -> None:
    for number in range(first, first + 25):
        if is_hostile(number):
            continue
        folder = tmp_path / str(number)
        folder.mkdir()
        row = run_case(number, folder)
        assert row["outcome"] in ("ok", "error"), row
        assert row["broken"] == [], row


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Worker]:
    one = Worker.start(tmp_path_factory.mktemp("worker"), shutil.which("strace") is not None)
    yield one
    one.stop()


@needs_proc
@pytest.mark.parametrize("number", HOSTILE)
def test_hostile_inputs_change_fetch_and_run_nothing(worker: Worker, number: int) -> None:
    worker.give(number)
    while (row := worker.poll()) is None:
        time.sleep(0.01)
    assert row["outcome"] in ("ok", "error"), row
    assert row["broken"] == [], row


@needs_proc
def test_a_dying_worker_is_noticed(tmp_path: Path) -> None:
    worker = Worker.start(tmp_path, traced=False)
    try:
        worker.give(1)
        os.kill(worker.process.pid, signal.SIGSEGV)
        while (row := worker.poll()) is None:
            time.sleep(0.01)
        assert row["outcome"] == "crash"
        assert "-11" in row["detail"]
    finally:
        worker.stop()
