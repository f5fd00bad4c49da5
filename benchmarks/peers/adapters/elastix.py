"""Affine registration with elastix (itk-elastix)."""

from __future__ import annotations

import itk
import numpy as np
from common import arguments, ms_zoomed, pan_on_ms_grid, read_pair, save_grid_correction


def _image(array: np.ndarray, zoom: int) -> itk.Image:
    image = itk.image_from_array(array.astype(np.float32))
    image.SetSpacing((1 / zoom, 1 / zoom))
    image.SetOrigin((0.5 / zoom, 0.5 / zoom))
    return image


def main() -> None:
    """Default: elastix's affine defaults on the MS grid.  Best: at PAN size, more samples."""
    args = arguments("default", "best")
    pair = read_pair(args)
    zoom = 1 if args.setting == "default" else max(1, round(pair.ratio))
    parameters = itk.ParameterObject.New()
    stage = parameters.GetDefaultParameterMap("affine", 5)
    if args.setting == "best":
        stage["NumberOfSpatialSamples"] = ["5000"]
        stage["MaximumNumberOfIterations"] = ["500"]
        stage["FinalBSplineInterpolationOrder"] = ["3"]
    parameters.AddParameterMap(stage)
    _, found = itk.elastix_registration_method(
        _image(ms_zoomed(pair, args.setting, zoom), zoom), _image(pan_on_ms_grid(pair, zoom), zoom),
        parameter_object=parameters, log_to_console=False,
    )  # fmt: skip
    numbers = np.array([float(v) for v in found.GetParameterMap(0)["TransformParameters"]])
    centre = np.array([float(v) for v in found.GetParameterMap(0)["CenterOfRotationPoint"]])
    linear = numbers[:4].reshape(2, 2)
    offset = numbers[4:] + centre - linear @ centre
    save_grid_correction(args, pair, np.column_stack([linear, offset]))


if __name__ == "__main__":
    main()
