"""Pairs that cannot be aligned are refused, with the evidence, and nothing is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

from geodelreg import Alignment, AlignOptions, align
from geodelreg.errors import (
    AlignmentRefusedError,
    BandNumberError,
    GeodelregError,
    NoDataError,
    NoOverlapError,
)
from geodelreg.values.result import Outcome
from tests.integration.align_scenes import (
    Bands,
    Pixels,
    Recipe,
    Scene,
    centred,
    ground,
    make_scene,
    write,
)

STANDARD = Recipe(centred(4, 130), (130, 130))
HALVES = (0, 0, 390, 800)


@pytest.fixture(scope="module")
def standard(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("standard"), STANDARD)


def refusal(kind: type[GeodelregError], ms: Path, pan: Path, **options: object) -> GeodelregError:
    """The error; folders hold afterwards what they held before."""
    folders = {ms.parent, pan.parent}
    before = {path: path.read_bytes() for folder in folders for path in folder.iterdir()}
    with pytest.raises(kind) as caught:
        align(ms, pan, AlignOptions(**options))  # type: ignore[arg-type]
    assert {path: path.read_bytes() for folder in folders for path in folder.iterdir()} == before
    return caught.value


def alignment_of(error: GeodelregError) -> Alignment:
    """Of a refusal: its reasons are there, its correction is none."""
    assert isinstance(error, AlignmentRefusedError)
    assert error.alignment is not None
    verdict, correction = error.alignment.verdict, error.alignment.correction
    assert verdict.outcome is Outcome.REFUSED
    assert correction.model == "none"
    assert correction.corrected == correction.original
    for reason in verdict.reasons:
        assert (reason.message in str(error)) == (not reason.passed)
    return error.alignment


def like(path: Path, scene: Scene, bands: Pixels) -> Path:
    return write(path, bands, Affine(*scene.truth.ms_header), scene.truth.ms_crs)


def pixels(path: Path) -> Pixels:
    with rasterio.open(path) as dataset:
        return dataset.read()


def test_unrelated_ground(tmp_path: Path) -> None:
    """MS shows the eastern half and says it is the western one."""
    east = Recipe(
        Affine.translation(404, 0) @ Affine.scale(4), (200, 97),
        Affine.translation(-101, 0), pan_window=HALVES,
    )  # fmt: skip
    scene = make_scene(tmp_path, east)
    alignment_of(refusal(AlignmentRefusedError, scene.ms, scene.pan))


@pytest.mark.parametrize("axis", [1, 2], ids=["upside down", "left to right"])
def test_mirrored_images(standard: Scene, tmp_path: Path, axis: int) -> None:
    mirrored = like(tmp_path / "ms.tif", standard, np.flip(pixels(standard.ms), axis))
    alignment_of(refusal(AlignmentRefusedError, mirrored, standard.pan))


@pytest.mark.parametrize("seed", range(3))
def test_noise(standard: Scene, tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = rng.integers(1, 4000, (4, 130, 130)).astype(np.uint16)
    alignment_of(refusal(AlignmentRefusedError, like(tmp_path / "ms.tif", standard, noise),
                         standard.pan))  # fmt: skip


@pytest.mark.parametrize("period_px", [24, 48, 100])
@pytest.mark.parametrize("error", [Affine.identity(), Affine.translation(1.84, -1.16)])
def test_repeated_texture(tmp_path: Path, period_px: int, error: Affine) -> None:
    """It fits as well one period further, even where the header is right."""

    def tiled(bands: Bands) -> Bands:
        block = bands[:, 300 : 300 + period_px, 350 : 350 + period_px]
        times = 800 // period_px + 1
        return np.tile(block, (1, times, times))[:, :800, :800]

    scene = make_scene(tmp_path, replace(STANDARD, land=tiled, error=error))
    found = alignment_of(refusal(AlignmentRefusedError, scene.ms, scene.pan))
    rival = [r.value for r in found.verdict.reasons if r.name == "rival"]
    assert not rival or rival[0] > 0.85


def blank_ms(ms: Pixels, pan: Pixels) -> None:
    ms[:] = 7


def no_ms(ms: Pixels, pan: Pixels) -> None:
    ms[:] = 0


def blank_pan(ms: Pixels, pan: Pixels) -> None:
    pan[:] = 7


def no_pan(ms: Pixels, pan: Pixels) -> None:
    pan[:] = 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (blank_ms, "ms.tif: band 1 has the constant value 7"),
        (no_ms, "ms.tif: band 1 has no valid pixel"),
        (blank_pan, "pan.tif: band 1 has the constant value 7"),
        (no_pan, "pan.tif: band 1 has no valid pixel"),
    ],
)
def test_nothing_to_match(
    tmp_path: Path, change: Callable[[Pixels, Pixels], None], message: str
) -> None:
    scene = make_scene(tmp_path, replace(STANDARD, change=change, nodata=0))
    said = str(refusal(NoDataError, scene.ms, scene.pan))
    assert message in said
    assert "Choose another band, or check the no-data value and the mask" in said


def test_no_overlap_in_headers_and_contents(tmp_path: Path) -> None:
    east = Recipe(
        Affine.translation(404, 0) @ Affine.scale(4), (200, 97),
        Affine.translation(3000, 0), pan_window=HALVES,
    )  # fmt: skip
    scene = make_scene(tmp_path, east)
    error = refusal(NoOverlapError, scene.ms, scene.pan)
    assert "ms.tif and pan.tif do not overlap" in str(error)


def test_bands_that_do_not_exist(standard: Scene) -> None:
    assert "no band 5" in str(refusal(BandNumberError, standard.ms, standard.pan, band=5))
    assert "no band 2" in str(refusal(BandNumberError, standard.ms, standard.pan, pan_band=2))


def test_limits_that_were_set(standard: Scene) -> None:
    found = alignment_of(
        refusal(AlignmentRefusedError, standard.ms, standard.pan, max_shift_px=5.0)
    )
    failed = [reason for reason in found.verdict.reasons if not reason.passed]
    assert [reason.name for reason in failed] == ["max_shift"]
    assert failed[0].value == pytest.approx(standard.before_px, abs=0.05)
    assert len(found.tie_points) > 20


@pytest.mark.parametrize("method", ["zhang2013", "sift"])
def test_unrelated_ground_whatever_the_method(tmp_path: Path, method: str) -> None:
    rng = np.random.default_rng(0)
    scene = make_scene(tmp_path, STANDARD)
    shuffled = rng.permuted(pixels(scene.ms).reshape(4, 13, 10, 130), axis=1).reshape(4, 130, 130)
    mixed = like(tmp_path / "mixed.tif", scene, shuffled)
    alignment_of(refusal(AlignmentRefusedError, mixed, scene.pan, method=method))


def test_the_ground_differs_between_its_halves() -> None:
    """What `test_unrelated_ground` calls unrelated is: no shift makes them alike."""
    west, east = ground().bands[1, :, :400], ground().bands[1, :, 400:]
    spectra = [np.fft.rfft2(half - half.mean()) for half in (west, east)]
    score = np.fft.irfft2(spectra[0] * np.conj(spectra[1])) / (west.size * west.std() * east.std())
    assert np.abs(score).max() < 0.4
