"""How far from the Cramér–Rao bound the errors are: ``python -m benchmarks bound``.

A scene's noise-free bands, their gradients and the noise are known, so the Fisher information of
the parameters of a transformation is, too: the sum over pixels of ``Jᵀ g gᵀ J / variance``, with g
the gradient of the signal and J the displacement per unit of each parameter.  Its inverse bounds
the covariance of any unbiased estimate.  Three bounds, from the most to the least that is taken as
known:

``known bands``
    Each MS band's noise-free signal is known; only the noise of the MS bands is in the way.
``known PAN``
    Only PAN is known, so only the mix of bands that looks most like it tells anything; PAN's own
    noise, low-passed to the MS pixel, adds to that of the mix.
``misfit as noise``
    The same, with what the mix cannot explain of PAN counted as if it were white noise.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.attempt import align_scene
from benchmarks.report import machine, replace_section
from benchmarks.scenes.ground import Ground
from benchmarks.scenes.imagery import ImageryNotFoundError
from benchmarks.scenes.make import (
    BAND_GAINS,
    BAND_GAMMAS,
    BLUR_MS_PX,
    PAN_GAMMA,
    SCENES,
    SOURCES,
    Scene,
    SceneSpec,
    lay_out,
    write_scene,
)
from benchmarks.scenes.simulate import Placement, digitise, noise_variance, render, system_mtf, tone
from benchmarks.scenes.truth import Truth, check_points, grid_rmse, pan_errors

FloatArray = NDArray[np.float64]
NAMES = ("A", "B", "C", "D", "E", "I", "aerial")
STEP_PX = 0.1
QUANTISATION = 1.0 / 12.0
MODELS = ("shift", "scale", "similarity", "affine")


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """A noise-free image at the MS pixels that PAN covers.

    Attributes
    ----------
    values : (N,) float64
    gradient : (N, 2) float64
        Per PAN pixel, along its columns and rows.
    """

    values: FloatArray
    gradient: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """What the bounds of a scene are made of.

    Attributes
    ----------
    bands : list of Signal
    pan : Signal
        PAN seen through the point spread of an MS pixel.
    pan_noise_gain : float
        Variance of PAN's noise after that point spread, over the variance before.
    pixels : (N, 2) float64
        ``(column, row)`` of the MS pixels.
    linear : (2, 2) float64
        PAN pixels per MS pixel.
    clean : tuple of (4, h, w) and (H, W) float64
        MS and PAN without noise.
    """

    bands: list[Signal]
    pan: Signal
    pan_noise_gain: float
    pixels: FloatArray
    linear: FloatArray
    clean: tuple[FloatArray, FloatArray]


def jacobian(
    model: str, pixels: FloatArray, shape: tuple[int, int], linear: FloatArray
) -> FloatArray:
    """Displacement in PAN pixels per unit of each parameter of a model.

    Parameters
    ----------
    model : str
        One of `MODELS`.
    pixels : (N, 2) float64
        MS ``(column, row)``.
    shape : tuple of int
        ``(height, width)`` of MS; parameters are scaled by half of it, about its centre.
    linear : (2, 2) float64
        PAN pixels per MS pixel.

    Returns
    -------
    (N, 2, P) float64
    """
    half = np.array([shape[1], shape[0]]) / 2
    u, v = ((pixels - half) / half.max()).T
    one, zero = np.ones_like(u), np.zeros_like(u)
    columns = {
        "shift": [(one, zero), (zero, one)],
        "scale": [(one, zero), (zero, one), (u, zero), (zero, v)],
        "similarity": [(one, zero), (zero, one), (u, v), (-v, u)],
        "affine": [(one, zero), (zero, one), (u, zero), (zero, v), (v, zero), (zero, u)],
    }[model]
    moved = np.stack([np.stack(column, axis=1) for column in columns], axis=2)
    return np.asarray(linear @ moved)


def fisher(gradient: FloatArray, variance: FloatArray, displacement: FloatArray) -> FloatArray:
    """(P, P) Fisher information of one image.

    Parameters
    ----------
    gradient : (N, 2) float64
        Of the noise-free signal, per pixel of `displacement`.
    variance : (N,) float64
        Of independent Gaussian noise.
    displacement : (N, 2, P) float64
        As from `jacobian`.
    """
    slope = np.einsum("ni,nip->np", gradient, displacement)
    return np.asarray(slope.T @ (slope / variance[:, None]))


def rmse_bound(information: FloatArray, displacement: FloatArray) -> float:
    """Least RMS radial error of an unbiased estimate, over points with this displacement."""
    covariance = np.linalg.inv(information)
    return float(np.sqrt(np.einsum("nip,pq,niq->n", displacement, covariance, displacement).mean()))


def known(spec: SceneSpec, ground: Ground, placement: Placement) -> Knowledge:
    """Noise-free signals and their gradients at the MS pixels inside PAN."""
    left_top = np.array(ground.offset)
    inside = placement.centres_px - left_top
    covered = ((inside >= 0) & (inside <= np.array(spec.pan_shape)[::-1])).all(axis=2)
    rows, columns = np.nonzero(covered)
    rendered = [
        _rendered(band, placement, gamma, gain)
        for band, gamma, gain in zip(ground.bands, BAND_GAMMAS, BAND_GAINS, strict=True)
    ]
    radiance = np.tensordot(np.array(spec.pan_weights), ground.bands.astype(float), axes=1)
    # PAN has its tone before the point spread of MS, a band after it
    pan = tone(radiance, PAN_GAMMA)
    frequency = np.asarray(np.fft.fftfreq(256), dtype=np.float64)
    transfer = system_mtf(frequency[None, :], frequency[:, None], placement.linear, BLUR_MS_PX)
    return Knowledge(
        [_signal(stack, covered) for stack in rendered],
        _signal(_rendered(pan, placement, 1.0, 1.0), covered),
        float((transfer**2).mean()),
        np.stack([columns, rows], axis=1).astype(np.float64) + 0.5,
        placement.linear,
        (np.stack([stack[0] for stack in rendered]), pan[ground.pan_window]),
    )


def _rendered(
    field: NDArray[np.floating], placement: Placement, gamma: float, gain: float
) -> FloatArray:
    """(5, h, w) as MS sees it: in place, then a step right, left, down and up."""
    steps = STEP_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    centres = np.concatenate([placement.centres_px + step for step in steps])
    stacked = tone(render(field, replace(placement, centres_px=centres), BLUR_MS_PX), gamma, gain)
    return np.stack(np.split(stacked, len(steps)))


def _signal(rendered: FloatArray, covered: NDArray[np.bool_]) -> Signal:
    here, right, left, down, up = rendered[:, covered]
    gradient = np.stack([right - left, down - up], axis=1) / (2 * STEP_PX)
    return Signal(here, gradient)


def mixed(knowledge: Knowledge) -> tuple[Signal, FloatArray, FloatArray]:
    """The mix of bands that looks most like PAN.

    Returns
    -------
    mix : Signal
    noise : (N,) float64
        Variance of the noise in the mix minus PAN.
    misfit : (N,) float64
        Mix minus PAN, without noise.
    """
    pan, bands = knowledge.pan, knowledge.bands
    design = np.stack([*(band.values for band in bands), np.ones_like(pan.values)], axis=1)
    weights = np.linalg.lstsq(design, pan.values, rcond=None)[0]
    signal = Signal(
        design @ weights,
        np.asarray(sum(w * b.gradient for w, b in zip(weights, bands, strict=False))),
    )
    noise = sum(w**2 * _variance(b.values) for w, b in zip(weights, bands, strict=False))
    noise = noise + knowledge.pan_noise_gain * _variance(pan.values)
    return signal, np.asarray(noise), signal.values - pan.values


def _variance(counts: FloatArray) -> FloatArray:
    return noise_variance(counts) + QUANTISATION


def bounds(knowledge: Knowledge, model: str, shape: tuple[int, int]) -> dict[str, float]:
    """The three bounds of one model, PAN px RMS over 21 × 21 points of the MS raster."""
    move = jacobian(model, knowledge.pixels, shape, knowledge.linear)
    check = jacobian(model, check_points(shape), shape, knowledge.linear)
    every = np.sum([fisher(b.gradient, _variance(b.values), move) for b in knowledge.bands], axis=0)
    mix, noise, misfit = mixed(knowledge)
    disturbed = noise + misfit.var()
    return {
        "known bands": rmse_bound(every, check),
        "known PAN": rmse_bound(fisher(mix.gradient, noise, move), check),
        "misfit as noise": rmse_bound(fisher(mix.gradient, disturbed, move), check),
    }


def realise(name: str, truth: Truth, clean: tuple[FloatArray, FloatArray], seed: int) -> Scene:
    """The scene with other noise."""
    rng = np.random.default_rng([seed, *name.encode()])
    ms, pan = clean
    return Scene(np.stack([digitise(band, rng) for band in ms]), digitise(pan, rng), truth)


def spread(errors: FloatArray) -> tuple[float, float]:
    """RMS scatter between repetitions, and RMS of what they have in common.

    Parameters
    ----------
    errors : (R, N, 2) float64
        Error vectors at N points in R repetitions.
    """
    scatter = errors.var(axis=0, ddof=1).sum(axis=1).mean()
    common = (errors.mean(axis=0) ** 2).sum(axis=1).mean() - scatter / len(errors)
    return math.sqrt(scatter), math.sqrt(max(common, 0.0))


def _repeated(truth: Truth, clean: tuple[FloatArray, FloatArray], count: int) -> FloatArray:
    """(R, 441, 2) error vectors in PAN px of the tool on scenes that differ in their noise."""
    errors = []
    for seed in range(count):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write_scene(realise(truth.name, truth, clean, seed), folder)
            _, _, corrected, _ = align_scene(folder)
        if corrected is not None:
            errors.append(pan_errors(corrected, truth))
    return np.array(errors)


def row(spec: SceneSpec, folder: Path, data: Path | None, repetitions: int) -> str:
    """Line of the table: one scene as `scenes` wrote it, and the same with other noise."""
    laid = lay_out(spec, SOURCES[spec.imagery](data))
    truth = Truth.load(folder / "truth.json")
    if laid[0].ms_true != truth.ms_true:
        raise ImageryNotFoundError(f"{spec.name} was made of other imagery than is found now")
    outcome, model, corrected, _ = align_scene(folder)
    if corrected is None or model not in MODELS:
        return f"| {spec.name} | {outcome} | | | | | | | |"
    error = grid_rmse(corrected, truth)["rmse_px"]
    knowledge = known(spec, *laid[1:])
    affine, chosen = (bounds(knowledge, m, truth.ms_shape) for m in ("affine", model))
    scatter, common = spread(_repeated(truth, knowledge.clean, repetitions))
    cells = [
        spec.name, model, f"{affine['known bands']:.5f}",
        *(f"{value:.5f}" for value in chosen.values()), f"{error:.4f}",
        " / ".join(f"{error / value:.1f}" for value in chosen.values()),
        f"{scatter:.4f}", f"{scatter / chosen['known PAN']:.1f}", f"{common:.4f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


TEXT = """## Against the Cramér–Rao bound

