"""Real pairs before and after alignment, measured by windowed correlation, not by the tool."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from affine import Affine

from benchmarks.accuracy import quadrants
from benchmarks.accuracy.measure import (
    MeasureOptions,
    Offsets,
    Raster,
    measure_offsets,
    read_raster,
)
from benchmarks.records import save
from benchmarks.report import machine, replace_section


@dataclass(frozen=True, slots=True)
class Pair:
    """A real MS and PAN raster.

    Attributes
    ----------
    name : str
    ms, pan : str
        Files relative to the data folder.
    pan_band : int
        Band of `pan` that serves as the reference, from 1.
    first_row : int
        MS rows above it are left out of the measurement (not of the alignment): clouds.
    window_px, stride_px : int
        Of the measurement, in MS pixels.
    minimum_score : float
        Windows that correlate less are left out of the measurement.
    """

    name: str
    ms: str
    pan: str
    pan_band: int = 1
    first_row: int = 0
    window_px: int = 48
    stride_px: int = 24
    minimum_score: float = 0.7


_HEADING = """## Real pairs

`python -m benchmarks real --data DIR --docs docs/benchmarks.md` ({machine}):
shift of MS against PAN in PAN px, column and row, by a windowed correlation that shares no code
with the library (its noise is about 0.05 px; on the aerial and the small pairs the windows scatter
by far more, as the median window shows). Tie points: the median distance of theirs from the
fit, in PAN px."""
NAIP = "naip/m_4709963_se_14_1_{}.tif"
SENTINEL_MS = "sentinel2/s2_20m_b05_b06_b07_b8a_b11_b12.tif"
SENTINEL_PAN = "sentinel2/s2_10m_b02_b03_b04_b08.tif"
PAIRS: tuple[Pair, ...] = (
    Pair("landsat8_momotombo", "landsat8_momotombo/ms.tif", "landsat8_momotombo/pan.tif"),
    Pair("landsat8_oman", "landsat8_oman/ms.tif", "landsat8_oman/pan.tif"),
    # Broken cloud, at another place in each image, lies over all but the south.
    Pair("landsat8_clouds", "landsat8_clouds/ms.tif", "landsat8_clouds/pan.tif", first_row=480),
    Pair(
        "landsat8_twodates", "landsat8_twodates/20190809.tif", "landsat8_twodates/20190825.tif", 3
    ),
    # Half of it is water; the header is right.
    Pair("sentinel2 20 m on B02", SENTINEL_MS, SENTINEL_PAN, 1),
    Pair("sentinel2 20 m on B04", SENTINEL_MS, SENTINEL_PAN, 3),
    Pair("sentinel2 20 m on B08", SENTINEL_MS, SENTINEL_PAN, 4),
    Pair("cbers4a", "cbers4a/ms.tif", "cbers4a/pan.tif", window_px=24, stride_px=8),
    # Buildings lean; the second and the third are half no data, which no header says.
    *(Pair(f"rotterdam {n}", f"rotterdam/ms{n}.tif", f"rotterdam/pan{n}.tif") for n in (1, 2, 3)),
    Pair("naip 2012/2014", NAIP.format(20120731), NAIP.format(20140720), 4, 0, 64, 32),
    Pair("naip 2018/2019", NAIP.format(20180716), NAIP.format(20190904), 4, 0, 64, 32),
    Pair(
        "EPSG:4326 1990/2000",
        "landsat_geographic/1990.tif",
        "landsat_geographic/2000.tif",
        1,
        0,
        64,
        32,
    ),
    Pair(
        "EPSG:4326 2000/2020",
        "landsat_geographic/2000.tif",
        "landsat_geographic/2020.tif",
        1,
        0,
        64,
        32,
    ),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table; offsets are MS content minus PAN content, in PAN pixels.

    `residual_px` is the median distance of the tie points from the fit.
    """

    name: str
    verdict: str
    model: str
    before_px: tuple[float, float]
    before_radial_px: float
    after_px: tuple[float, float]
    after_radial_px: float
    residual_px: float
    windows: int
    band: str
    seconds: float


