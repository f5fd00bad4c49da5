"""Least-squares matching of patches: unbiased at every phase, with errors of the size it says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray

from geodelreg.fine.least_squares import Matched, MatchOptions, match_patches
from geodelreg.fine.patches import Patches, cut_patches
from geodelreg.fine.surface import make_surface
from geodelreg.geo.maps.affine import AffineMap
from geodelreg.values.points import Status
from geodelreg.values.raster import Band, Grid

Array = NDArray[np.float64]

SIZE = 20
PER_SIDE = 6
SIDE = SIZE * PER_SIDE
MARGIN = 24
TEMPLATE = Grid(Affine.identity(), (SIDE, SIDE), "")
OPTIONS = MatchOptions()


@dataclass(frozen=True)
class Waves:
    """A smooth random texture of unit variance that can be evaluated anywhere, exactly."""

    fx: Array
    fy: Array
    phase: Array

    def at(self, x: Array, y: Array) -> Array:
        angle = np.multiply.outer(x, self.fx) + np.multiply.outer(y, self.fy)
        return np.cos(2 * np.pi * angle + self.phase).sum(axis=-1) * np.sqrt(2 / len(self.fx))

    def on(self, x: Array, y: Array) -> Array:
        """(rows, columns) values on the lattice of columns `x` and rows `y`."""
        along = np.exp(2j * np.pi * np.multiply.outer(self.fx, x))
        down = np.exp(1j * (2 * np.pi * np.multiply.outer(y, self.fy) + self.phase))
        return (down @ along).real * np.sqrt(2 / len(self.fx))


def waves(seed: int, highest: float = 0.15, count: int = 200) -> Waves:
    """Frequencies, in cycles per template pixel, fill a disc up to `highest`."""
    rng = np.random.default_rng(seed)
    frequency = highest * np.sqrt(rng.uniform(0.005, 1, count))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, count))
    return Waves(frequency * np.cos(angle), frequency * np.sin(angle), phase)


def centres(count: int) -> Array:
    return np.arange(count) + 0.5


def as_band(data: Array, grid: Grid = TEMPLATE) -> Band:
    return Band(data.astype(np.float32), np.ones(data.shape, bool), grid, "test")


def patches_of(*images: Array) -> Patches:
    return cut_patches([as_band(image) for image in images], TEMPLATE, SIZE)


def seen_by_template(field: Waves, shift: tuple[float, float] = (0.0, 0.0)) -> Array:
    return field.on(centres(SIDE) + shift[0], centres(SIDE) + shift[1])


def seen_by_surface(field: Waves, ratio: float = 1.0) -> Array:
    """The field on a raster `ratio` times finer, with a margin on every side."""
    axis = centres(round((SIDE + 2 * MARGIN) * ratio)) / ratio - MARGIN
    return field.on(axis, axis)


def match(
    patches: Patches, image: Array, ratio: float = 1.0, options: MatchOptions = OPTIONS
) -> tuple[Matched, Array]:
    """Match from the place without displacement; the displacements, in template pixels."""
    full = Grid(Affine.identity(), image.shape, "")
    surface = make_surface(as_band(image, full), full, (0.0, 0.0))
    there = AffineMap(Affine.scale(ratio) @ Affine.translation(MARGIN, MARGIN))
    there = AffineMap(Affine.scale(ratio) @ Affine.translation(MARGIN, MARGIN))
    found = match_patches(patches, [surface], there, options)
    assert len(found.status) == len(patches)
    return found, found.surface_px / ratio - MARGIN - found.template_px


PHASES = [(0.0, 0.0), (0.125, 0.9), (0.25, 0.25), (0.5, 0.5), (0.75, -0.4), (1.0, -1.0)]


@pytest.mark.parametrize("shift", PHASES)
def test_displacement_is_recovered_at_every_phase(shift: tuple[float, float]) -> None:
    field = waves(0)
    found, moved = match(patches_of(5 - 3 * seen_by_template(field, shift)), seen_by_surface(field))
    assert (found.status == Status.KEPT).all()
    assert np.abs(moved - shift).max() < 0.003
    assert np.abs((moved - shift).mean(axis=0)).max() < 0.0006


@pytest.mark.parametrize("shift", PHASES)
def test_displacement_is_recovered_from_bands_whose_mix_is_unknown(
    shift: tuple[float, float],
) -> None:
    fields = [waves(seed) for seed in (1, 2, 3)]
    bands = [seen_by_template(field, shift) for field in fields]
    image = sum(w * seen_by_surface(f) for w, f in zip((0.7, -0.4, 0.2), fields, strict=True))
    found, moved = match(patches_of(*bands), image)
    assert (found.status == Status.KEPT).all()
    assert np.abs(moved - shift).max() < 0.003
    assert np.abs((moved - shift).mean(axis=0)).max() < 0.0006


@pytest.mark.parametrize("ratio", [2.5, 4.0])
def test_finer_surfaces_are_addressed_in_their_own_pixels(ratio: float) -> None:
    field, shift = waves(4), (0.37, -0.61)
    found, moved = match(
        patches_of(seen_by_template(field, shift)), seen_by_surface(field, ratio), ratio
    )
    assert (found.status == Status.KEPT).all()
    assert np.abs(moved - shift).max() < 0.005


def test_rotated_and_scaled_mapping_is_followed() -> None:
    """Patches are placed through the mapping's own rotation and scale."""
    field, turn = waves(5), Affine.translation(60, 40) @ Affine.rotation(35) @ Affine.scale(1.7)
    x, y = turn @ tuple(np.meshgrid(centres(SIDE), centres(SIDE)))
    grid = Grid(Affine.identity(), (330, 330), "")
    offset = 165 - np.array([x.mean(), y.mean()])
    image = field.on((centres(330) - offset[0]) / 1.7, (centres(330) - offset[1]) / 1.7)
    surface = make_surface(as_band(image, grid), grid, (0.0, 0.0))

    there = AffineMap(Affine.translation(*offset) @ turn @ Affine.translation(0.3, -0.45))
    found = match_patches(patches_of(field.at(x / 1.7, y / 1.7)), [surface], there, OPTIONS)
    u, v = turn @ (found.template_px[:, 0], found.template_px[:, 1])
    assert (found.status == Status.KEPT).all()
    assert np.abs(found.surface_px - np.stack([u, v], axis=1) - offset).max() < 0.005 * 1.7


