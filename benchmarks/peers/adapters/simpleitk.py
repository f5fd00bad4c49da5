"""Affine and B-spline registration with SimpleITK.

Expert: correlation on a band mix at PAN size, step lengths from physical shifts, as in SimpleITK's
registration notebooks; B-splines after the affine by L-BFGS-B, as in their example of that name.
"""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk  # noqa: N813
from common import (
    FloatArray,
    Pair,
    arguments,
    check_points,
    ms_zoomed,
    on_band_mix,
    pan_as_ms,
    pan_on_ms_grid,
    read_pair,
    save_grid_correction,
    save_on_grid,
)

SHARE = 0.2
KNOTS_MS_PX = 32
SPLINE_ITERATIONS = 60


def _image(array: np.ndarray, zoom: int) -> sitk.Image:
    """In MS pixels (outer corner), whatever the zoom."""
    image = sitk.GetImageFromArray(array.astype(np.float32))
    image.SetSpacing((1 / zoom, 1 / zoom))
    image.SetOrigin((0.5 / zoom, 0.5 / zoom))
    return image


def _method(expert: bool, shrink: list[int]) -> sitk.ImageRegistrationMethod:
    method = sitk.ImageRegistrationMethod()
    if expert:
        method.SetMetricAsCorrelation()
    else:
        method.SetMetricAsMattesMutualInformation(50)
    method.SetMetricSamplingStrategy(method.RANDOM)
    method.SetMetricSamplingPercentage(SHARE, 1)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetShrinkFactorsPerLevel(shrink)
    method.SetSmoothingSigmasPerLevel([0 if size == 1 else size / 2 for size in shrink])
    method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOff()
    return method


def _affine(pair: Pair, fixed: sitk.Image, moving: sitk.Image, expert: bool) -> sitk.Transform:
    method = _method(expert, [8, 4, 2, 1])
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 1e-5, 300, 0.6, 1e-8)
    method.SetOptimizerScalesFromPhysicalShift()
    transform = sitk.AffineTransform(2)
    transform.SetCenter((pair.ms.shape[2] / 2, pair.ms.shape[1] / 2))
    method.SetInitialTransform(transform, inPlace=True)
    method.Execute(fixed, moving)
    return transform


def _matrix(transform: sitk.AffineTransform) -> FloatArray:
    """(2, 3) from fixed (MS) to moving (PAN) coordinates."""
    linear = np.array(transform.GetMatrix()).reshape(2, 2)
    centre = np.array(transform.GetCenter())
    offset = np.array(transform.GetTranslation()) + centre - linear @ centre
    return np.column_stack([linear, offset])


def _local(pair: Pair, zoom: int, moving: sitk.Image) -> FloatArray:
    """Where the check points lie on PAN's grid, through B-splines after the affine."""
    found = {}

    def find(grey: np.ndarray) -> FloatArray:
        found["fixed"] = _image(ms_zoomed(pair, grey, zoom), zoom)
        found["affine"] = _affine(pair, found["fixed"], moving, expert=True)
        return _matrix(found["affine"])

    on_band_mix(pair, find)
    method = _method(True, [4, 2, 1])
    knots = [max(4, round(size / KNOTS_MS_PX)) for size in pair.ms.shape[:0:-1]]
    spline = sitk.BSplineTransformInitializer(found["fixed"], knots)
    method.SetMovingInitialTransform(found["affine"])
    method.SetInitialTransform(spline, inPlace=True)
    method.SetOptimizerAsLBFGSB(1e-6, SPLINE_ITERATIONS)
    method.Execute(found["fixed"], moving)
    both = sitk.CompositeTransform([found["affine"], spline])
    at = np.clip(check_points(pair.ms.shape[1:]), 1e-6, np.array(pair.ms.shape[:0:-1]) - 1e-6)
    return np.array([both.TransformPoint(point) for point in at.tolist()])


def main() -> None:
    """Default: mutual information on the MS grid.  Expert: at PAN size.  Local: and B-splines."""
    args = arguments("default", "expert", "local")
    pair = read_pair(args)
    if args.setting == "default":
        fixed, moving = _image(pair.ms_grey(args.setting), 1), _image(pan_on_ms_grid(pair), 1)
        save_grid_correction(args, pair, _matrix(_affine(pair, fixed, moving, expert=False)))
        return
    zoom = max(1, round(pair.ratio))
    moving = _image(pan_as_ms(pair, zoom), zoom)
    if args.setting == "local":
        save_on_grid(args, pair, _local(pair, zoom, moving))
        return

    def find(grey: np.ndarray) -> FloatArray:
        fixed = _image(ms_zoomed(pair, grey, zoom), zoom)
        return _matrix(_affine(pair, fixed, moving, expert=True))

    save_grid_correction(args, pair, on_band_mix(pair, find))


if __name__ == "__main__":
    main()