def measure_pair(pair: Pair, data: Path, corrected: Affine | None = None) -> Offsets:
    """Measure a pair under the header of MS, or under a corrected geotransform.

    Parameters
    ----------
    pair : Pair
    data : Path
        Folder that holds the pairs.
    corrected : Affine or None
    """
    ms = read_raster(data / pair.ms)
    ms.valid[: pair.first_row] = False
    if corrected is not None:
        ms = replace(ms, transform=corrected)
    pan: Raster = read_raster(data / pair.pan, [pair.pan_band])
    options = MeasureOptions(pair.window_px, pair.stride_px, minimum_score=pair.minimum_score)
    return measure_offsets(ms, pan, options)


def align_pair(pair: Pair, data: Path) -> Row:
    """Measure, align with defaults, measure again."""
    from geodelreg import AlignOptions, align
    from geodelreg.errors import GeodelregError

    before = measure_pair(pair, data)
    started = time.perf_counter()
    try:
        alignment = align(data / pair.ms, data / pair.pan, AlignOptions(pan_band=pair.pan_band))
        verdict, model = alignment.verdict.outcome.value, alignment.correction.model
        corrected, points = alignment.correction.corrected, alignment.tie_points
        residual = float(np.median(np.hypot(*points.residual_px[points.kept].T)))
    except GeodelregError as error:
        verdict, model, corrected = f"{type(error).__name__}: {error.cause}", "none", None
        residual = float("nan")
    seconds = time.perf_counter() - started
    after = measure_pair(pair, data, corrected) if corrected is not None else before
    return Row(
        pair.name,
        verdict,
        model,
        before.median_px,
        before.radial_px,
        after.median_px,
        after.radial_px,
        residual,
        len(after.score),
        after.band,
        seconds,
    )


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = [
        "| pair | verdict | model | before | after | median window | windows | tie points | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.name} | {r.verdict} | {r.model} | {r.before_px[0]:+.2f}, {r.before_px[1]:+.2f} "
        f"| {r.after_px[0]:+.3f}, {r.after_px[1]:+.3f} "
        f"| {r.before_radial_px:.2f} → {r.after_radial_px:.3f} | {r.windows} ({r.band}) "
        f"| {r.residual_px:.3f} | {r.seconds:.1f} |"
        for r in rows
    ]
    return "\n".join(lines)


def by_quadrants(pairs: list[Pair], data: Path) -> str:
    """Table of each quarter of the pairs against the other three."""
    found: list[quadrants.Quadrant] = []
    refused: dict[str, int] = {}
    for pair in pairs:
        four = list(quadrants.quadrants(pair.name, data / pair.ms, data / pair.pan, pair.pan_band))
        found += [one for one in four if one is not None]
        refused[pair.name] = four.count(None)
    return quadrants.table(found, refused)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks real``."""
    parser.add_argument("--data", type=Path, required=True, help="folder with the real pairs")
    parser.add_argument("--only", default="", help="names, comma-separated")
    parser.add_argument("--out", type=Path, help="JSON file for the rows")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")
    parser.add_argument(
        "--quadrants", action="store_true", help="each quarter against the other three, instead"
    )


def run(args: argparse.Namespace) -> int:
    """Align every pair that is there; print the table, in PAN pixels."""
    wanted = {name for name in args.only.split(",") if name}
    there = []
    for pair in PAIRS:
        if wanted and pair.name not in wanted:
            continue
        if not (args.data / pair.ms).exists() or not (args.data / pair.pan).exists():
            print(f"{pair.name}: skipped, not in {args.data}")
            continue
        there.append(pair)
    if args.quadrants:
        page = by_quadrants(there, args.data)
        print(page)
        if args.docs:
            replace_section(args.docs, "quadrants", page)
        return 0
    rows = [align_pair(pair, args.data) for pair in there]
    print(table(rows))
    if args.out:
        save(args.out, rows)
    if args.docs:
        replace_section(args.docs, "real", f"{_HEADING.format(machine=machine())}\n\n{table(rows)}")
    return 0
