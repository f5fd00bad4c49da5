"""VRT that shows the source raster as it is, placed by GCPs instead of a geotransform."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from geodelreg.door.opening import open_raster
from geodelreg.errors import GcpFormatError, RasterUnreadableError
from geodelreg.product.gcps.context import Decoded, GcpContext, crs_wkt_of, exact, numbers, one_line
from geodelreg.values.points import Gcp

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

# control characters, as TIFF tags may hold them, that XML 1.0 cannot express
_NOT_XML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f]")


def encode(gcps: Sequence[Gcp], context: GcpContext, path: Path) -> str:
    """Text of a VRT at `path`, which names the source raster relative to itself.

    Raises
    ------
    GcpFormatError
        If no source raster is named, or several that do not share one grid.
    RasterUnreadableError
        If a source raster cannot be opened.
    """
    if not context.source_paths:
        raise GcpFormatError("a VRT needs the raster it shows", "Name the source raster.")
    height, width = context.source.shape
    root = ET.Element("VRTDataset", rasterXSize=str(width), rasterYSize=str(height))
    _add_gcps(root, gcps, context.source.crs_wkt)
    for source in context.source_paths:
        _add_source(root, source, context, path)
    ET.indent(root)
    return _NOT_XML.sub("", ET.tostring(root, encoding="unicode")) + "\n"


def _add_gcps(root: ET.Element, gcps: Sequence[Gcp], crs_wkt: str) -> None:
    element = ET.SubElement(root, "GCPList", Projection=one_line(crs_wkt))
    for gcp in gcps:
        values = {"Pixel": gcp.column, "Line": gcp.row, "X": gcp.x, "Y": gcp.y, "Z": gcp.z}
        attributes = {name: exact(value) for name, value in values.items()}
        ET.SubElement(element, "GCP", {"Id": gcp.id, "Info": gcp.info} | attributes)


def _add_source(root: ET.Element, source: str, context: GcpContext, path: Path) -> None:
    from rasterio.errors import RasterioError

    several = len(context.source_paths) > 1
    try:
        with open_raster(source) as dataset:
            same = dataset.transform.almost_equals(context.source.transform, 1e-9)
            if dataset.shape != context.source.shape or (several and not same):
                raise GcpFormatError(
                    f"{source} is not on the grid of the points", "Write one file per grid."
                )
            if not several:
                _add_metadata(root, dataset.tags())
            file_name = _file_name(source, path)
            for number in dataset.indexes:
                band = _add_band(root, dataset, number, file_name)
                if several:
                    _add_mask(band, dataset, file_name)
            if not several:
                _add_mask(root, dataset, file_name)
    except RasterioError as error:
        raise RasterUnreadableError(f"{source} cannot be read ({error})") from error


def _file_name(source: str, path: Path) -> ET.Element:
    """``SourceFilename``; GDAL's own names (/vsi…, URLs, subdatasets) stay as they are."""
    name, relative = source, "0"
    if Path(source).is_file():
        absolute = Path(os.path.realpath(Path(source).parent), Path(source).name)
        folder = Path(os.path.realpath(path.parent))
        name = str(absolute)
        if absolute.drive == folder.drive:
            name, relative = Path(os.path.relpath(absolute, folder)).as_posix(), "1"
    element = ET.Element("SourceFilename", relativeToVRT=relative, shared="0")
    element.text = name
    return element


def _add_metadata(parent: ET.Element, tags: dict[str, str]) -> None:
    if tags:
        element = ET.SubElement(parent, "Metadata")
        for key, value in sorted(tags.items()):
            ET.SubElement(element, "MDI", key=key).text = value


def _add_band(
    root: ET.Element, dataset: DatasetReader, number: int, file_name: ET.Element
) -> ET.Element:
    from rasterio.dtypes import dtype_rev, typename_fwd

    position = str(len(root.findall("VRTRasterBand")) + 1)
    data_type = typename_fwd[dtype_rev[dataset.dtypes[number - 1]]]
    band = ET.SubElement(root, "VRTRasterBand", dataType=data_type, band=position)
    _add_metadata(band, dataset.tags(number))
    _describe(band, dataset, number)
    source = _add_simple_source(band, file_name, str(number))
    height, width = dataset.block_shapes[number - 1]
    size = {"RasterXSize": dataset.width, "RasterYSize": dataset.height}
    block = {"BlockXSize": width, "BlockYSize": height}
    properties = {name: str(value) for name, value in (size | block).items()}
    ET.SubElement(source, "SourceProperties", {"DataType": data_type} | properties)
    return band


def _describe(band: ET.Element, dataset: DatasetReader, number: int) -> None:
    from rasterio.enums import ColorInterp

    index = number - 1
    offset, scale = dataset.offsets[index], dataset.scales[index]
    no_data, colour = dataset.nodatavals[index], dataset.colorinterp[index]
    texts = {
        "Description": dataset.descriptions[index],
        "UnitType": dataset.units[index],
        "Offset": exact(offset) if offset else None,
        "Scale": exact(scale) if scale != 1 else None,
        "NoDataValue": None if no_data is None else exact(no_data),
        "ColorInterp": colour.name if len(colour.name) > 2 else f"YCbCr_{colour.name}",
    }
    for name, text in texts.items():
        if text:
            ET.SubElement(band, name).text = text
    if colour is ColorInterp.palette:
        table = ET.SubElement(band, "ColorTable")
        for _, entry in sorted(dataset.colormap(number).items()):
            ET.SubElement(table, "Entry", {f"c{i}": str(c) for i, c in enumerate(entry, start=1)})


def _add_mask(parent: ET.Element, dataset: DatasetReader, file_name: ET.Element) -> None:
    from rasterio.enums import MaskFlags

    if dataset.mask_flag_enums[0] == [MaskFlags.per_dataset]:
        mask = ET.SubElement(ET.SubElement(parent, "MaskBand"), "VRTRasterBand", dataType="Byte")
        _add_simple_source(mask, file_name, "mask,1")


def _add_simple_source(band: ET.Element, file_name: ET.Element, number: str) -> ET.Element:
    source = ET.SubElement(band, "SimpleSource")
    source.append(file_name)
    ET.SubElement(source, "SourceBand").text = number
    return source


def decode(text: str, context: GcpContext | None) -> Decoded:
    """GCPs of a VRT's ``GCPList`` and their CRS; no raster is opened.

    Raises
    ------
    GcpFormatError
        If it is no VRT or has no GCPs.
    """
    try:
        element = ET.fromstring(text).find("GCPList")
    except ET.ParseError as error:
        raise GcpFormatError(f"it is not XML ({error})") from error
    if element is None:
        raise GcpFormatError("it has no GCPList")
    gcps = tuple(_gcp(item, index) for index, item in enumerate(element.findall("GCP"), start=1))
    crs = element.get("Projection")
    return gcps, crs_wkt_of(crs) if crs else None


def _gcp(item: ET.Element, index: int) -> Gcp:
    texts = [item.get(name, "") for name in ("Pixel", "Line", "X", "Y")]
    column, row, x, y = numbers(texts, index)
    z = numbers([item.get("Z", "0")], index)[0]
    return Gcp(item.get("Id", str(index)), column, row, x, y, z, item.get("Info", ""))
