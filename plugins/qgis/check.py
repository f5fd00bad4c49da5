"""Tries the plugin in the real QGIS: ``python plugins/qgis/check.py [--install]``.

Needs QGIS 3.22 or later with its Python (Debian: ``qgis`` and ``python3-qgis``), and geodelreg with
its ``dev`` extra in the Python that runs this.  It packs the plugin, installs the zip into an empty
profile, and compares what ``qgis_process`` writes with what the command line writes.  The rest is
in ``in_qgis``.  With ``--install`` it also makes the environment as a user would, which fetches
packages.  It takes some minutes.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import rasterio
from affine import Affine

from pack import ROOT, build

SHIFTS_PX = ((0.0, 0.0), (2.25, -1.5), (-3.0, 0.75))
"""How far the headers of the three MS rasters are moved, in MS pixels."""
PYTHON = os.environ.get("QGIS_PYTHON", "/usr/bin/python3")
PLUGINS = os.environ.get("QGIS_PLUGINS", "/usr/share/qgis/python/plugins")
PROCESS = shutil.which("qgis_process.bin") or "qgis_process"


def make_pairs(folder: Path) -> None:
    """Three pairs of the sample, their headers moved; three band files; a raster of noise."""
    folder.mkdir()
    with rasterio.open(ROOT / "sample_tiles" / "ms.tif") as sample:
        profile, pixels, transform = sample.profile, sample.read(), sample.transform
    profile.update(count=4)
    for number, shift in enumerate(SHIFTS_PX, start=1):
        shutil.copy(ROOT / "sample_tiles" / "pan.tif", folder / f"pan {number}.tif")
        profile["transform"] = transform @ Affine.translation(*shift)
        with rasterio.open(folder / f"ms {number}.tif", "w", **profile) as out:
            out.write(pixels)
        band = {**profile, "count": 1, "transform": transform}
        with rasterio.open(folder / f"band {number}.tif", "w", **band) as out:
            out.write(pixels[number - 1], 1)
    noise = np.random.default_rng(1).integers(1, 4000, pixels.shape).astype(pixels.dtype)
    with rasterio.open(folder / "noise.tif", "w", **profile) as out:
        out.write(noise)


def environment(home: Path, command: bool) -> dict[str, str]:
    """What QGIS starts with: an empty profile, no window, and geodelreg on PATH or not."""
    path = [str(home / "bin")] if command else []
    return {
        "PATH": os.pathsep.join([*path, "/usr/bin", "/bin"]),
        "HOME": str(home),
        "LANG": "C.UTF-8",
        "XDG_RUNTIME_DIR": str(home),
        "QT_QPA_PLATFORM": "offscreen",
        "QGIS_CUSTOM_CONFIG_PATH": str(home / "profile"),
        "PYTHONPATH": os.pathsep.join(
            [str(home / "profile/profiles/default/python/plugins"), PLUGINS]
        ),
        **{name: value for name, value in os.environ.items() if name.startswith("PIP_")},
    }


def qgis_process(home: Path, *words: str, command: bool = True) -> subprocess.CompletedProcess[str]:
    """Run ``qgis_process``."""
    return subprocess.run(
        [PROCESS, *words],
        env=environment(home, command),
        capture_output=True,
        text=True,
        check=False,
    )


def run_algorithm(
    home: Path, name: str, parameters: Mapping[str, object], command: bool = True
) -> str:
    """Run an algorithm in ``qgis_process``; what it prints.  A list is given one by one."""
    words = [
        f"{key}={value}"
        for key, values in parameters.items()
        for value in (values if isinstance(values, list) else [values])
    ]
    done = qgis_process(home, "run", f"geodelreg:{name}", "--", *words, command=command)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def geodelreg(*words: object, answers: tuple[int, ...] = (0,)) -> str:
    """Run the command line; what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", "geodelreg_cli", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in answers, done.stderr
    return done.stdout


def without_times(report: str) -> dict[str, Any]:
    """A report but for the seconds that the steps took."""
    found: dict[str, Any] = json.loads(report)
    del found["timings_s"]
    return found


def same_bytes(home: Path, folder: Path) -> None:
    """What QGIS writes is what the command line writes."""
    ms, pan = folder / "ms 1.tif", folder / "pan 1.tif"
    (folder / "cli").mkdir()
    for name, made in (
        ("align", ("a.tif", "a.points", "a.json")),
        ("pansharpen", ("s.tif",)),
        ("check", ("c.json",)),
    ):
        here, there = ([place / file for file in made] for place in (folder, folder / "cli"))
        if name == "align":
            keys = dict(zip(("OUTPUT", "GCPS", "REPORT"), here, strict=True))
            words = ["-o", there[0], "--gcps", there[1], "--report", there[2]]
        elif name == "pansharpen":
            keys, words = {"OUTPUT": here[0]}, ["-o", there[0]]
        else:
            keys, words = {"REPORT": here[0]}, ["--json"]
        run_algorithm(home, name, {"MS": ms, "PAN": pan, **keys})
        printed = geodelreg(name, ms, pan, *words, answers=(0, 4))
        if name == "check":
            there[0].write_text(printed, encoding="utf-8")
        for mine, theirs in zip(here, there, strict=True):
            if mine.suffix == ".json":
                assert without_times(mine.read_text()) == without_times(theirs.read_text())
                print(f"ok: {name}: {mine.name} equals but for timings_s")
            else:
                assert mine.read_bytes() == theirs.read_bytes()
                print(f"ok: {name}: {mine.name}, {mine.stat().st_size} bytes, all the same")