def normalised_error(found: Matched, moved: Array) -> float:
    """RMS of the errors in units of their own covariances, 1 when those are right."""
    kept = found.status == Status.KEPT
    inverse = np.linalg.inv(found.covariance_px2[kept])
    distance2 = np.einsum("pi,pij,pj->p", moved[kept], inverse, moved[kept])
    return float(np.sqrt(distance2.mean() / 2))


@pytest.mark.parametrize("noise", [0.03, 0.2])
@pytest.mark.parametrize("count", [1, 3])
def test_covariance_is_of_the_size_of_the_errors(noise: float, count: int) -> None:
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        fields = [waves(10 * seed + number, 0.1) for number in range(count)]
        bands = [seen_by_template(f) + noise * rng.standard_normal((SIDE, SIDE)) for f in fields]
        image = sum(seen_by_surface(field) for field in fields)
        found, moved = match(patches_of(*bands), image)
        assert (found.status == Status.KEPT).mean() > 0.95
        errors.append(normalised_error(found, moved))
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.25


def test_inverted_contrast_is_matched_and_marked() -> None:
    field, shift = waves(6), (0.31, -0.22)
    found, moved = match(
        patches_of(900 - 40 * seen_by_template(field, shift)), seen_by_surface(field)
    )
    assert (found.status == Status.KEPT).all()
    assert (found.correlation < -0.99).all()
    assert np.abs(moved - shift).max() < 0.005


def test_flat_patches_have_no_texture() -> None:
    field = waves(7)
    template, image = seen_by_template(field), seen_by_surface(field)
    template[:, :SIZE] = 3.0
    found, _ = match(patches_of(template), image)
    flat = found.template_px[:, 0] < SIZE
    assert flat.sum() == PER_SIDE
    assert (found.status[flat] == Status.TEXTURE).all()
    assert (found.status[~flat] == Status.KEPT).all()
    found, _ = match(patches_of(seen_by_template(field)), np.full_like(image, 3.0))
    assert (found.status == Status.TEXTURE).all()


