"""The one similarity or affine that many matches agree on."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from geodelreg.geo.maps.affine import AffineMap
from geodelreg.values.maps import PixelMap
from geodelreg.values.points import Keypoints, Matches
from geodelreg.values.raster import BoolArray, FloatArray, IntArray

SAMPLE_SIZE = {"similarity": 2, "affine": 3}
SAMPLES = {"similarity": (2,), "affine": (2, 3)}
MAX_STRETCH = 8.0  # unexplained: ablate

_SCORED_MATCHES = 1000  # unexplained: ablate
_SAMPLES_PER_ROUND = 300  # unexplained: ablate
_MAX_ROUNDS = 40  # at most 12 000 samples; unexplained: ablate
_MISSED = 1e-4  # probability that no sample was all inliers
_REFINED_HYPOTHESES = 12  # unexplained: ablate
_LOOSENING = (4.0, 2.0, 1.0, 1.0)
_MAX_PAIRS = 1500  # unexplained: ablate
_CONVINCING_SHARE = 0.3  # unexplained: ablate
_MIN_BASELINE_PX = 16.0  # unexplained: ablate
_LOG_SCALE_TOLERANCE = math.log(1.35)  # of SIFT's scales; unexplained: ablate
_TURN_TOLERANCE = math.radians(15.0)  # of SIFT's orientations; unexplained: ablate


class Consensus(NamedTuple):
    """A transformation and the matches that agree with it.

    Attributes
    ----------
    map : AffineMap or None
        Source pixels to reference pixels; None when nothing was found.
    inliers : (M,) bool
    """

    map: AffineMap | None
    inliers: BoolArray


def consensus_affine(
    source_xy: FloatArray,
    reference_xy: FloatArray,
    doubt: FloatArray,
    threshold_px: float,
    seed: int = 0,
    kind: str = "affine",
    least_share: float = 0.0,
) -> Consensus:
    """Find the transformation that most matches agree on, by sampling.

    Vectorised RANSAC, on pairs of matches and for an affine also on triples, that samples good
    ratios more often (after Chum & Matas 2005, doi:10.1109/CVPR.2005.221) and refits the best
    hypotheses to their inliers (Chum et al. 2003, doi:10.1007/978-3-540-45243-0_31).  Mirroring
    and scales beyond 1:8 are not considered.  Always returns the best it saw: judge it by
    `geodelreg.fit.chance.log_nfa`.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        One-to-one matches, outer-corner pixels.
    doubt : (M,) float64
        Of each match; smaller is better, as of a descriptor distance ratio or a variance.
    threshold_px : float
        Largest residual of an inlier, in reference pixels.
    seed : int
        Of the sampling; the same seed gives the same result.
    kind : str
        ``similarity`` or ``affine``.
    least_share : float
        Of the matches, that must agree to be of interest: fewer are not searched for.

    Returns
    -------
    Consensus
    """
    size = SAMPLE_SIZE[kind]
    count = len(source_xy)
    if count < size:
        return _nothing(count)
    pool = np.argsort(doubt, kind="stable")[:_SCORED_MATCHES]
    source, reference = source_xy[pool], reference_xy[pool]
    rng = np.random.default_rng(seed)
    matrices: list[FloatArray] = []
    scores: list[FloatArray] = []
    best_score = dict.fromkeys(SAMPLES[kind], least_share * len(pool))
    for done in range(1, _MAX_ROUNDS + 1):
        for sample in SAMPLES[kind]:
            hypotheses = _sampled_hypotheses(source, reference, rng, sample)
            if len(hypotheses):
                matrices.append(hypotheses)
                scores.append(_scores(hypotheses, source, reference, threshold_px))
                best_score[sample] = max(best_score[sample], float(scores[-1].max()))
        if any(
            done * _SAMPLES_PER_ROUND >= _samples_needed(best_score[sample], len(pool), sample)
            for sample in SAMPLES[kind]
        ):
            break
    if not matrices:
        return _nothing(count)
    best = _best_of(np.concatenate(matrices), np.concatenate(scores))
    return _refined(best, source_xy, reference_xy, threshold_px, kind)


def consensus_keypoints(
    source: Keypoints,
    reference: Keypoints,
    matches: Matches,
    threshold_px: float,
    seed: int = 0,
    kind: str = "affine",
) -> Consensus:
    """Find the transformation that most matches agree on, from the keypoints' scales and angles.

    One SIFT match alone implies a similarity.  Pairs of matches (of the best 1000) whose scales,
    angles and relative position all tell the same one are the hypotheses: chance seldom makes such
    a pair, so this stands far more outliers than sampling.  `consensus_affine` comes first, and its
    result stays when it has a convincing share of the matches or simply more of them.

    Parameters
    ----------
    source, reference : Keypoints
    matches : Matches
        One-to-one.
    threshold_px, seed, kind
        As in `consensus_affine`.

    Returns
    -------
    Consensus
        Inliers refer to `matches`.
    """
    source_xy, reference_xy = matches.xy(source, reference)
    sampled = consensus_affine(source_xy, reference_xy, matches.ratio, threshold_px, seed, kind)
    convincing = sampled.inliers.sum() > _CONVINCING_SHARE * len(matches)
    if convincing or len(matches) < SAMPLE_SIZE[kind]:
        return sampled
    pool = matches.take(np.argsort(matches.ratio, kind="stable")[:_SCORED_MATCHES])
    pool_source, pool_reference = pool.xy(source, reference)
    first, second = _agreeing_pairs(source, reference, pool)
    pair = np.stack([first, second], axis=1)
    exact = np.ones(pair.shape)
    hypotheses = _fitted(pool_source[pair], pool_reference[pair], exact, "similarity")
    hypotheses = hypotheses[_plausible(hypotheses)]
    if len(hypotheses) == 0:
        return sampled
    best = _best_of(hypotheses, _scores(hypotheses, pool_source, pool_reference, threshold_px))
    paired = _refined(best, source_xy, reference_xy, threshold_px, kind)
    return paired if paired.inliers.sum() >= sampled.inliers.sum() else sampled


def radial_residuals(
    there: PixelMap, source_xy: FloatArray, reference_xy: FloatArray
) -> FloatArray:
    """(M,) float64, distance of each mapped source point from its reference point."""
    gap = there.forward(source_xy) - reference_xy
    return np.asarray(np.hypot(gap[:, 0], gap[:, 1]))


def fit_plainly(source_xy: FloatArray, reference_xy: FloatArray, kind: str) -> AffineMap:
    """Least-squares similarity or affine from source to reference points.

    Parameters
    ----------
    source_xy, reference_xy : (M, 2) float64
        At least two points (similarity) or three that are not collinear (affine).
    kind : str
        ``similarity`` or ``affine``.
    """
    every = np.ones((1, len(source_xy)))
    return AffineMap.of(_fitted(source_xy, reference_xy, every, kind)[0])


def _nothing(count: int) -> Consensus:
    return Consensus(None, np.zeros(count, dtype=np.bool_))


def _sampled_hypotheses(
    source: FloatArray, reference: FloatArray, rng: np.random.Generator, size: int
) -> FloatArray:
    """(S, 2, 3) float64, plausible transformations through random samples of 2 or 3 matches.

    Half of the samples prefer the leading matches (best ratios), half take all alike.
    """
    count = len(source)
    uniform = rng.random((_SAMPLES_PER_ROUND, size))
    uniform[::2] **= 3
    index = np.minimum((uniform * count).astype(np.intp), count - 1)
    ordered = np.sort(index, axis=1)
    index = index[(np.diff(ordered, axis=1) > 0).all(axis=1)]
    s, r = source[index], reference[index]
    matrices = _fitted(s, r, np.ones(index.shape), "similarity" if size == 2 else "affine")
    return matrices[_plausible(matrices)]


def _agreeing_pairs(
    source: Keypoints, reference: Keypoints, matches: Matches
) -> tuple[IntArray, IntArray]:
    """Pairs of matches that imply one similarity, by scale, angle and relative position.

    At most `_MAX_PAIRS`, best ratios first.
    """
    s, r = matches.source_index, matches.reference_index
    log_scale = np.log(reference.scale_px[r] / source.scale_px[s])
    turn = np.radians(reference.angle_deg[r] - source.angle_deg[s])
    first, second = np.nonzero(
        np.triu(np.abs(log_scale[:, None] - log_scale) < 2 * _LOG_SCALE_TOLERANCE, 1)
        & (np.cos(turn[:, None] - turn) > math.cos(2 * _TURN_TOLERANCE))
    )
    source_step = (source.xy[s[second]] - source.xy[s[first]]).view(np.complex128)[:, 0]
    reference_step = (reference.xy[r[second]] - reference.xy[r[first]]).view(np.complex128)[:, 0]
    far = (np.abs(source_step) > _MIN_BASELINE_PX) & (np.abs(reference_step) > _MIN_BASELINE_PX)
    first, second = first[far], second[far]
    stretch = np.log(reference_step[far] / source_step[far])
    agree = np.ones(len(first), dtype=np.bool_)
    for end in (first, second):
        agree &= np.abs(stretch.real - log_scale[end]) < _LOG_SCALE_TOLERANCE
        agree &= np.cos(stretch.imag - turn[end]) > math.cos(_TURN_TOLERANCE)
    first, second = first[agree], second[agree]
    best = np.argsort(matches.ratio[first] + matches.ratio[second], kind="stable")[:_MAX_PAIRS]
    return first[best], second[best]


def _plausible(matrices: FloatArray) -> BoolArray:
    """True where a transformation is finite, does not mirror, and stretches by at most 1:8."""
    a, b, c, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1]
    with np.errstate(invalid="ignore", over="ignore"):
        determinant = a * d - b * c
        power = a * a + b * b + c * c + d * d
        root = np.sqrt(np.maximum(power * power - 4 * determinant**2, 0.0))
        largest, smallest = (power + root) / 2, (power - root) / 2
        return np.asarray(
            np.isfinite(power)
            & (determinant > 0)
            & (largest <= MAX_STRETCH**2)
            & (smallest >= MAX_STRETCH**-2)
        )


def _scores(
    matrices: FloatArray, source: FloatArray, reference: FloatArray, threshold_px: float
) -> FloatArray:
    """(S,) float64, sum over the matches of 1 - (residual / threshold)², at least 0 each."""
    squared = _squared_residuals(matrices, source, reference)
    return np.asarray(np.maximum(1.0 - squared / threshold_px**2, 0.0).sum(axis=1))


def _squared_residuals(
    matrices: FloatArray, source: FloatArray, reference: FloatArray
) -> FloatArray:
    """(S, M) float64."""
    squared = np.zeros((len(matrices), len(source)))
    for axis in (0, 1):
        gap = matrices[:, axis, :1] * source[:, 0]
        gap += matrices[:, axis, 1:2] * source[:, 1]
        gap += matrices[:, axis, 2:]
        gap -= reference[:, axis]
        squared += gap * gap
    return squared


def _samples_needed(inliers: float, count: int, size: int) -> int:
    """Samples after which an all-inlier one has been seen with probability 1 − `_MISSED`."""
    share = min(max(inliers, size) / count, 1.0)
    if share == 1.0:
        return 0
    return int(math.log(_MISSED) / math.log1p(-(share**size))) + 1


def _best_of(matrices: FloatArray, scores: FloatArray) -> FloatArray:
    """(K, 2, 3), the hypotheses of highest score."""
    return matrices[np.argsort(-scores, kind="stable")[:_REFINED_HYPOTHESES]]


def _refined(
    hypotheses: FloatArray,
    source_xy: FloatArray,
    reference_xy: FloatArray,
    threshold_px: float,
    kind: str,
) -> Consensus:
    """Refit each hypothesis to its inliers under a shrinking threshold; the one with most wins."""
    reach2 = threshold_px**2
    matrices, growing = hypotheses.copy(), np.arange(len(hypotheses))
    for loosening in _LOOSENING:
        squared = _squared_residuals(matrices[growing], source_xy, reference_xy)
        near = squared < loosening**2 * reach2
        enough = near.sum(axis=1) > SAMPLE_SIZE[kind]
        growing, near = growing[enough], near[enough]
        if not len(growing):
            break
        matrices[growing] = _fitted(source_xy, reference_xy, near.astype(np.float64), kind)
    matrices = matrices[_plausible(matrices)]
    if not len(matrices):
        return _nothing(len(source_xy))
    winner = int(_scores(matrices, source_xy, reference_xy, threshold_px).argmax())
    best = AffineMap.of(matrices[winner])
    return Consensus(best, radial_residuals(best, source_xy, reference_xy) <= threshold_px)


def _fitted(source: FloatArray, reference: FloatArray, weight: FloatArray, kind: str) -> FloatArray:
    """(S, 2, 3) weighted `fit_plainly` of (S, M, 2) points, or of (M, 2) that all S share.

    einsum throughout, for BLAS may round differently from one thread count to another.
    """
    total = weight.sum(axis=1)[:, None]

    def centred(xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        every = np.broadcast_to(xy, (*weight.shape, 2))
        mean = np.einsum("sm,smk->sk", weight, every) / total
        return every - mean[:, None], mean

    (s, source_mean), (r, reference_mean) = centred(source), centred(reference)
    s = s * weight[:, :, None]
    across = np.einsum("smi,smj->sij", s, r)
    normal = np.einsum("smi,smj->sij", s, s)
    if kind == "similarity":
        power = np.maximum(normal[:, 0, 0] + normal[:, 1, 1], np.finfo(np.float64).tiny)
        along = (across[:, 0, 0] + across[:, 1, 1]) / power
        turn = (across[:, 0, 1] - across[:, 1, 0]) / power
        linear = np.stack([np.stack([along, -turn], 1), np.stack([turn, along], 1)], 1)
    else:
        linear = np.matmul(np.linalg.pinv(normal, hermitian=True), across).transpose(0, 2, 1)
    offset = reference_mean - np.einsum("sij,sj->si", linear, source_mean)
    return np.concatenate([linear, offset[:, :, None]], axis=2)