def make_vectors(folder: Path) -> tuple[Path, Path, Path]:
    """Points of the sample as GeoJSON, as GeoPackage, and as CSV."""
    geojson, gpkg, table = (folder / name for name in ("Äcker.geojson", "Wege.gpkg", "Orte.csv"))
    table.write_text("name,lon,lat\nOrt,-75.68,37.69\n")
    features = [
        {
            "type": "Feature",
            "properties": {"name": f"Ort {number}"},
            "geometry": {"type": "Point", "coordinates": [-75.68 + 0.002 * number, 37.69]},
        }
        for number in range(3)
    ]
    geojson.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    about, _, places, columns = pyogrio.raw.read(geojson)
    kind = about["geometry_type"]
    pyogrio.raw.write(
        gpkg, places, columns, about["fields"], crs=about["crs"], geometry_type=kind, driver="GPKG"
    )
    return geojson, gpkg, table


def without_date(gpkg: Path) -> str:
    """All tables of a GeoPackage but for the moment of its last change."""
    with sqlite3.connect(gpkg) as base:
        return re.sub(r"\d{4}-\d\d-\d\dT[\d:.]+Z", "", "\n".join(base.iterdump()))


def same_corrections(home: Path, folder: Path) -> None:
    """What QGIS makes of a correction is what the command line makes of it."""
    raster, vectors = folder / "band 2.tif", make_vectors(folder)
    here, there = folder / "applied", folder / "cli" / "applied"
    for place in (here, there):
        place.mkdir()
        shutil.copy(raster, place / "in place.tif")
    warp = {"WARP": "true", "WARP_GRID": "pan", "RESAMPLING": "nearest"}
    for keys, words in (
        ({"OUTPUT": here / "one.tif"}, [raster, "-o", there / "one.tif"]),
        (
            {"OUTPUT": here / "warped.tif", **warp},
            [raster, "-o", there / "warped.tif", "--warp", "--grid", "pan", "-r", "nearest"],
        ),
        ({"INPUT": vectors[0], "FOLDER": here / "1"}, [vectors[0], "-o", there / vectors[0].name]),
        (
            {"INPUT": [raster, *vectors], "FOLDER": here / "3"},
            [raster, *vectors, "-o", there / "3"],
        ),
        (
            {"INPUT": here / "in place.tif", "IN_PLACE": "true"},
            [there / "in place.tif", "--in-place"],
        ),
    ):
        run_algorithm(home, "apply", {"CORRECTION": folder / "a.json", "INPUT": raster, **keys})
        geodelreg("apply", folder / "a.json", *words)
    shutil.move(here / "1" / vectors[0].name, here)
    # QGIS leaves statistics (.aux.xml) beside what it opens
    made, wanted = (
        {file.relative_to(place): file for file in place.rglob("*.*") if file.suffix != ".xml"}
        for place in (here, there)
    )
    assert made.keys() == wanted.keys()
    for name, mine in sorted(made.items()):
        theirs = wanted[name]
        if mine.suffix == ".gpkg":
            assert without_date(mine) == without_date(theirs) != without_date(vectors[1])
            print(f"ok: apply: {name}, all tables the same but for last_change")
        else:
            assert mine.read_bytes() == theirs.read_bytes()
            assert mine.read_bytes() not in [source.read_bytes() for source in (raster, *vectors)]
            print(f"ok: apply: {name}, {mine.stat().st_size} bytes, all the same")


def install(home: Path, folder: Path) -> None:
    """Without a command: told so; then the environment is made, and aligns to the same bytes."""
    target = folder / "installed.tif"
    words = ["--", f"MS={folder / 'ms 1.tif'}", f"PAN={folder / 'pan 1.tif'}", f"OUTPUT={target}"]
    failed = qgis_process(home, "run", "geodelreg:align", *words, command=False)
    assert failed.returncode
    assert "no geodelreg command" in failed.stdout + failed.stderr
    assert not target.exists()
    print("ok: without geodelreg, align says what to do")
    print(run_algorithm(home, "install", {}, command=False).strip().splitlines()[-1])
    pair = {"MS": folder / "ms 1.tif", "PAN": folder / "pan 1.tif"}
    run_algorithm(home, "align", {**pair, "OUTPUT": target}, command=False)
    assert target.read_bytes() == (folder / "cli" / "a.tif").read_bytes()
    print("ok: the environment that “Install geodelreg” made aligns to the same bytes")


def main(arguments: list[str]) -> None:
    """Try everything."""
    with tempfile.TemporaryDirectory(prefix="qgis ü ") as place:
        home = Path(place)
        plugins = home / "profile/profiles/default/python/plugins"
        with zipfile.ZipFile(build(home / "zip")) as archive:
            archive.extractall(plugins)
        (home / "bin").mkdir()
        command = home / "bin" / "geodelreg"
        command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m geodelreg_cli "$@"\n')
        command.chmod(0o755)
        folder = home / "Übung 1"
        make_pairs(folder)
        version = qgis_process(home, "--version").stdout.splitlines()[0]
        qgis_process(home, "plugins", "enable", "geodelreg_qgis")
        print(version)
        same_bytes(home, folder)
        same_corrections(home, folder)
        # not where it lies: there, the plugin's sources would come before the unpacked zip
        inside = shutil.copytree(Path(__file__).with_name("in_qgis"), home / "in_qgis")
        subprocess.run([PYTHON, inside, str(folder)], env=environment(home, True), check=True)
        if "--install" in arguments:
            install(home, folder)
    print("all of it works")


if __name__ == "__main__":
    main(sys.argv[1:])
