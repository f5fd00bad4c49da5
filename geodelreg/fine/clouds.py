"""Evidence that what moves differently is clouds, and not ground that is bent or torn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geodelreg.fine.motions import neighbours
from geodelreg.fit.chance import signed_ranks
from geodelreg.values.raster import TINY, BoolArray, FloatArray

_AMONG = 0.5
"""Share of the patches that move that must lie beside one that does not: 0.6 and more over clouds;
a part that is torn off has still neighbours along its edge alone."""
_LOG_CHANCE = -2.0
"""Of patches that outshine their neighbours: one alarm in a hundred pairs that are bent."""
OUTSHINING = 0.75
"""Share of the sum of ranks that patches which outshine their neighbours must hold: 0.85 to 0.96
over clouds; of ground that is bent or torn a half, and 0.62 at most.  Many patches make chance
unlikely where one end of a scene is a little brighter."""
_PARALLAX_R2 = 0.65
"""Share of the motion that the bands' parallax must explain: 0.74 and 0.96 over real clouds, 0.43
at most over ground, where unlike bands look different."""
_NO_PARALLAX_SIGMAS = 2.5  # by hand: ½ to 2 × alike
_MOST_PERCENT = 95  # by hand: ½ to 2 × alike
_FEWEST = 30  # by hand: ½ to 2 × alike


@dataclass(frozen=True, slots=True)
class CloudLook:
    """Whether what moves differently looks like clouds.

    Attributes
    ----------
    among : float
        Share of the patches that move that lie beside one that does not.
    log_chance : float
        log10 of the probability that those would by chance be so much brighter than their still
        neighbours, each by its brightest pixels (signed ranks, Wilcoxon 1945).
    outshining : float
        Share of the sum of those ranks that is of patches brighter than their neighbours.
    """

    among: float = 0.0
    log_chance: float = 0.0
    outshining: float = 0.0

    @property
    def explains(self) -> bool:
        """True when clouds are the better explanation than a bent or torn ground."""
        likely = self.log_chance <= _LOG_CHANCE and self.outshining >= OUTSHINING
        return likely and self.among >= _AMONG


def cloud_look(xy: FloatArray, moves: BoolArray, brightest: FloatArray) -> CloudLook:
    """Compare patches that move against the ground with those beside them that do not.

    A patch moves with a cloud when there is some cloud in it, so that its brightest pixels tell,
    not its mean.  Ground is alike on both sides of a tear; between clouds it is in sight, and
    darker.  Comparing neighbours alone leaves out that one end of a scene is brighter than the
    other.

    Parameters
    ----------
    xy : (N, 2) float64
        Patches.
    moves : (N,) bool
    brightest : (N,) float64
        Values that the brightest pixels of a patch reach.
    """
    pairs = neighbours(xy)
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    one, other = pairs[moves[pairs[:, 0]] & ~moves[pairs[:, 1]]].T
    count = np.bincount(one, minlength=len(xy))
    beside = count > 0
    if not beside.any():
        return CloudLook()
    around = np.bincount(one, brightest[other], minlength=len(xy))[beside] / count[beside]
    brighter = brightest[beside] - around
    among = int(beside.sum()) / int(moves.sum())
    return CloudLook(among, *signed_ranks(brighter))


@dataclass(frozen=True, slots=True)
class HeightParallax:
    """Whether motion against PAN goes with motion between two MS bands.

    The detectors of a pushbroom sensor see a place one band after the other, from slightly
    different directions: what is high above the ground, or moves, is elsewhere in each, and the
    more so the further it is off in PAN.

    Attributes
    ----------
    explained : float
        Share of the variance of the motion that the bands' difference explains (r²).
    share : float
        Of the patches seen in both bands, those where the two do not agree to within their errors.
    """

    explained: float = 0.0
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
    if both.sum() < _FEWEST:
        return HeightParallax()
    one, other = _along(move[both]), _along(difference[both])
    spread = one.std() * other.std()
    r = float(((one - one.mean()) * (other - other.mean())).mean() / spread) if spread > 0 else 0.0
    apart = np.hypot(*difference[both].T)
    agree = apart <= _NO_PARALLAX_SIGMAS * sigma_px[both]
    return HeightParallax(r * r, float(1.0 - agree.mean()))


def _along(values: FloatArray) -> FloatArray:
    """(N,) components along the direction in which (N, 2) values spread most, outliers bounded."""
    centred = values - np.median(values, axis=0)
    far = np.percentile(np.hypot(*centred.T), _MOST_PERCENT)
    size = np.maximum(np.hypot(*centred.T), TINY)
    centred = centred * np.minimum(far / size, 1.0)[:, None]
    return np.asarray(centred @ np.linalg.eigh(centred.T @ centred)[1][:, 1])