def test_empty_patches_cause_no_arithmetic_noise() -> None:
    """Neither do values so small that their squares vanish."""
    field = waves(7)
    template, image = seen_by_template(field), seen_by_surface(field)
    nothing = np.zeros_like(template)
    with np.errstate(all="raise", under="ignore"):
        found, _ = match(patches_of(nothing, nothing), image)
        assert (found.status == Status.TEXTURE).all()
        found, _ = match(patches_of(template), np.zeros_like(image))
        assert (found.status == Status.TEXTURE).all()
        found, moved = match(patches_of(1e-11 * template), 1e-13 * image)
    assert (found.status == Status.KEPT).all()
    assert np.abs(moved).max() < 0.003


def test_an_edge_alone_does_not_place_a_patch() -> None:
    """Along the edge nothing holds it (the aperture problem)."""
    rng = np.random.default_rng(0)
    template = np.sin(centres(SIDE) / 3.0) + 0.02 * rng.standard_normal((SIDE, SIDE))
    edge = np.sin((centres(SIDE + 2 * MARGIN) - MARGIN) / 3.0)
    found, _ = match(patches_of(template), np.tile(edge, (len(edge), 1)))
    assert (found.status == Status.TEXTURE).all()


@pytest.mark.parametrize("count", [1, 4])
def test_unrelated_images_are_rejected(count: int) -> None:
    bands = [seen_by_template(waves(20 + number)) for number in range(count)]
    found, _ = match(patches_of(*bands), seen_by_surface(waves(30)))
    assert (found.status != Status.KEPT).mean() > 0.95
    wrong = {Status.TEXTURE, Status.CORRELATION, Status.CONVERGENCE}
    assert set(found.status[found.status != Status.KEPT]) <= {int(s) for s in wrong}


def test_a_patch_that_wanders_off_has_not_converged() -> None:
    field = waves(8, 0.06)
    found, _ = match(patches_of(seen_by_template(field, (2.6, 0.0))), seen_by_surface(field))
    assert (found.status == Status.CONVERGENCE).mean() > 0.9
    assert (found.status != Status.KEPT).all()


def test_masked_pixels_do_not_count() -> None:
    field, shift = waves(9), (0.4, 0.15)
    template = seen_by_template(field, shift)
    valid = np.ones(template.shape, bool)
    valid[:, :7], valid[:, SIZE : SIZE + 13] = False, False
    spoilt = np.where(valid, template, 1e4).astype(np.float32)
    patches = cut_patches([Band(spoilt, valid, TEMPLATE, "")], TEMPLATE, SIZE)
    found, moved = match(patches, seen_by_surface(field))
    first, second = (np.abs(found.template_px[:, 0] - SIZE * (n + 0.5)) < 1 for n in (0, 1))
    assert (found.status[first] == Status.KEPT).all()
    assert np.abs(moved[first] - shift).max() < 0.005
    assert (found.status[second] == Status.TEXTURE).all()


def test_patches_lie_around_their_centres() -> None:
    """Also in a decimated window of a raster that the patches do not fill."""
    full = Grid(Affine(2, 0, 0, 0, -2, 0), (400, 500), "")
    part = Grid(full.transform @ Affine.translation(30, 20) @ Affine.scale(2, 3), (50, 67), "")
    columns, rows = np.meshgrid(centres(67), centres(50))
    cut = cut_patches([as_band(30 + 2 * columns, part), as_band(20 + 3 * rows, part)], full, SIZE)
    assert len(cut) == 6
    assert cut.values.shape == (6, 2, SIZE * SIZE)
    assert cut.step.tolist() == [2, 3]
    assert cut.values.mean(axis=2) == pytest.approx(cut.centre, abs=1e-3)
    assert cut.valid.all()


def test_no_patch_fits_into_a_window_that_is_too_small() -> None:
    small = Grid(Affine.identity(), (15, 90), "")
    cut = cut_patches([as_band(np.zeros((15, 90)), small)], small, SIZE)
    assert len(cut) == 0
