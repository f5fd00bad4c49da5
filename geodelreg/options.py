"""Frozen, validated options; each knob is documented here once, for the command line too.

This module imports nothing heavy: ``geodelreg --help`` loads it.
"""

from __future__ import annotations

from dataclasses import dataclass

from geodelreg.errors import UsageError
from geodelreg.option_checks import (
    RESAMPLINGS,
    check_choice,
    check_creation,
    check_masks,
    check_range,
    keep_bands,
    knob,
)

METHODS = ("delaunay", "zhang2013", "sift")
MODELS = ("auto", "shift", "scale", "similarity", "affine", "projective", "field", "tin")
FOLLOWING = ("field", "tin")
"""Models that follow what bends."""
BEYOND_A_HEADER = ("projective", *FOLLOWING)
"""Models that no geotransform can hold."""
GEOREFS = ("geotransform", "gcps")
WARP_GRIDS = ("ms", "pan")
ACCESS = ("local", "network", "all")
SEARCHES = ("auto", "keypoints")
FIGURES = ("before-after", "arrows", "mesh", "error", "matches")


@dataclass(frozen=True, slots=True)
class AlignOptions:
    """How the correction is found."""

    method: str = knob(
        "delaunay",
        "delaunay: coarse to fine with Delaunay filtering and sub-pixel refinement; zhang2013: the "
        "paper's method, step by step; sift: plain SIFT and least squares, as a baseline.",
        METHODS,
    )
    model: str = knob(
        "auto",
        "Transformation of the header. auto takes the simplest that held-out points do not reject, "
        "north-up ones (shift, scale) before rotated ones (similarity, affine). No header holds a "
        "projective one, a field, which follows what bends, or tin, the paper's facets, for "
        "comparison: MS is then resampled.",
        MODELS,
    )
    north_up: bool = knob(
        False,
        "Never rotate or shear, whatever it would gain. Without it, model auto does when a corner "
        "moves by 0.1 PAN pixels or more, and held-out points ask for it.",
    )
    band: int | None = knob(
        None,
        "MS band to match on, from 1; auto weights the bands so that together they look like PAN.",
    )
    per_band: bool = knob(
        False,
        "Correct each MS band by itself: one common map, and on top of it where each band lies. "
        "OUT is then a folder with one file per band, a .vrt, or resampled (`warp`).",
    )
    band_model: str = knob(
        "shift", "How a band may lie to the common map, with `per_band`.", ("shift", "affine")
    )
    agreeing_bands: tuple[int, ...] = knob(
        (),
        "MS bands that must show the ground at one place, from 1, as N,N,...; all when not given. "
        "A warning names bands that lie 0.5 PAN pixels apart beyond doubt; 1 pixel refuses.",
    )
    pan_band: int = knob(
        1,
        "Band of the PAN (reference) raster to match on, from 1; 0 (auto) takes the one that "
        "resembles the others most, and says which.",
    )
    masks: tuple[str, ...] = knob(
        (),
        "Leave out the MS pixels that this mask hides; it is placed by its own header, in the "
        "frame of MS. A vector file hides what it touches; a Landsat QA_PIXEL or Sentinel-2 SCL "
        "band hides fill, cloud, cirrus and shadow; of another raster every value but 0 and "
        "no-data hides. HIDE says it otherwise: values (3,8-10), or binary, landsat-qa, "
        "sentinel2-scl. May be repeated.",
    )
    pan_masks: tuple[str, ...] = knob(
        (),
        "The same for PAN. One of the two is enough for any place: a tie point needs both images.",
    )
    search: str = knob(
        "auto",
        "How delaunay finds the first guess. auto: where the header says, or a shift from there, "
        "when nothing in the images lets one doubt it, else by SIFT keypoints; keypoints: by "
        "keypoints alone.",
        SEARCHES,
    )
    ms_nodata: float | None = knob(
        None,
        "Value of MS pixels that show nothing, whatever the file declares. Without it, what the "
        "file declares; where it declares nothing, 0 or the largest value that fills a corner.",
    )
    pan_nodata: float | None = knob(None, "The same for PAN.")
    search_radius_px: float = knob(
        512.0,
        "How far off, in PAN pixels, the header may be for the first search; when that finds "
        "nothing, both rasters are searched whole.",
    )
    tolerance_px: float = knob(
        0.02,
        "A correction that moves no pixel by more than this many PAN pixels and is not significant "
        "is not applied: the header stays, the verdict is already_aligned.",
    )
    ratio: float = knob(0.8, "Lowe's limit on nearest over second nearest descriptor distance.")
    max_keypoints: int = knob(
        6000,
        "Keypoints kept per image, strongest first; delaunay spreads them over the image, and on "
        "the first look takes a quarter of them, but 1500 where so many are allowed.",
    )
    max_shift_px: float | None = knob(
        None, "Refuse a correction that shifts the centre by more PAN pixels than this."
    )
    max_rotation_deg: float | None = knob(
        None, "Refuse a correction that rotates by more degrees than this."
    )
    max_scale: float | None = knob(
        None,
        "Refuse a correction that scales by more than this factor (or by less than its inverse).",
    )
    max_uncertainty_px: float | None = knob(
        None,
        "Refuse a correction that may be further off than this many PAN pixels at the worst corner "
        "of the overlap, with 95 % certainty. Without it the limit is 1.2, a standard error of "
        "0.7.",
    )
    max_residual_px: float = knob(
        0.5,
        "Refuse a correction that leaves more PAN pixels RMS, beyond doubt, of the ground's bend: "
        "relief, a moving sensor, dropped rows.",
    )
    on_local: str = knob(
        "refuse",
        "What to do where one affine leaves more than `max_residual_px`: refuse; warn, and write "
        "the best affine of the whole overlap all the same; or follow the bend with a field, as "
        "auto does where the output can carry it.",
        ("refuse", "warn", "field"),
    )
    threads: int = knob(0, "Threads; 0 = all cores. The result does not depend on it.")
    allow: str = knob(
        "local",
        "What names of rasters, and files, may open. local: files of this machine, also in "
        "archives, of formats that reach no others unseen; network: addresses and web services "
        "as well; all: whatever GDAL can, also HDF5, databases, Python code in VRTs and raw bytes "
        "of any file.",
        ACCESS,
    )

    def __post_init__(self) -> None:
        check_choice(self, "method")
        check_choice(self, "model")
        check_choice(self, "search")
        check_choice(self, "allow")
        check_choice(self, "band_model")
        check_range(self, "band", 1, 65535)
        if self.per_band and (self.band or self.method != "delaunay"):
            raise UsageError(
                "`per_band=True` matches each band, by `method='delaunay'`",
                "Drop `band`, and use that method.",
            )
        keep_bands(self, "agreeing_bands")
        if self.agreeing_bands and (self.per_band or self.band):
            raise UsageError(
                "`agreeing_bands` are asked about where one correction is for all, and `band` and "
                "`per_band` ask for another",
                "Drop one of them.",
            )
        check_range(self, "pan_band", 0, 65535)
        check_masks(self, "masks")
        check_masks(self, "pan_masks")
        check_range(self, "search_radius_px", 0, 1e7)
        check_range(self, "tolerance_px", 0, 1e3)
        check_range(self, "ratio", 0.1, 1.0)
        check_range(self, "max_keypoints", 16, 100_000)
        check_range(self, "max_shift_px", 0, 1e9)
        check_range(self, "max_rotation_deg", 0, 180)
        check_range(self, "max_scale", 1, 1e3)
        check_range(self, "max_uncertainty_px", 1e-6, 1e6)
        check_range(self, "max_residual_px", 0, 1e6)
        check_choice(self, "on_local")
        if self.north_up and self.model not in ("auto", "shift", "scale"):
            raise UsageError(
                f"`north_up=True` and `model={self.model!r}` exclude each other",
                "Use auto, shift or scale.",
            )
        check_range(self, "threads", 0, 1024)
        if self.model in FOLLOWING and self.method != "delaunay":
            raise UsageError(
                f"`method={self.method!r}` knows no {self.model}",
                "Use `method='delaunay'`, or another model.",
            )


