"""Each example of README and docs, run as it stands there on small files of the names it uses."""

from __future__ import annotations

import json
import re
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

import geodelreg
from benchmarks.batch.pairs import write_pairs
from geodelreg.batch.cells import FILES, NEVER, SIDE_FILES
from tests.cli.batch_helpers import outcomes
from tests.cli.examples import ROOT, examples, pages, run_examples
from tests.cli.helpers import SAMPLES, SIDE, copy_corner, copy_samples


def pixels(name: str) -> NDArray[Any]:
    """All bands of the upper left corner of a sample."""
    with rasterio.open(SAMPLES / name) as dataset:
        return np.asarray(dataset.read(window=Window(0, 0, SIDE[name], SIDE[name])))


def write_as(path: Path, model: str, data: NDArray[Any], **profile: Any) -> None:
    """Pixels that begin in the upper left corner of a sample."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(SAMPLES / model) as dataset:
        kept = {"crs": dataset.crs, "transform": dataset.transform}
    shape = dict(zip(("count", "height", "width"), data.shape, strict=True))
    with rasterio.open(
        path, "w", **({"driver": "GTiff", "dtype": data.dtype} | kept | shape | profile)
    ) as dataset:
        dataset.write(data)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def is_aligned(ms: Path | list[Path], pan: Path, pan_band: int = 1) -> bool:
    return geodelreg.check(ms, pan, pan_band=pan_band).outcome.value == "aligned"


def write_lakes(path: Path) -> None:
    """A lake in a corner of PAN."""
    with rasterio.open(SAMPLES / "pan.tif") as dataset:
        x, y = dataset.transform @ (20, 20)
    ring = [[x, y], [x + 300, y], [x + 300, y - 300], [x, y]]
    lake = {"type": "Polygon", "coordinates": [ring]}
    crs = {"type": "name", "properties": {"name": "EPSG:32618"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [
        {"type": "Feature", "properties": {}, "geometry": lake}
    ]}))  # fmt: skip


def masks(folder: Path, names: list[str], value: int, background: int) -> None:
    """Masks on the grid of MS that hide its leftmost columns."""
    data = np.full((1, SIDE["ms.tif"], SIDE["ms.tif"]), background, dtype=np.uint8)
    data[:, :, :10] = value
    for name in names:
        driver = "JP2OpenJPEG" if name.endswith(".jp2") else "GTiff"
        lossless = {"QUALITY": 100, "REVERSIBLE": "YES"} if name.endswith(".jp2") else {}
        write_as(folder / name, "ms.tif", data, driver=driver, **lossless)


def landsat(folder: Path) -> None:
    scene = folder / "LC09_L1TP_014034_20240612_20240612_02_T1"
    for number, band in enumerate(pixels("ms.tif")[:3], start=2):
        write_as(Path(f"{scene}_B{number}.TIF"), "ms.tif", band[None])
    write_as(Path(f"{scene}_B8.TIF"), "pan.tif", pixels("pan.tif"))
    clear = np.full((1, 100, 100), 21824, dtype=np.uint16)
    clear[:, :20] = 22280
    write_as(Path(f"{scene}_QA_PIXEL.TIF"), "ms.tif", clear)


def landsat_is_sharp(folder: Path) -> None:
    with rasterio.open(folder / "sharp.tif") as dataset:
        assert (dataset.count, dataset.shape) == (3, (400, 400))
        assert "landsat-qa" in dataset.tags()["GEODELREG_MASKS"]
    assert is_aligned(folder / "sharp.tif", SAMPLES / "pan.tif")


def sentinel2(folder: Path) -> None:
    pan = pixels("pan.tif")
    write_as(folder / "bands_20m.tif", "ms.tif", pixels("ms.tif"))
    write_as(folder / "bands_10m.tif", "pan.tif", np.concatenate([pan * 0 + 7] * 3 + [pan]))


def sentinel2_is_sharp(folder: Path) -> None:
    assert is_aligned(folder / "bands_20m_aligned.tif", folder / "bands_10m.tif", 4)
    with rasterio.open(folder / "bands_20m_sharp.tif") as dataset:
        assert (dataset.count, dataset.shape) == (4, (400, 400))


def worldview(folder: Path) -> None:
    for name in SIDE:
        write_as(folder / name, name, pixels(name) // 2)


def keeps_eleven_bits(folder: Path) -> None:
    with rasterio.open(folder / "sharp.tif") as dataset:
        assert dataset.read().max() <= 2047


def framed(folder: Path) -> None:
    copy_corner(folder)
    data = pixels("ms.tif")
    data[:, :, :25] = 0
    write_as(folder / "framed.tif", "ms.tif", data)


def frame_is_no_data(folder: Path) -> None:
    with rasterio.open(folder / "sharp.tif") as dataset:
        assert dataset.nodata == 0
        assert 0.2 < (dataset.read(1) == 0).mean() < 0.3


def clouds(folder: Path) -> None:
    copy_corner(folder)
    clear = np.full((1, 100, 100), 21824, dtype=np.uint16)
    qa = "LC08_L2SP_016035_20210608_20210615_02_T1_QA_PIXEL.TIF"
    write_as(folder / qa, "ms.tif", clear)
    lossless = {"driver": "JP2OpenJPEG", "QUALITY": 100, "REVERSIBLE": "YES"}
    for name, band in zip(("B02.jp2", "B03.jp2", "B04.jp2"), pixels("ms.tif"), strict=False):
        write_as(folder / name, "ms.tif", band[None], **lossless)
    masks(folder, ["T18SUF_20210608T155819_SCL_20m.jp2", "classes.tif"], 9, 4)
    masks(folder, ["ms_clouds.tif"], 1, 0)
    write_lakes(folder / "lakes.geojson")


def band_files(folder: Path) -> None:
    copy_corner(folder)
    for name, band in zip(("B2", "B3", "B4", "B8A"), pixels("ms.tif"), strict=True):
        write_as(folder / f"{name}.tif", "ms.tif", band[None])
    (folder / "pan.tif").rename(folder / "B8.tif")


def scene_of_several_files(folder: Path) -> None:
    copy_corner(folder)
    masks(folder, ["mask.tif"], 1, 0)
    write_as(folder / "B05.tif", "ms.tif", pixels("ms.tif")[:, :50, :50])
    write_lakes(folder / "fields.geojson")


def python_files(folder: Path) -> None:
    copy_corner(folder)
    masks(folder, ["clouds.tif"], 1, 0)
    masks(folder, ["SCL.jp2"], 9, 4)
    write_lakes(folder / "lakes.geojson")


def spline_is_aligned(folder: Path) -> None:
    with rasterio.open(folder / "spline.tif") as spline, rasterio.open(folder / "pan.tif") as pan:
        assert spline.transform == pan.transform
    assert is_aligned(folder / "spline.tif", folder / "pan.tif")


def output_is_aligned(folder: Path) -> None:
    assert is_aligned(folder / "aligned.tif", folder / "pan.tif")


def header_is_back(folder: Path) -> None:
    with rasterio.open(folder / "ms.tif") as after, rasterio.open(SAMPLES / "ms.tif") as before:
        assert after.transform == before.transform


def bands_are_aligned(folder: Path) -> None:
    # together, as they were aligned: of one band alone `check` cannot tell
    assert is_aligned(sorted((folder / "aligned").iterdir()), folder / "B8.tif")


def many_pairs(folder: Path) -> None:
    write_pairs(folder, 2)


def pairs_are_aligned(folder: Path) -> None:
    for table in ("pairs", "cluster"):
        assert outcomes(folder / f"{table}.results.csv") == ["aligned", "aligned"]
    assert outcomes(folder / "check.results.csv") == ["misaligned", "misaligned"]
    assert (folder / "pairs.geojson").exists()
    assert (folder / "report" / "index.html").exists()
    assert len(list((folder / "out").glob("*.tif"))) == 2


def nothing(folder: Path) -> None:
    """No more to look at."""


# What the examples of a page need, and what must be true afterwards.
PAGES: dict[str, tuple[Callable[[Path], None], Callable[[Path], None]]] = {
    "docs/api.md": (python_files, output_is_aligned),
    "docs/batch.md": (many_pairs, pairs_are_aligned),
    "docs/start.md": (copy_corner, output_is_aligned),
    "docs/how-to/apply.md": (scene_of_several_files, nothing),
    "docs/how-to/band-files.md": (band_files, bands_are_aligned),
    "docs/how-to/bent.md": (copy_corner, spline_is_aligned),
    "docs/how-to/check.md": (copy_samples, nothing),
    "docs/how-to/clouds.md": (clouds, nothing),
    "docs/how-to/in-place.md": (copy_corner, header_is_back),
    "docs/how-to/no-data.md": (framed, frame_is_no_data),
    "docs/how-to/xarray.md": (copy_corner, output_is_aligned),
    "docs/tutorials/landsat.md": (landsat, landsat_is_sharp),
    "docs/tutorials/sentinel-2.md": (sentinel2, sentinel2_is_sharp),
    "docs/tutorials/vhr.md": (worldview, keeps_eleven_bits),
}
SCRIPT = "docs/how-to/scripts.md"


@pytest.mark.parametrize("page", [page for page in pages() if examples(page) and page != SCRIPT])
def test_examples_run(page: str, tmp_path: Path) -> None:
    prepare, look = PAGES.get(page, (copy_corner, nothing))
    prepare(tmp_path)
    run_examples(page, tmp_path, free_port())
    look(tmp_path)


@pytest.mark.parametrize(("blank", "outcome"), [(False, "aligned"), (True, "not aligned")])
def test_script_tells_a_refusal(tmp_path: Path, blank: bool, outcome: str) -> None:
    copy_corner(tmp_path)
    if blank:
        noise = np.random.default_rng(1).integers(1, 4000, (4, 100, 100)).astype(np.uint16)
        write_as(tmp_path / "ms.tif", "ms.tif", noise)
    run_examples(SCRIPT, tmp_path, free_port())
    assert (tmp_path / "outcome.txt").read_text().strip() == outcome
    with rasterio.open(tmp_path / "onto_pan.tif") as dataset:
        assert dataset.shape == (400, 400)


def test_gdals_own_tools_sharpen_the_same(tmp_path: Path) -> None:
    if shutil.which("gdalwarp") is None or shutil.which("gdal_pansharpen.py") is None:
        pytest.skip("GDAL's programs are not installed")
    page = "docs/tutorials/pansharpening.md"
    copy_corner(tmp_path)
    (recipe,) = examples(page, "bash")
    assert "gdalwarp" in recipe[1]
    run_examples(page, tmp_path, free_port(), "bash")
    geodelreg.pansharpen(
        tmp_path / "aligned.tif", tmp_path / "pan.tif", tmp_path / "ours.tif", weights="equal"
    )
    with (
        rasterio.open(tmp_path / "ours.tif") as ours,
        rasterio.open(tmp_path / "sharp.tif") as theirs,
    ):
        assert (ours.transform, ours.shape) == (theirs.transform, theirs.shape)
        covered = ours.dataset_mask() > 0
        apart = np.abs(ours.read().astype(int) - theirs.read())[:, covered]
    assert apart.max() <= 1


def test_every_page_that_is_prepared_has_examples() -> None:
    assert all(examples(page) for page in (*PAGES, SCRIPT))


def test_columns_that_a_manifest_needs_or_must_not_have_are_named() -> None:
    text = (ROOT / "docs" / "batch.md").read_text(encoding="utf-8")
    section = re.split(r"^## ", text, flags=re.M)[1]
    for name in (*FILES, *NEVER):
        assert f"`{name}`" in section
    assert not set(NEVER) & set(SIDE_FILES)
