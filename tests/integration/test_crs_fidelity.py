"""The CRS of a raster survives every way of writing it, or the way is refused.

GDAL tells the CRS, the coordinate epoch and the axis mapping of a file, pyproj whether two CRSs are
the same.
"""

from __future__ import annotations

import html
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from affine import Affine
from pyproj import CRS
from rasterio.enums import WktVersion
from rasterio.io import MemoryFile

import geodelreg
from geodelreg import WriteOptions
from geodelreg.errors import OutputUnwritableError
from geodelreg.values.raster import Grid
from geodelreg.values.result import Alignment
from tests.integration.crs_zoo import DIFFICULT, zoo
from tests.unit.alignment_sample import alignment

HEADER = Affine(8.0, 0.0, 100.0, 0.0, -8.0, 200.0)
CORRECTED = Affine(8.0, 0.0, 106.0, 0.0, -8.0, 197.0)
SHAPE = (80, 100)


@dataclass(frozen=True)
class Said:
    """What GDAL reads from a file."""

    wkt: str
    attributes: dict[str, str]

    @classmethod
    def of(cls, path: Path) -> Said:
        with rasterio.open(path) as dataset, MemoryFile(ext=".vrt") as memory:
            rasterio.shutil.copy(dataset, memory.name, driver="VRT")
            found = re.search(b"<(SRS|GCPList)([^>]*)>", memory.read())
            crs = dataset.crs or dataset.gcps[1]
        if crs is None or found is None:
            return cls("", {})
        attributes = re.findall(
            '(dataAxisToSRSAxisMapping|coordinateEpoch)="([^"]*)"', found[2].decode()
        )
        wkt = crs.to_wkt(version=WktVersion.WKT2_2019)
        return cls(wkt, dict(attributes))

    def is_same(self, other: Said) -> bool:
        if self.attributes != other.attributes:
            return False
        return self.wkt == other.wkt or CRS.from_wkt(self.wkt).equals(CRS.from_wkt(other.wkt))


def plain(path: Path) -> None:
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=SHAPE[1],
        height=SHAPE[0],
        count=1,
        dtype="uint8",
        transform=HEADER,
    ) as dataset:
        dataset.write(np.arange(SHAPE[0] * SHAPE[1]).reshape(1, *SHAPE).astype("uint8"))


def in_pam(folder: Path, wkt: str, attributes: str) -> Path:
    path = folder / "ms.tif"
    plain(path)
    element = f"<SRS {attributes}>{html.escape(wkt)}</SRS>"
    Path(f"{path}.aux.xml").write_text(f"<PAMDataset>{element}</PAMDataset>")
    return path


def in_tiff(folder: Path, wkt: str, attributes: str) -> Path:
    path = folder / "keys.tif"
    rasterio.shutil.copy(in_pam(folder, wkt, attributes), path, driver="GTiff")
    return path


def in_vrt(folder: Path, wkt: str, attributes: str) -> Path:
    path = folder / "ms.vrt"
    plain(folder / "pixels.tif")
    rasterio.shutil.copy(folder / "pixels.tif", path, driver="VRT")
    text = re.sub("<SRS.*</SRS>", "", path.read_text())
    head, rest = text.split(">", 1)
    path.write_text(f"{head}><SRS {attributes}>{html.escape(wkt)}</SRS>{rest}")
    return path


def aligned(path: Path) -> Alignment:
    with rasterio.open(path) as dataset:
        wkt = dataset.crs.to_wkt(version=WktVersion.WKT2_2019)
    grid = Grid(HEADER, SHAPE, wkt)
    return alignment(
        source=grid,
        reference=grid,
        source_paths=(str(path),),
        reference_path=str(path),
        corrected=CORRECTED,
    )


def to_tiff(path: Path, folder: Path) -> Path:
    out = folder / "out.tif"
    geodelreg.write(aligned(path), out)
    return out


def to_deflate(path: Path, folder: Path) -> Path:
    out = folder / "out.tif"
    geodelreg.write(aligned(path), out, WriteOptions(creation_options=("COMPRESS=DEFLATE",)))
    return out


def to_cog(path: Path, folder: Path) -> Path:
    out = folder / "out.tif"
    geodelreg.write(aligned(path), out, WriteOptions(driver="COG"))
    return out


def to_vrt(path: Path, folder: Path) -> Path:
    out = folder / "out.vrt"
    geodelreg.write(aligned(path), out)
    return out