def one_header(what: str = "") -> UsageError:
    """The error of bands with places of their own where one header is written, to `what`."""
    return UsageError(
        f"{what}`per_band=True` finds a place for each band, and a header has one for all",
        "Name a folder, for one file per band, or a .vrt of one MS file; or resample "
        "(`warp=True`).",
    )


def check_header_holds(model: str) -> None:
    """Refuse to write a correction into a geotransform that cannot hold it.

    Raises
    ------
    UsageError
    """
    if model in BEYOND_A_HEADER:
        raise UsageError(
            f"`model={model!r}` is no affine: no geotransform, and so no header, can hold it",
            "Resample (`warp=True`), pass it on as control points (`export_gcps` alone, or "
            "`georef='gcps'`), or use another model.",
        )


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """How the corrected raster is written."""

    overwrite: bool = knob(False, "Replace existing outputs; without it they are an error.")
    driver: str | None = knob(
        None, "GDAL format of OUT, guessed from its extension when not given."
    )
    creation_options: tuple[str, ...] = knob(
        (), "Creation option of the format, KEY=VALUE, as in GDAL; may be repeated."
    )
    georef: str = knob(
        "geotransform",
        "geotransform: OUT carries the corrected geotransform; gcps: OUT carries the ground "
        "control points instead (a GeoTIFF holds one or the other).",
        GEOREFS,
    )
    strip_rpc: bool = knob(
        False, "Drop RPC tags, which would contradict the corrected geotransform."
    )
    warp: bool = knob(
        False,
        "Resample onto a north-up grid instead of correcting the header, for software that rejects "
        "rotated geotransforms.",
    )
    warp_grid: str = knob(
        "ms", "Grid of `warp`: the pixel size of MS, or exactly the grid of PAN.", WARP_GRIDS
    )
    like: str | None = knob(
        None, "Grid of `warp`: exactly that of this raster, in its CRS, instead of `warp_grid`."
    )
    resampling: str = knob(
        "cubic",
        "Resampling of `warp`; quality bands (as QA_PIXEL, SCL) and colour tables keep to nearest.",
        RESAMPLINGS,
    )

    def __post_init__(self) -> None:
        check_choice(self, "georef")
        check_choice(self, "warp_grid")
        check_choice(self, "resampling")
        check_creation(self, "creation_options")
        if self.like is not None and (not self.warp or self.warp_grid != "ms"):
            raise UsageError(
                f"`like={self.like!r}` is the grid of `warp`, in place of `warp_grid`",
                "Add `warp=True`, and drop `warp_grid`.",
            )
        if self.warp and self.georef == "gcps":
            raise UsageError(
                "`warp=True` and `georef='gcps'` exclude each other", "Drop one of them."
            )


