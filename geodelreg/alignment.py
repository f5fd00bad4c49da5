"""What `align` returns: all that was found out, and what people do with it next."""

from __future__ import annotations

from html import escape
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, TypeVar

from geodelreg.errors import MissingExtraError, UsageError
from geodelreg.geo.affine import apply_affine
from geodelreg.options import check_header_holds
from geodelreg.product.figures import draw_tie_points
from geodelreg.product.motion import HeaderMotion, header_motion, metres_per_px
from geodelreg.product.provenance import provenance_tags
from geodelreg.product.report import report_dict, short, summary_text, with_metres
from geodelreg.raster.arrays import is_xarray, placed_again, xarray_dataset
from geodelreg.raster.inputs import Opened
from geodelreg.values import result
from geodelreg.values.points import Status

if TYPE_CHECKING:
    from collections.abc import Mapping

    import geopandas
    import xarray
    from matplotlib.axes import Axes

_Raster = TypeVar("_Raster", "xarray.DataArray", "xarray.Dataset")


class Alignment(result.Alignment):
    """Everything `align` found out; names are those of the JSON report."""

    __slots__ = ()

    @property
    def at_centre(self) -> HeaderMotion:
        """How the correction moves MS, at its centre."""
        return header_motion(self)

    @property
    def shift_px(self) -> tuple[float, float]:
        """How MS moves at its centre, in PAN pixels: right along columns, down along rows."""
        return self.at_centre.shift_px

    @property
    def shift_m(self) -> tuple[float, float]:
        """How MS moves at its centre, in metres on the ground: east and north."""
        return self.at_centre.shift_m

    @property
    def found(self) -> result.Solution:
        """What the images say, whether it was believed or not: the solution."""
        return self.solution

    @property
    def search(self) -> Any:
        """Of the solution."""
        return self.solution.search

    @property
    def step_counts(self) -> Mapping[str, int]:
        """Of the solution."""
        return self.solution.step_counts

    @property
    def band_weights(self) -> Mapping[str, float]:
        """Of the solution."""
        return self.solution.band_weights

    @property
    def bands(self) -> tuple[result.BandMap, ...]:
        """Of the solution."""
        return self.solution.bands

    def summary(self) -> str:
        """A few lines for people: what was found, how good it is, what to do next."""
        return summary_text(self)

    def to_dict(self, tie_points: bool = False) -> dict[str, Any]:
        """The JSON report as plain values; with every tie point when asked for."""
        return report_dict(self, tie_points)

    def __repr__(self) -> str:
        right, down = self.shift_px
        accuracy = self.accuracy
        return (
            f"<Alignment {self.verdict.outcome.value}: model {self.correction.model}, shift_px "
            f"({short(right)}, {short(down)}), uncertainty_px "
            f"{short(accuracy.uncertainty_px)}, {accuracy.kept} tie points>"
        )

    def _repr_html_(self) -> str:
        motion, accuracy, metres = self.at_centre, self.accuracy, metres_per_px(self)

        def both(px: float) -> str:
            return with_metres(px, px * metres)

        rows = {
            "verdict": self.verdict.outcome.value,
            "source": ", ".join(self.source.paths),
            "reference": ", ".join(self.reference.paths),
            "model": self.correction.model,
            "shift at the centre": with_metres(motion.distance_px, motion.distance_m),
            "uncertainty, 95 %": both(accuracy.uncertainty_px),
            "residual misregistration, RMS": both(accuracy.residual_rms_px),
            "patch scatter, RMS": both(accuracy.check_rmse_px),
            "tie points kept": f"{accuracy.kept} of {len(self.tie_points)}",
            "warnings": "; ".join(self.warnings),
        }
        cells = "".join(
            f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>"
            for name, text in rows.items()
            if text
        )
        return f"<table>{cells}</table>"

    def apply(self, raster: _Raster) -> _Raster:
        """Put a DataArray or Dataset where it belongs; its values stay as they are.

        Parameters
        ----------
        raster : xarray.DataArray or xarray.Dataset
            MS, or another raster with the same error in its coordinates.

        Returns
        -------
        xarray.DataArray or xarray.Dataset
            North-up ones have corrected coordinates.  Of a rotated one the coordinates are gone:
            the geotransform in its grid mapping holds, which rioxarray reads.  What made the
            correction stands in the attributes ``GEODELREG_*``.

        Raises
        ------
        UsageError
            The model is no affine, or the raster has another CRS than MS.
        MissingCrsError, MissingGeoreferenceError, UnsupportedGeoreferenceError, ArrayShapeError
        TypeError
            It is nothing of xarray's.
        """
        check_header_holds(self.solution.model)
        if not is_xarray(raster):
            raise TypeError(
                f"apply takes a DataArray or Dataset of xarray, not {type(raster).__name__}; of "
                "anything else correct the geotransform: alignment.correction.apply(transform)"
            )
        name = type(raster).__name__
        dataset = xarray_dataset(raster, name)
        grid = Opened(name, dataset, is_file=False).grid()
        if not _same_crs(grid.crs_wkt, self.correction.crs_wkt):
            raise UsageError(
                f"{name} has another coordinate reference system than MS",
                "Apply the correction first, then reproject: raster.rio.reproject(…).",
            )
        corrected = self.correction.apply(grid.transform)
        placed: _Raster = placed_again(raster, corrected)
        return placed.assign_attrs(provenance_tags(self))

    def to_geodataframe(self) -> geopandas.GeoDataFrame:
        """Tie points, rejected ones too, as points where PAN shows them, in the CRS of PAN.

        Returns
        -------
        geopandas.GeoDataFrame
            Columns named as in the JSON report, one for each axis: ``source_px_column``,
            ``residual_px_row``, …; ``score``; ``status``, which is ``kept`` or says which stage
            rejected the point.

        Raises
        ------
        MissingExtraError
            geopandas is not installed.
        """
        if find_spec("geopandas") is None:
            raise MissingExtraError("tables need geopandas", "Install it: pip install geopandas.")
        import geopandas

        points, pan = self.tie_points, self.reference.grid
        pairs = {
            name: getattr(points, name)
            for name in ("source_px", "reference_px", "residual_px", "sigma_px")
        }
        table: dict[str, Any] = {
            f"{name}_{axis}": values[:, number]
            for name, values in pairs.items()
            for number, axis in enumerate(("column", "row"))
        }
        table["score"] = points.score
        table["status"] = [Status(status).name.lower() for status in points.status]
        ground = apply_affine(pan.transform, points.reference_px)
        return geopandas.GeoDataFrame(
            table, geometry=geopandas.points_from_xy(*ground.T), crs=pan.crs_wkt
        )

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the tie points where they lie, and how far MS was off there.

        Parameters
        ----------
        axes : matplotlib.axes.Axes, optional
            A new figure of pyplot when not given.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        MissingExtraError
            matplotlib is not installed.
        """
        return draw_tie_points(self, axes)


def _same_crs(one: str, other: str) -> bool:
    from rasterio.crs import CRS

    return one == other or bool(CRS.from_wkt(one) == CRS.from_wkt(other))
