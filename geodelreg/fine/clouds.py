"""Evidence that what moves differently is clouds, and not ground that is bent or torn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.values.raster import TINY, BoolArray, FloatArray

_OFTEN = 0.7
"""Probability from which patches that move count as brighter, or smoother: 0.75 to 0.89 over clouds
and smoke, at most one of the two beyond 0.7 over waves and tears of twelve scenes."""
_STILL = 0.65
"""Share of the least cloudy half that must keep still: 0.70 to 0.77 over clouds; over waves 0.05 to
0.45, for there all move."""
_PARALLAX_R2 = 0.65
"""Share of the motion that the bands' parallax must explain: 0.74 and 0.96 over real clouds, 0.43
at most over ground, where unlike bands look different."""
_NO_PARALLAX_SIGMAS = 2.5  # unexplained: ablate
_MOST_PERCENT = 95  # unexplained: ablate
_FEWEST = 30  # unexplained: ablate


@dataclass(frozen=True, slots=True)
class CloudLook:
    """Whether what moves differently looks like clouds.

    Attributes
    ----------
    brighter, smoother : float
        Probability that a patch that moves is brighter, or smoother, than one that does not
        (Mann & Whitney 1947); one half where it makes no difference.
    still : float
        Share of the half of the patches that looks least like cloud that does not move.
    """

    brighter: float
    smoother: float
    still: float

    @property
    def explains(self) -> bool:
        """True when clouds are the better explanation than a bent or torn ground."""
        return min(self.brighter, self.smoother) >= _OFTEN and self.still >= _STILL

    @property
    def tells_layers_apart(self) -> bool:
        """True when one of two layers, whichever, looks like clouds beside the other."""
        looks = self.brighter, self.smoother
        return min(looks) >= _OFTEN or max(looks) <= 1.0 - _OFTEN


def cloud_look(moves: BoolArray, brightness: FloatArray, roughness: FloatArray) -> CloudLook:
    """Compare the looks of patches that move against the ground with those that do not.

    Parameters
    ----------
    moves : (N,) bool
    brightness : (N,) float64
        Mean of a patch.
    roughness : (N,) float64
        Contrast between neighbouring pixels over the contrast of the whole patch.
    """
    ground_like = _rank(brightness) - _rank(roughness)
    least = ground_like <= np.median(ground_like)
    return CloudLook(
        _greater(brightness[moves], brightness[~moves]),
        1.0 - _greater(roughness[moves], roughness[~moves]),
        float((~moves[least]).mean()) if least.any() else 0.0,
    )


def _rank(values: FloatArray) -> FloatArray:
    return np.asarray(np.argsort(np.argsort(values, kind="stable"), kind="stable"), np.float64)


def _greater(one: FloatArray, other: FloatArray) -> float:
    """Probability that a value of `one` is greater than one of `other`."""
    if not len(one) or not len(other):
        return 0.5
    rank = _rank(np.concatenate([one, other]))[: len(one)] + 1
    return float((rank.sum() - len(one) * (len(one) + 1) / 2) / (len(one) * len(other)))


@dataclass(frozen=True, slots=True, eq=False)
class HeightParallax:
    """Whether motion against PAN goes with motion between two MS bands.

    The detectors of a pushbroom sensor see a place one band after the other, from slightly
    different directions: what is high above the ground, or moves, is elsewhere in each, and the
    more so the further it is off in PAN.

    Attributes
    ----------
    explained : float
        Share of the variance of the motion that the bands' difference explains (r²).
    ground : (N,) bool
        Patches where the two bands agree to within their errors.
    share : float
        Of the patches seen in both bands, those where they do not.
    """

    explained: float
    ground: BoolArray
    share: float = 0.0

    @property
    def explains(self) -> bool:
        """True when height above the ground is what makes the patches move."""
        return self.explained >= _PARALLAX_R2


def height_parallax(
    move: FloatArray, difference: FloatArray, sigma_px: FloatArray
) -> HeightParallax:
    """Regress the motion on the difference between two bands, each along its main direction.

    Parameters
    ----------
    move : (N, 2) float64
        Displacement of the patches, NaN where not matched.
    difference : (N, 2) float64
        Where one band puts a patch minus where another does; NaN where either did not match.
        The bands agree on the ground.
    sigma_px : (N,) float64
        Radial standard error of the difference.
    """
    both = np.isfinite(move).all(axis=1) & np.isfinite(difference).all(axis=1)
    ground = np.zeros(len(move), dtype=bool)
    if both.sum() < _FEWEST:
        return HeightParallax(0.0, ground)
    one, other = _along(move[both]), _along(difference[both])
    spread = one.std() * other.std()
    r = float(((one - one.mean()) * (other - other.mean())).mean() / spread) if spread > 0 else 0.0
    apart = np.hypot(*difference[both].T)
    ground[both] = apart <= _NO_PARALLAX_SIGMAS * sigma_px[both]
    return HeightParallax(r * r, ground, float(1.0 - ground[both].mean()))


def _along(values: FloatArray) -> FloatArray:
    """(N,) components along the direction in which (N, 2) values spread most, outliers bounded."""
    centred = values - np.median(values, axis=0)
    far = np.percentile(np.hypot(*centred.T), _MOST_PERCENT)
    size = np.maximum(np.hypot(*centred.T), TINY)
    centred = centred * np.minimum(far / size, 1.0)[:, None]
    return np.asarray(centred @ np.linalg.eigh(centred.T @ centred)[1][:, 1])
