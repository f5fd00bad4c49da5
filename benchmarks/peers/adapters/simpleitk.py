"""Affine registration by mutual information with SimpleITK."""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk  # noqa: N813
from common import (
    FloatArray,
    arguments,
    ms_zoomed,
    pan_on_ms_grid,
    read_pair,
    save_grid_correction,
)


def _image(array: np.ndarray, zoom: int) -> sitk.Image:
    """In MS pixels (outer corner), whatever the zoom."""
    image = sitk.GetImageFromArray(array.astype(np.float32))
    image.SetSpacing((1 / zoom, 1 / zoom))
    image.SetOrigin((0.5 / zoom, 0.5 / zoom))
    return image


def _register(fixed: sitk.Image, moving: sitk.Image, start: sitk.Transform, share: float) -> None:
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(50)
    method.SetMetricSamplingStrategy(method.RANDOM)
    method.SetMetricSamplingPercentage(share, 1)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 1e-5, 300, 0.6, 1e-8)
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel([8, 4, 2, 1])
    method.SetSmoothingSigmasPerLevel([4, 2, 1, 0])
    method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOff()
    method.SetInitialTransform(start, inPlace=True)
    method.Execute(fixed, moving)


def _matrix(transform: sitk.AffineTransform) -> FloatArray:
    """(2, 3) from fixed (MS) to moving (PAN) coordinates."""
    linear = np.array(transform.GetMatrix()).reshape(2, 2)
    centre = np.array(transform.GetCenter())
    offset = np.array(transform.GetTranslation()) + centre - linear @ centre
    return np.column_stack([linear, offset])


def main() -> None:
    """Default: on the MS grid, a fifth of the pixels.  Best: as many of MS magnified to PAN."""
    args = arguments("default", "best")
    pair = read_pair(args)
    zoom = 1 if args.setting == "default" else max(1, round(pair.ratio))
    centre = (pair.ms.shape[2] / 2, pair.ms.shape[1] / 2)
    transform = sitk.AffineTransform(2)
    transform.SetCenter(centre)
    fixed = _image(ms_zoomed(pair, args.setting, zoom), zoom)
    moving = _image(pan_on_ms_grid(pair, zoom), zoom)
    _register(fixed, moving, transform, 0.2)
    save_grid_correction(args, pair, _matrix(transform))


if __name__ == "__main__":
    main()
