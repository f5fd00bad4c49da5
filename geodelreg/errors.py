"""Every refusal a user can meet, one class each.

All derive from `GeodelregError`.  A message names the file, the cause and what to change;
``exit_code`` is what the command line returns for it.
"""

from __future__ import annotations

from typing import Any, ClassVar


def shown(text: str) -> str:
    r"""One line of text with all that a terminal obeys instead of showing as escapes (``\x1b``).

    Names of files, and of bands inside them, come from strangers.
    """
    if text.isprintable():
        return text
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return "".join(escaped)


class GeodelregError(Exception):
    """Base of all errors that geodelreg raises on purpose.

    Parameters
    ----------
    cause : str
        What is wrong, naming the file or option.
    remedy : str, optional
        What the user can change.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, cause: str, remedy: str = "") -> None:
        self.cause, self.remedy = shown(cause), shown(remedy)
        super().__init__(f"{self.cause}. {self.remedy}" if remedy else self.cause)


class UsageError(GeodelregError, ValueError):
    """An option's value is impossible, options exclude each other, or MS and PAN are swapped."""

    exit_code = 2


class RasterNotFoundError(GeodelregError):
    """The input file does not exist."""


class RasterUnreadableError(GeodelregError):
    """The input is not a raster, is truncated, or one of its blocks cannot be decoded."""


class AccessNotAllowedError(GeodelregError):
    """A name, a file behind it or beside it reaches beyond what ``allow`` lets GDAL open."""


class MissingGeoreferenceError(GeodelregError):
    """The raster has no geotransform."""


class UnsupportedGeoreferenceError(GeodelregError):
    """The raster is placed by RPCs or GCPs only, or by a degenerate geotransform."""


class MissingCrsError(GeodelregError):
    """The raster has no coordinate reference system."""


class CrsTransformError(GeodelregError):
    """Points cannot be transformed between the two coordinate reference systems."""


class BandNumberError(GeodelregError):
    """The band asked for does not exist."""

    exit_code = 2


class BandGridError(GeodelregError):
    """Files given as bands of one image do not share one CRS or do not overlap."""


class ArrayShapeError(GeodelregError):
    """An array does not fit its grid, or a DataArray is no grid of rows and columns."""


class NoDataError(GeodelregError):
    """A band is constant or has no valid pixel: nothing can be matched on it."""


class NoOverlapError(GeodelregError):
    """The two rasters show no common ground, by their headers and by their contents."""


class MaskError(GeodelregError):
    """A mask cannot be read or does not cover the image."""


class OutputExistsError(GeodelregError):
    """The output exists and overwriting was not asked for."""


class OutputIsInputError(GeodelregError):
    """The output is one of the inputs."""

    exit_code = 2


class OutputUnwritableError(GeodelregError):
    """The output cannot be written: folder missing, read-only, disk full."""


class LossyOutputError(GeodelregError):
    """The requested output would change pixel values."""


class UnsafeInPlaceError(GeodelregError):
    """The file's header cannot be replaced in place without risk."""


class FileLockedError(GeodelregError):
    """Another process is writing the same file."""


class GcpFormatError(GeodelregError):
    """A GCP file cannot be read, or its format is unknown."""


class PointsError(GeodelregError):
    """Points that were given do not determine the correction asked for, or are no points of MS."""


class ReportError(GeodelregError):
    """A report is none, of another version or of a refusal, or of other rasters."""


class CorrectionMisfitError(GeodelregError):
    """A file does not lie where a correction was found, or was corrected before."""


class VectorUnreadableError(GeodelregError):
    """A vector file whose coordinates are to be corrected cannot be read."""


class MissingExtraError(GeodelregError):
    """An optional dependency is not installed."""


class ManifestError(GeodelregError):
    """Pairs of a batch cannot be run as they are listed; none was started.

    Attributes
    ----------
    problems : tuple of str
        What is wrong, each with its line; not more than the first hundred.
    """

    exit_code = 2

    def __init__(self, cause: str, remedy: str = "", problems: tuple[str, ...] = ()) -> None:
        super().__init__(cause, remedy)
        self.problems = problems


class LedgerError(GeodelregError):
    """The ledger of a batch exists, is of another version, or belongs to other pairs."""


class ClusterError(GeodelregError):
    """The workers of a batch cannot be reached, are lost, or are of another version."""


class PairTimeoutError(GeodelregError):
    """A pair of a batch took longer than it may."""


class PairMemoryError(GeodelregError):
    """A pair of a batch needed more memory than it may have, or than there is."""


class PairCrashedError(GeodelregError):
    """A pair of a batch ended its process, each time that it was tried."""


class AlignmentRefusedError(GeodelregError):
    """The evidence does not support any alignment; nothing was written.

    Attributes
    ----------
    alignment : Alignment or None
        All that was found out, for the report; its verdict lists the reasons.
    """

    exit_code = 3

    def __init__(self, cause: str, remedy: str = "", alignment: Any = None) -> None:
        super().__init__(cause, remedy)
        self.alignment = alignment