`python -m benchmarks bound --scenes DIR --data IMAGERY --docs docs/benchmarks.md`. All figures but
the ratios are PAN px RMS over 21 × 21 points of the MS raster.

The noise-free bands of a scene, their gradients and its noise (variance 1.5² + 0.008 · counts,
and 1/12 for rounding) are known, so the least error of any unbiased estimate is, too. Three bounds:
*known bands*, when each MS band's signal were known; *known PAN*, when only PAN is, so that only
the mix of bands that looks most like it tells anything, PAN's noise included; *misfit as noise*,
when what no mix explains of PAN is counted as white noise. They are of the model that the tool
chose (a shift has 2 parameters, an affine 6); the first column has the affine for comparison.
*RMSE* is that of the scene as it stands in the folder, one draw. *Scatter* is between alignments of
the same scene with other noise, *common part* what these have in common: the systematic error.

Why we are above:

- No tool can reach *known bands*: it would have to know beforehand what infrared shows.
- A single RMSE of a shift has two degrees of freedom: by chance alone it is less than half of its
  expected RMS in 22 % of draws, and more than 1.5 times it in 11 %. The scatter says more.
- PAN and bands respond with different gammas, and a gamma before a point spread is not one after
  it: the misfit. It is neither white nor new with each draw of the noise.
