"""Evidence of the gate on fields whose right verdict is known by construction."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS
from scipy import ndimage

from geodelreg.coarse.scopes import scopes
from geodelreg.fine.layers import Claim, bright_mask, keypoints_apart, rival_motion
from geodelreg.fine.least_squares import MatchOptions
from geodelreg.fine.matching import match_bands, match_pass
from geodelreg.fine.overlay import Overlay, widened
from geodelreg.fine.tiles import read_tiles
from geodelreg.fine.tone import single_band
from geodelreg.fine.tuning import Tuning
from geodelreg.geo.affine import affine_matrix
from geodelreg.geo.maps.affine import IDENTITY, AffineMap
from geodelreg.judge.bands import bands_apart
from geodelreg.judge.in_place import AreaEvidence, area_evidence, best_in_place
from geodelreg.judge.rival import rival_correlation
from geodelreg.judge.words import followed_part
from geodelreg.options import AlignOptions
from geodelreg.pair import make_pair, roles
from geodelreg.values.points import Guess, Overview, Status, TiePoints
from geodelreg.values.raster import Band, Grid, Window

SIDE = 140
# limits of the gate, as docs/method.md tells them
MAX_RIVAL, MAX_RIVAL_MOTION, MAX_BANDS_APART, MAX_KEYPOINTS_APART = 0.85, 0.67, 0.5, 2.0
MAX_SHADING = 0.3
GRID = Grid(
    Affine(4.0, 0, 500_000, 0, -4.0, 4_000_000), (SIDE, SIDE), CRS.from_epsg(32618).to_wkt()
)


@dataclass(frozen=True)
class ArrayReader:
    """Bands in memory."""

    bands: tuple[Band, ...]
    name: str = "array"

    @property
    def grid(self) -> Grid:
        return self.bands[0].grid

    @property
    def band_names(self) -> tuple[str, ...]:
        return tuple(f"band {number}" for number in range(1, len(self.bands) + 1))

    def passing(self) -> AbstractContextManager[None]:
        return nullcontext()

    def read(
        self, bands: Sequence[int], window: Window, shape: tuple[int, int] | None = None
    ) -> list[Band]:
        rows = slice(window.row, window.row + window.height)
        columns = slice(window.column, window.column + window.width)
        height, width = shape or (window.height, window.width)
        moved = self.grid.transform @ Affine.translation(window.column, window.row)
        larger = Affine.scale(window.width / width, window.height / height)
        grid = Grid(moved @ larger, (height, width), self.grid.crs_wkt)

        def averaged(image: NDArray[np.float32]) -> NDArray[np.float32]:
            inner = np.ascontiguousarray(image[rows, columns])
            return cv2.resize(inner, (width, height), interpolation=cv2.INTER_AREA)

        chosen = [self.bands[number - 1] for number in bands]
        return [
            Band(averaged(band.data), averaged(band.valid.astype(np.float32)) > 0.5, grid)
            for band in chosen
        ]


def texture(seed: int, shape: tuple[int, int] = (SIDE, SIDE)) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).standard_normal(shape)
    smooth = ndimage.gaussian_filter(noise, 1.5, mode="wrap")
    return (100 * smooth / smooth.std()).astype(np.float32)


def overlaid(template: NDArray[np.float32], surface: NDArray[np.float32]) -> Overlay:
    everywhere = np.ones(template.shape, dtype=bool)
    return Overlay(template, surface, everywhere, everywhere)


def tie_points(residual: NDArray[np.float64], status: NDArray[np.uint8]) -> TiePoints:
    count = len(residual)
    spots = np.random.default_rng(0).uniform(0, 100, (count, 2))
    return TiePoints(
        source_px=spots,
        reference_px=spots * 4,
        covariance_px2=np.tile(np.eye(2) * 0.01, (count, 1, 1)),
        score=np.full(count, 0.95),
        status=status,
        residual_px=residual,
    )


@pytest.mark.parametrize("period", [14, 23, 47])
def test_repeated_texture_has_a_rival(period: int) -> None:
    times = SIDE // period + 1
    tile = texture(period, (period, period))
    field = np.tile(tile, (times, times))[:SIDE, :SIDE]
    noise = 10 * np.random.default_rng(1).standard_normal(field.shape).astype(np.float32)
    assert rival_correlation(overlaid(field, field + noise)).elsewhere > MAX_RIVAL


@pytest.mark.parametrize(("period", "phase"), [(18, 12), (18, 15), (22, 6)])
def test_lines_between_the_pixels_have_a_rival(period: int, phase: int) -> None:
    """Whole pixels fit at every other period only, and the best of many rivals may not be one."""
    across = (np.arange(4 * 60) + phase) % period
    lines = np.where(across < period // 4, 900.0, 0.0)[:, None]
    lines = lines + np.where(across < period // 5, -250.0, 300.0)[None]
    coarse = lines.reshape(60, 4, 60, 4).mean(axis=(1, 3)).astype(np.float32)
    smooth = ndimage.gaussian_filter(lines, 2.0)
    surface = smooth.reshape(60, 4, 60, 4)[:, 1:3, :, 1:3].mean(axis=(1, 3)).astype(np.float32)
    noise = np.random.default_rng(phase).standard_normal(coarse.shape).astype(np.float32)
    assert rival_correlation(overlaid(coarse + 3 * noise, surface)).elsewhere > MAX_RIVAL


def test_texture_has_no_rival() -> None:
    field = texture(3)
    assert rival_correlation(overlaid(field, field + 0.3 * texture(4))).elsewhere < 0.7 * MAX_RIVAL


def test_fields_of_inverted_contrast_are_no_rival() -> None:
    """Bright fields that turned dark cancel the correlation of the whole, not that of its parts."""
    field = texture(5)
    rows, columns = np.mgrid[:SIDE, :SIDE] // 28
    sign = np.where((rows + columns) % 2 == 0, 1.0, -1.0).astype(np.float32)
    assert abs(np.corrcoef(field.ravel(), (field * sign).ravel())[0, 1]) < 0.1
    found = rival_correlation(overlaid(field, field * sign))
    assert found.elsewhere < MAX_RIVAL
    assert found.beside < MAX_SHADING


def test_slopes_in_fields_that_changed_are_still_beside() -> None:
    """Light from one side shows each edge bright beside dark, whatever the field was."""
    field = texture(5)
    rows, columns = np.mgrid[:SIDE, :SIDE] // 28
    sign = np.where((rows + columns) % 2 == 0, 1.0, -1.0).astype(np.float32)
    slopes = np.gradient(ndimage.gaussian_filter(field * sign, 1.0), axis=1).astype(np.float32)
    lit = ndimage.shift(slopes, (0, 2.0), order=1, mode="nearest")
    assert rival_correlation(overlaid(field, lit)).beside > MAX_SHADING


def test_unseen_displaced_places_do_not_silence_a_patch() -> None:
    scores = np.full((3, 17), 0.2)
    scores[0, 0] = scores[1, 0] = 0.9
    scores[:2, 9:] = np.nan
    scores[2, 1:] = np.nan
    assert best_in_place(scores) == AreaEvidence(2, 2, 2, 2)


def test_areas_that_resemble_nothing_do_not_vote() -> None:
    scores = np.full((4, 17), 0.1)
    scores[0, 0] = scores[1, 3] = 0.9
    found = best_in_place(scores)
    assert (found.tested, found.alike, found.support) == (4, 2, 0.5)


def test_narrow_overlap_of_repeated_texture_still_has_a_rival() -> None:
    """Displaced by a period, the strip leaves no whole block to compare."""
    tile = texture(9, (20, 20))
    field = np.tile(tile, (7, 2))[:, :36]
    assert rival_correlation(overlaid(field, field)).elsewhere > MAX_RIVAL


def test_a_rival_beyond_the_template_is_seen() -> None:
    """A strip of repeated texture shows one period; PAN has the next, where no template lies."""
    period, strip = 60, 50
    field = np.tile(texture(11, (SIDE, period)), (1, 4))
    template = np.pad(field[:, :SIDE], ((0, 0), (0, SIDE // 2)))
    surface = field[:, : SIDE + SIDE // 2]
    there = np.zeros(template.shape, dtype=bool)
    there[:, :SIDE] = True
    seen = np.zeros(template.shape, dtype=bool)
    seen[:, SIDE - strip :] = True
    assert (
        rival_correlation(Overlay(template, surface, there & seen, there & seen)).elsewhere
        < MAX_RIVAL
    )
    assert rival_correlation(Overlay(template, surface, there, seen)).elsewhere > MAX_RIVAL


@pytest.mark.parametrize(("beyond", "margin"), [(0, 0), (17, 17), (500, SIDE // 2)])
def test_a_widened_template_lies_where_it_lay(beyond: int, margin: int) -> None:
    band = Band(texture(2), np.ones((SIDE, SIDE), dtype=bool), GRID)
    finer = Grid(
        GRID.transform @ Affine.translation(-beyond, 0) @ Affine.scale(0.5),
        (2 * SIDE, 2 * SIDE + 4 * beyond),
        GRID.crs_wkt,
    )
    surface = Band(np.ones(finer.shape, np.float32), np.ones(finer.shape, dtype=bool), finer)
    part = roles(make_pair(ArrayReader((band,)), ArrayReader((surface,)), AlignOptions()))
    wide = widened(part, band, surface, IDENTITY)
    assert wide.data.shape == (SIDE, SIDE + 2 * margin)
    assert wide.valid.sum() == SIDE**2
    assert wide.grid.transform @ (margin, 0) == pytest.approx(GRID.transform @ (0, 0))
    np.testing.assert_array_equal(wide.data[:, margin : margin + SIDE], band.data)


def two_bands(parallax_px: float) -> float:
    """`bands_apart` where the second MS band sees everything displaced."""
    ground = texture(8, (200, 200))
    later = ndimage.shift(ground, (parallax_px, 0), order=3, mode="wrap").astype(np.float32)
    wkt = CRS.from_epsg(32616).to_wkt()
    grid = Grid(Affine(2.0, 0.0, 5e5, 0.0, -2.0, 1e6), ground.shape, wkt)
    valid = np.ones(ground.shape, dtype=bool)
    ms = ArrayReader((Band(ground, valid, grid), Band(later, valid, grid)))
    pair = make_pair(ms, ArrayReader((Band(ground, valid, grid),)), AlignOptions())
    part = roles(pair)
    tiles = read_tiles(part, [Window(0, 0, 200, 200)], IDENTITY)
    with ThreadPoolExecutor(2) as pool:
        tuning = Tuning(0.5, single_band(2, 0))
        passes = match_bands(part, tiles, tuning, 20, IDENTITY, pool)
    return bands_apart(passes, pair).distance_px


def test_bands_of_clouds_are_apart() -> None:
    assert two_bands(1.3) > MAX_BANDS_APART


def test_bands_of_the_ground_are_together() -> None:
    assert two_bands(0.0) < 0.01


def test_few_patches_keep_the_rotation_they_start_from() -> None:
    """A shift is fitted on top of where the patches started from, not of the header."""
    ground = texture(9, (160, 160))
    turn, centre = np.radians(12.0), np.array([80.0, 80.0])
    linear = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    truth = np.column_stack([linear, centre - linear @ centre])
    x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(160) + 0.5)
    there = np.stack([x.ravel(), y.ravel()], 1) @ linear.T + truth[:, 2] - 0.5
    turned = ndimage.map_coordinates(ground, [there[:, 1], there[:, 0]], order=3, mode="mirror")
    turned = turned.reshape(ground.shape).astype(np.float32)
    wkt = CRS.from_epsg(32616).to_wkt()
    grid = Grid(Affine(2.0, 0.0, 5e5, 0.0, -2.0, 1e6), ground.shape, wkt)
    valid = np.ones(ground.shape, dtype=bool)
    ms = ArrayReader((Band(turned, valid, grid),))
    pair = make_pair(ms, ArrayReader((Band(ground, valid, grid),)), AlignOptions())
    part, start = roles(pair), AffineMap.of(truth).then(AffineMap(Affine.translation(0.3, -0.2)))
    tiles = read_tiles(part, [Window(50, 50, 60, 60)], start)
    tuning = Tuning(0.3, single_band(1, 0))
    dense = match_pass(part, tiles, start, tuning, MatchOptions(size=20))
    assert len(dense.status) == 9
    assert dense.estimate is not None
    found = dense.estimate.map.as_affine()
    assert found is not None
    np.testing.assert_allclose(affine_matrix(found), truth, atol=0.03)


@pytest.mark.parametrize("shift_px", [0.0, 5.0])
def test_patches_score_best_where_their_content_is(shift_px: float) -> None:
    """Rows beyond the PAN raster's lower edge are invalid: what they hide takes no part."""
    ground = texture(7, (160, 160))
    wkt = CRS.from_epsg(32616).to_wkt()
    grid = Grid(Affine(2.0, 0.0, 5e5, 0.0, -2.0, 1e6), ground.shape, wkt)
    valid = np.ones(ground.shape, dtype=bool)
    valid[100:] = False
    moved = Grid(Affine.translation(2 * shift_px, 0.0) @ grid.transform, ground.shape, wkt)
    ms = ArrayReader((Band(ground, np.ones_like(valid), moved),))
    readers = ms, ArrayReader((Band(ground, valid, grid),))
    pair = make_pair(*readers, AlignOptions())
    part, everything = roles(pair), Window(0, 0, 160, 160)
    tiles = read_tiles(part, [everything], IDENTITY)
    tuning = Tuning(0.5, single_band(1, 0))
    found = area_evidence(part, tiles, IDENTITY, tuning, 20, few=False)
    assert found.tested >= 30
    share = found.best_in_place / found.tested
    assert share == 1.0 if shift_px == 0.0 else share < 0.5