@dataclass(frozen=True, slots=True)
class BatchOptions:
    """How many pairs are run."""

    check: bool = knob(False, "Verdicts only, as geodelreg check gives them; nothing is written.")
    limit_px: float = knob(
        0.5,
        "Largest misalignment, anywhere in the overlap, that `check` counts as aligned, in PAN "
        "pixels.",
    )
    in_place: bool = knob(
        False, "Correct the headers of the MS files themselves; the pairs then have no OUT."
    )
    workers: int = knob(
        0,
        "Pairs at a time on this machine, each in a process of one thread; 0 = as many as cores. "
        "On Dask: pairs under way, 0 = four for each thread of the cluster.",
    )
    timeout_s: float | None = knob(
        None, "Seconds that a pair may take; one that takes longer has failed."
    )
    memory_mb: int | None = knob(
        None,
        "Megabytes that the process of a pair may hold; a pair that needs more has failed. Needs "
        "Linux where the pairs run.",
    )
    fail_fast: bool = knob(
        False, "Start no pair after one has failed; `resume` goes on with the rest."
    )

    def __post_init__(self) -> None:
        check_range(self, "limit_px", 0, 1e6)
        check_range(self, "workers", 0, 100_000)
        check_range(self, "timeout_s", 1e-3, 1e9)
        check_range(self, "memory_mb", 1, 1e9)
        if self.check and self.in_place:
            raise UsageError(
                "`check=True` and `in_place=True` exclude each other", "Drop one of them."
            )