def to_png(path: Path, folder: Path) -> Path:
    out = folder / "out.png"
    geodelreg.write(aligned(path), out)
    return out


def in_place(path: Path, folder: Path) -> Path:
    shutil.copytree(path.parent, folder, dirs_exist_ok=True)
    geodelreg.write_in_place(aligned(folder / path.name))
    return folder / path.name


def warped(path: Path, folder: Path) -> Path:
    out = folder / "out.tif"
    geodelreg.write(aligned(path), out, WriteOptions(warp=True))
    return out


def by_gcps(path: Path, folder: Path) -> Path:
    out = folder / "out.tif"
    geodelreg.write(aligned(path), out, WriteOptions(georef="gcps"))
    return out


Container = Callable[[Path, str, str], Path]
Way = Callable[[Path, Path], Path]
Herd = dict[str, tuple[Path, Said]]


@pytest.fixture(scope="module")
def herds(tmp_path_factory: pytest.TempPathFactory) -> dict[Container, Herd]:
    """Every CRS in PAM, the difficult ones in all, with what GDAL reads there; never written to."""
    made: dict[Container, Herd] = {}
    for container in (in_tiff, in_pam, in_vrt):
        herd: Herd = {}
        for name, (wkt, attributes) in zoo().items():
            if container is in_pam or DIFFICULT.search(name):
                path = container(tmp_path_factory.mktemp("herd"), wkt, attributes)
                herd[name] = path, Said.of(path)
                assert herd[name][1].wkt, name
        made[container] = herd
    return made


def unfaithful(folder: Path, way: Way, herd: Herd) -> dict[str, str]:
    """Names of the CRSs that do not come through, with what happened."""
    found = {}
    for number, (name, (path, before)) in enumerate(herd.items()):
        place = folder / str(number)
        place.mkdir()
        content = path.read_bytes()
        try:
            after = Said.of(way(path, place))
        except OutputUnwritableError as refusal:
            found[name] = f"refused: {refusal.cause}"
            assert path.read_bytes() == content
            assert not any("out" in file.name for file in place.iterdir())
            continue
        if not after.wkt:
            found[name] = "lost"
        elif not before.is_same(after):
            found[name] = f"altered: {before} to {after}"
    return found


def test_every_crs_survives_the_copy(herds: dict[Container, Herd], tmp_path: Path) -> None:
    assert len(herds[in_pam]) > 150
    assert unfaithful(tmp_path, to_tiff, herds[in_pam]) == {}


@pytest.mark.parametrize(
    ("container", "way"),
    [
        # keys are left, made anew beside them, or all written by GDAL: what writes any other
        # format reads the CRS in one way, whatever holds it
        *((in_pam, way) for way in (to_deflate, to_cog, to_vrt, to_png, in_place, warped, by_gcps)),
        *((in_tiff, way) for way in (to_tiff, to_vrt, in_place)),
        *((in_vrt, way) for way in (to_tiff, to_vrt)),
    ],
)
def test_difficult_crs_survives_or_is_refused(
    herds: dict[Container, Herd], tmp_path: Path, container: Container, way: Way
) -> None:
    herd = {name: animal for name, animal in herds[container].items() if DIFFICULT.search(name)}
    found = unfaithful(tmp_path, way, herd)
    assert [what for what in found.values() if not what.startswith("refused")] == []
    if way is to_tiff:
        assert found == {}
    # GDAL has no place for the epoch of GCPs, and reads meridians in grads out of keys so that no
    # other file says the same
    excusable = "2021" if way is by_gcps else "NTF|paris"
    assert [name for name in found if not re.search(excusable, name)] == []


def test_warp_onto_pan_takes_its_epoch(tmp_path: Path) -> None:
    wkt, _ = zoo()["EPSG:9057"]
    (tmp_path / "pan").mkdir()
    (tmp_path / "ms").mkdir()
    pan = in_pam(tmp_path / "pan", wkt, 'coordinateEpoch="2010.5"')
    ms = in_tiff(tmp_path / "ms", wkt, 'coordinateEpoch="2021.3"')
    made = aligned(ms)
    made = replace(made, reference=replace(made.reference, paths=(str(pan),)))
    geodelreg.write(made, tmp_path / "out.tif", WriteOptions(warp=True, warp_grid="pan"))
    assert Said.of(tmp_path / "out.tif").attributes["coordinateEpoch"] == "2010.5"
