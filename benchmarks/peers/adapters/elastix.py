"""Affine and B-spline registration with elastix (itk-elastix).

Expert: correlation on a band mix, whose relation to PAN is a line, at PAN size, from more samples
than the default's 2048, as elastix's manual advises for small deformations (sections 5.3 and 5.5).
"""

from __future__ import annotations

import itk
import numpy as np
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
    sampled,
    save_grid_correction,
    save_on_grid,
)

SAMPLES, ITERATIONS = "10000", "500"
KNOTS_MS_PX = "32"
LEVELS = 5


def _image(array: np.ndarray, zoom: int) -> itk.Image:
    image = itk.image_from_array(array.astype(np.float32))
    image.SetSpacing((1 / zoom, 1 / zoom))
    image.SetOrigin((0.5 / zoom, 0.5 / zoom))
    return image


def _stage(kind: str, expert: bool) -> itk.ParameterObject:
    stage = itk.ParameterObject.New().GetDefaultParameterMap(kind, LEVELS)
    if expert:
        stage["Metric"] = ["AdvancedNormalizedCorrelation"]
        stage["NumberOfSpatialSamples"] = [SAMPLES]
        stage["NewSamplesEveryIteration"] = ["true"]
        stage["ImageSampler"] = ["RandomCoordinate"]
        stage["MaximumNumberOfIterations"] = [ITERATIONS]
        stage["FinalBSplineInterpolationOrder"] = ["3"]
    if kind == "bspline":
        stage["FinalGridSpacingInPhysicalUnits"] = [KNOTS_MS_PX]
    return stage


def _registered(grey: np.ndarray, pan: np.ndarray, zoom: int, *stages: object) -> object:
    parameters = itk.ParameterObject.New()
    for stage in stages:
        parameters.AddParameterMap(stage)
    _, found = itk.elastix_registration_method(
        _image(grey, zoom), _image(pan, zoom), parameter_object=parameters, log_to_console=False
    )
    return found


def _affine(found: itk.ParameterObject) -> FloatArray:
    numbers = np.array([float(v) for v in found.GetParameterMap(0)["TransformParameters"]])
    centre = np.array([float(v) for v in found.GetParameterMap(0)["CenterOfRotationPoint"]])
    linear = numbers[:4].reshape(2, 2)
    return np.column_stack([linear, numbers[4:] + centre - linear @ centre])


def _local(pair: Pair, zoom: int, pan: np.ndarray) -> FloatArray:
    """Where the check points lie on PAN's grid, through B-splines."""
    stages = [_stage(kind, expert=True) for kind in ("affine", "bspline")]
    found = {}

    def find(grey: np.ndarray) -> FloatArray:
        found["both"] = _registered(ms_zoomed(pair, grey, zoom), pan, zoom, *stages)
        return _affine(found["both"])

    on_band_mix(pair, find)
    field = itk.transformix_deformation_field(_image(pan, zoom), found["both"])
    at = check_points(pair.ms.shape[1:])
    return at + sampled(np.asarray(field, dtype=float), at, zoom)


def main() -> None:
    """Default: elastix's affine on the MS grid.  Expert: at PAN size.  Local: and B-splines."""
    args = arguments("default", "expert", "local")
    pair = read_pair(args)
    if args.setting == "default":
        grey = pair.ms_grey(args.setting)
        found = _registered(grey, pan_on_ms_grid(pair), 1, _stage("affine", expert=False))
        save_grid_correction(args, pair, _affine(found))
        return
    zoom = max(1, round(pair.ratio))
    pan, stage = pan_as_ms(pair, zoom), _stage("affine", expert=True)
    if args.setting == "local":
        save_on_grid(args, pair, _local(pair, zoom, pan))
        return
    matrix = on_band_mix(
        pair, lambda grey: _affine(_registered(ms_zoomed(pair, grey, zoom), pan, zoom, stage))
    )
    save_grid_correction(args, pair, matrix)


if __name__ == "__main__":
    main()