def test_motion_of_clouds_is_a_rival() -> None:
    """Eleven patches agree on clouds of one height, nine on those of another."""
    rng = np.random.default_rng(2)
    kept = 0.1 * rng.standard_normal((11, 2))
    other = np.array([-7.7, 11.0]) + 0.2 * rng.standard_normal((9, 2))
    stray = rng.uniform(-12, 12, (10, 2))
    status = np.r_[np.zeros(11), np.full(19, Status.CONVERGENCE)].astype(np.uint8)
    points = tie_points(np.concatenate([kept, other, stray]), status)
    assert rival_motion(points, 4.0) > MAX_RIVAL_MOTION


def test_strays_are_no_rival_motion() -> None:
    rng = np.random.default_rng(3)
    residual = np.concatenate([0.1 * rng.standard_normal((11, 2)), rng.uniform(-12, 12, (19, 2))])
    status = np.r_[np.zeros(11), np.full(19, Status.CONVERGENCE)].astype(np.uint8)
    assert rival_motion(tie_points(residual, status), 4.0) < MAX_RIVAL_MOTION


def test_rounding_of_a_constant_is_not_bright() -> None:
    """A spread of a few units in the last place of float32 cannot be cut into a histogram."""
    data = np.full((64, 64), 1.0, dtype=np.float32)
    data[::2] = np.nextafter(np.float32(1.0), np.float32(2.0))
    grid = Grid(Affine.identity(), data.shape, "")
    assert bright_mask(Band(data, np.ones(data.shape, dtype=bool), grid)) is None


