"""Verification of image pairs: an essential matrix by RANSAC, among the consistent matches.

If nearly all matches are accidental, some of them agree with any result of RANSAC. To measure their number, some pairs are also
verified with shuffled matches. A geometry counts if a larger fraction of matches agrees with it than in every shuffled pair.
Finally all matches are tested again. A match counts if it agrees with the geometry and has a displacement similar to that of a
nearby inlier.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.core.progress import Progress
from bench.sfm.consistency import Doubles, find_supported, select_consistent
from bench.types import Floats, Indices

if TYPE_CHECKING:
    import pycolmap

MAX_ERROR = 3.0  # pixels off the epipolar line, in COLMAP's Sampson error
TRIALS = 10_000  # of RANSAC
CONFIDENCE = 0.9999
MIN_CONSISTENT = 100  # least number of selected consistent matches, unless there are fewer matches
MIN_MATCHES = 15  # least number of inliers of a geometry, as in COLMAP
SAMPLE = 5  # matches that RANSAC fits, which agree in any case
SHUFFLED_PAIRS = 32  # approximate number of pairs with shuffled matches

Pair = tuple[int, int]
Matches = Mapping[Pair, Indices]  # images a < b -> (M, 2) keypoints of a, of b


@dataclass(frozen=True, kw_only=True, eq=False)
class Geometry:
    """The relative pose of two images, and their matches."""

    matches: Indices  # (M, 2) matches that agree with the pose
    essential: Doubles  # (3, 3)
    second_from_first: pycolmap.Rigid3d  # the translation has no length
    rate: float  # fraction of the consistent matches that agree, without the sample that RANSAC fits


def verify_pairs(
    camera: pycolmap.Camera, keypoints: Sequence[Floats], matches: Matches, seed: int, threads: int = 2
) -> dict[Pair, Geometry]:
    """Return the pairs whose geometry exceeds chance, in the order of `matches`.

    Parameters
    ----------
    camera : of all images
    keypoints : (N, 2) of each image
    threads : number of threads; the result does not depend on it
    """
    pairs = [pair for pair, rows in matches.items() if len(rows) >= MIN_MATCHES]
    sample = pairs[:: max(1, len(pairs) // SHUFFLED_PAIRS)]

    def estimate(job: tuple[Pair, bool]) -> Geometry | None:
        (a, b), shuffle = job
        rng = np.random.default_rng([seed, a, b, int(shuffle)])
        rows = matches[a, b]
        if shuffle:
            rows = np.stack([rows[:, 0], rng.permutation(rows[:, 1])], axis=1)
        return estimate_geometry(camera, keypoints[a], keypoints[b], rows, rng)

    jobs = [(pair, True) for pair in sample] + [(pair, False) for pair in pairs]
    with ThreadPoolExecutor(threads) as pool, Progress("pairs of images", len(jobs)) as progress:
        geometries = []
        for geometry in pool.map(estimate, jobs):
            geometries.append(geometry)
            progress.advance()
    chance = max((each.rate for each in geometries[: len(sample)] if each is not None), default=0.0)
    estimates = zip(pairs, geometries[len(sample) :], strict=True)
    return {pair: each for pair, each in estimates if each is not None and each.rate > chance}


def estimate_geometry(
    camera: pycolmap.Camera, first: Floats, second: Floats, matches: Indices, rng: np.random.Generator
) -> Geometry | None:
    """Return the geometry with which most of the consistent matches agree; None if too few agree.

    Parameters
    ----------
    first, second : (N, 2), (N', 2) keypoints
    matches : (M, 2)
    """
    import pycolmap

    a, b = first[matches[:, 0]].astype(np.float64), second[matches[:, 1]].astype(np.float64)  # (M, 2) pixels
    longer = float(max(camera.width, camera.height))
    consistent = select_consistent(a, b, longer, MIN_CONSISTENT, rng)
    # With a large min_inlier_ratio, RANSAC would stop before TRIALS.
    options = pycolmap.RANSACOptions(
        max_error=MAX_ERROR,
        max_num_trials=TRIALS,
        min_inlier_ratio=0.01,
        confidence=CONFIDENCE,
        random_seed=int(rng.integers(2**31)),
    )
    report = pycolmap.estimate_essential_matrix(a[consistent], b[consistent], camera, camera, options)
    if report is None or report["num_inliers"] < MIN_MATCHES:
        return None
    inliers = consistent[report["inlier_mask"]]
    near = find_supported(a, b, inliers, longer)
    near = near[_compute_errors(camera, a[near], b[near], report["E"]) <= MAX_ERROR]
    return Geometry(
        matches=matches[np.union1d(inliers, near)],
        essential=np.asarray(report["E"]),
        second_from_first=report["cam2_from_cam1"],
        rate=(len(inliers) - SAMPLE) / (len(consistent) - SAMPLE),
    )


def _compute_errors(camera: pycolmap.Camera, first: Doubles, second: Doubles, essential: Doubles) -> Doubles:
    """Return Sampson errors in pixels. (M, 2), (M, 2) pixels -> (M,)"""
    import pycolmap

    if len(first) == 0:
        return np.empty(0)
    a, b = (np.asarray(camera.cam_from_img(points)) for points in (first, second))
    squared = np.asarray(pycolmap.compute_squared_sampson_error(a, b, essential))
    return np.sqrt(squared) * float(camera.mean_focal_length())