- MS is sampled once per pixel: what it shows above its Nyquist frequency is folded back. The bound
  knows the folded signal exactly, the tool must make it from PAN through a Gaussian of fitted width
  in place of the true box and Gaussian.
- The tool estimates more from the same pixels: band weights and curvature, the width of the point
  spread, and a gain and an offset for every patch. Patches are weighted by their own residuals, and
  those that disagree are left out.
"""
HEAD = (
    "| scene | model found | affine, known bands | known bands | known PAN | misfit as noise "
    "| RMSE | RMSE / the three | scatter | scatter / known PAN | common part |\n"
    + "|---" * 11
    + "|"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks bound``."""
    parser.add_argument("--scenes", type=Path, required=True, help="folder that `scenes` wrote")
    parser.add_argument("--data", type=Path, help="the imagery they were made of, as for `scenes`")
    parser.add_argument("--only", default=",".join(NAMES), help="scenes, comma-separated")
    parser.add_argument("--repetitions", type=int, default=4, help="further noise realisations")
    parser.add_argument("--docs", type=Path, help="page whose section is replaced")


def run(args: argparse.Namespace) -> int:
    """Print the table, and write it into the page."""
    lines = [HEAD]
    for spec in SCENES:
        if spec.name not in args.only.split(","):
            continue
        try:
            lines.append(row(spec, args.scenes / spec.name, args.data, args.repetitions))
        except (ImageryNotFoundError, FileNotFoundError) as error:
            print(f"{spec.name}: skipped, {error}")
            continue
        print(lines[-1], flush=True)
    table = "\n".join(lines)
    print(f"\n{table}")
    if args.docs:
        note = f"Noise realisations: {args.repetitions}. {machine()}."
        replace_section(args.docs, "bound", f"{TEXT}\n{table}\n\n{note}")
    return 0