@pytest.mark.parametrize(
    ("log_nfa_before", "log_nfa_own", "apart_px", "passes"),
    [
        (-50.0, np.nan, 9.0, False),
        (-50.0, -20.0, 9.0, False),
        (-50.0, -80.0, 9.0, True),
        (-5.0, np.nan, 9.0, True),
        (-50.0, np.nan, 1.0, True),
    ],
)
def test_stronger_keypoints_are_heeded_after_a_refusal(
    log_nfa_before: float, log_nfa_own: float, apart_px: float, passes: bool
) -> None:
    reader = ArrayReader((Band(texture(1), np.ones((SIDE, SIDE), dtype=bool), GRID),))
    pair = make_pair(reader, reader, AlignOptions())
    images = Overview([], reader.bands[0], next(scopes(pair)))
    before = Claim(AffineMap(Affine.translation(apart_px, 0)), log_nfa_before)
    own = Guess(IDENTITY, log_nfa_own, {}, images)
    points = tie_points(np.zeros((9, 2)), np.zeros(9, np.uint8))
    apart, move_px = keypoints_apart(pair, own, [before], IDENTITY, points)
    assert (apart <= MAX_KEYPOINTS_APART) is passes
    assert np.hypot(*move_px) == pytest.approx(apart)
    assert (f"lies {apart:.2g} px right" in followed_part(points, pair, move_px)) is (apart > 0)
