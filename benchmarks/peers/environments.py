"""The peers, and the environment of each, built where it can be."""

from __future__ import annotations

import logging
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

log = logging.getLogger(__name__)
OWN = "geodelreg"
ADAPTERS = Path(__file__).parent / "adapters"
BUILD_TIMEOUT_S = 1200.0
RASTERS = ("rasterio>=1.4", "pyproj>=3.6", "numpy")


@dataclass(frozen=True, slots=True)
class Peer:
    """A tool to compare with.

    Attributes
    ----------
    name : str
        As in the table.
    script : str
        Adapter in ``benchmarks/peers/adapters``.
    requirements : tuple of tuple of str
        Arguments of one ``pip install`` after the other.
    settings : tuple of str
        Settings of the adapter, tried on every pair.
    local : bool
        Whether the adapter has the setting ``local``, which follows pairs that bend.
    python : str or None
        Interpreter to build on; this one when None.
    probe : str
        Statement that must run in the environment.
    command : str or None
        Executable that must be there, installed by hand (Debian's packages).
    """

    name: str
    script: str
    requirements: tuple[tuple[str, ...], ...]
    probe: str
    settings: tuple[str, ...] = ("default", "expert")
    python: str | None = None
    command: str | None = None
    local: bool = False


DEBIAN_GDAL = (
    ("setuptools<70", "wheel", "numpy<2"),
    ("--no-build-isolation", "--no-deps", "gdal==3.6.2.*"),
)
"""Python's bindings of the GDAL that Debian 12 has (``libgdal-dev``)."""
AROSICS = (
    *DEBIAN_GDAL,
    ("--no-deps", "arosics==1.13.2", "geoarray==0.19.0", "py_tools_ds==0.23.2"),
    (
        "numpy<2", "cartopy", "cmocean", "folium>=0.6,!=0.12.0", "geojson", "geopandas",
        "joblib>=1.3", "matplotlib", "pandas", "plotly", "pyproj", "scikit-image", "scipy",
        "shapely", "packaging", "spectral", "dill", "pykrige", "scikit-learn",
    ),
)  # fmt: skip
KARIOS = (
    *DEBIAN_GDAL,
    (
        "numpy<2", "rasterio>=1.4", "pyproj>=3.6", "opencv-python-headless<4.12", "pandas",
        "matplotlib", "scikit-image", "scipy",
    ),
    (
        "--no-deps", "--ignore-requires-python",
        "karios @ git+https://github.com/telespazio-tim/karios",
    ),
)  # fmt: skip
"""It asks for Python 3.12; what is used of it runs in 3.11."""
OPENCV = (("opencv-python-headless>=5", *RASTERS),)
PANDORA2D = (("pandora2d==1.2.0", *RASTERS),)
SYSTEM = "/usr/bin/python3"

PEERS: tuple[Peer, ...] = (
    Peer("OpenCV SIFT + RANSAC", "opencv_sift", OPENCV, "import cv2"),
    Peer("half-size SIFT", "half_size_sift", OPENCV, "import cv2", settings=("default",)),
    Peer("OpenCV ECC", "opencv_ecc", OPENCV, "import cv2"),
    Peer("SIFT + MAGSAC, then ECC", "opencv_expert", OPENCV, "import cv2", ("expert",)),
    Peer("OpenCV DIS optical flow", "opencv_dis", OPENCV, "import cv2", (), local=True),
    Peer("phase correlation", "phase_correlation", (("scikit-image", *RASTERS),), "import skimage"),
    Peer("SimpleITK", "simpleitk", (("SimpleITK", *RASTERS),), "import SimpleITK", local=True),
    Peer("elastix", "elastix", (("itk-elastix", *RASTERS),), "import itk", local=True),
    Peer("AROSICS", "arosics_peer", AROSICS, "import arosics", python=SYSTEM, local=True),
    Peer("KARIOS", "karios_peer", KARIOS, "import karios.matcher.klt", python=SYSTEM, local=True),
    Peer("pandora2d", "pandora2d_peer", PANDORA2D, "import pandora2d", local=True),
    Peer("coregix", "coregix_peer", (("coregix==0.3.0", "scipy", *RASTERS),), "import coregix"),
    Peer(
        "OTB SIFT", "otb_sift", OPENCV, "import cv2",
        command="otbcli_HomologousPointsExtraction",
    ),
)  # fmt: skip


class PeerUnavailableError(Exception):
    """The peer's environment cannot be built here."""


def environment(peer: Peer, cache: Path) -> Path:
    """Interpreter of a peer's environment, built in `cache` when it is not there yet.

    Peers with the same requirements share one.  A failed build is remembered; delete its folder to
    try again.

    Raises
    ------
    PeerUnavailableError
        With the reason.
    """
    if peer.command and not shutil.which(peer.command):
        raise PeerUnavailableError(f"{peer.command} is not installed")
    twin = next((p for p in PEERS if p.requirements == peer.requirements), peer)
    folder = cache / twin.script
    python, failure = folder / "bin" / "python", folder / "failure.txt"
    if failure.exists():
        raise PeerUnavailableError(failure.read_text().strip())
    if not (folder / "ready").exists():
        shutil.rmtree(folder, ignore_errors=True)
        reason = _build(twin, folder, python)
        if reason:
            folder.mkdir(parents=True, exist_ok=True)
            failure.write_text(reason)
            raise PeerUnavailableError(reason)
        (folder / "ready").touch()
    return python


def _build(peer: Peer, folder: Path, python: Path) -> str:
    """Build; the reason when it fails, else ''."""
    pip = [] if peer.requirements else ["--without-pip"]
    steps = [[peer.python or sys.executable, "-m", "venv", *pip, str(folder)]]
    steps += [[str(python), "-m", "pip", "install", "-q", *step] for step in peer.requirements]
    steps.append([str(python), "-c", peer.probe])
    for step in steps:
        log.info("%s: %s", peer.name, " ".join(step))
        try:
            done = subprocess.run(
                step, capture_output=True, text=True, timeout=BUILD_TIMEOUT_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"{type(error).__name__} in {' '.join(step[1:4])}"
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if "error" in line.lower()]
            return (lines or done.stderr.splitlines() or ["failed"])[-1].strip()[:200]
    return ""


def own_command(scene: Path, out: Path) -> list[str]:
    """Command line of geodelreg itself, as a user runs it: start-up and output included."""
    return [
        sys.executable, "-m", "geodelreg_cli", "align", str(scene / "ms.tif"),
        str(scene / "pan.tif"), "-o", str(out), "--quiet",
    ]  # fmt: skip
