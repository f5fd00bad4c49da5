"""One run of `scale`, and the limits it is held to."""

from __future__ import annotations

from dataclasses import dataclass

PEAK_LIMIT_MB = 300
TIME_FACTOR = 1.5
START_S = 3.0
PLAIN, OVERVIEWS, STRIPED, IN_PLACE = "tiled", "overviews", "striped", "--in-place"


@dataclass(frozen=True, slots=True)
class Row:
    """One run.

    Attributes
    ----------
    variant : str
        How PAN is stored, or what is done.
    size : int
        Side of PAN, pixels.
    pan_mb, ms_mb : float
        Sizes of the files.
    wall_s, cpu_s, peak_mb : float
        Of the whole process, start-up and output included.
    match_s : float
        Of its own timings all that is not opening and reading.
    rmse_px : float
        Error against the truth, PAN pixels; NaN when nothing came out.
    timings_s : dict of str to float
        From the report.
    read_floor_s, copy_floor_s : float
        GDAL's time to read the pixels, and the time to copy MS to the disk.
    failure : str
    """

    variant: str
    size: int
    pan_mb: float
    ms_mb: float
    wall_s: float
    cpu_s: float
    peak_mb: float
    match_s: float
    rmse_px: float
    timings_s: dict[str, float]
    read_floor_s: float
    copy_floor_s: float
    failure: str

    @property
    def limit_s(self) -> float:
        """Longest time that is allowed."""
        return TIME_FACTOR * (self.read_floor_s + self.copy_floor_s) + START_S

    @property
    def met(self) -> bool:
        """Whether time and memory keep their limits."""
        return not self.failure and self.wall_s <= self.limit_s and self.peak_mb <= PEAK_LIMIT_MB
