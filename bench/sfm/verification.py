"""Which pairs of images see the same thing, and by which matches: an essential matrix by RANSAC, among the consistent matches.

Where nearly all matches are accidents, some agree with whatever RANSAC finds. How many is measured, not assumed: the same is
done for some of the pairs with their matches shuffled, and a geometry counts if a larger share agrees with it than with any of
those. Then every match is looked at again: it is kept if it agrees with the geometry and moves like one that was found with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pycolmap

from bench.core.progress import Progress
from bench.sfm.consistency import Doubles, consistent, supported
from bench.types import Floats, Indices

ERROR = 3.0  # pixels off the epipolar line, in COLMAP's Sampson error
TRIALS = 10_000  # of RANSAC
CONFIDENCE = 0.9999
FEWEST = 100  # matches that are left, if there are as many
LEAST = 15  # matches that a geometry rests on, COLMAP's own bound
SAMPLE = 5  # matches that RANSAC fits: they agree in any case
SHUFFLED = 32  # pairs whose matches are shuffled, about

Pair = tuple[int, int]
Matches = Mapping[Pair, Indices]  # images a < b -> (M, 2) keypoints of a, of b


@dataclass(frozen=True, kw_only=True, eq=False)
class Geometry:
    """Two images and what they have in common."""

    matches: Indices  # (M, 2) that agree
    essential: Doubles  # (3, 3)
    second_from_first: pycolmap.Rigid3d  # the translation has no length
    rate: float  # share of the consistent matches that agreed, those aside that RANSAC fitted


def verified(
    camera: pycolmap.Camera, keypoints: Sequence[Floats], matches: Matches, seed: int, threads: int = 2
) -> dict[Pair, Geometry]:
    """The pairs whose geometry is more than chance, in the order of `matches`.

    Parameters
    ----------
    camera : of all images
    keypoints : (N, 2) of each image
    threads : at once; the result does not depend on it
    """
    enough = [pair for pair, found in matches.items() if len(found) >= LEAST]
    sample = enough[:: max(1, len(enough) // SHUFFLED)]

    def judged(job: tuple[Pair, bool]) -> Geometry | None:
        (a, b), shuffle = job
        rng = np.random.default_rng([seed, a, b, int(shuffle)])
        found = matches[a, b]
        if shuffle:
            found = np.stack([found[:, 0], rng.permutation(found[:, 1])], axis=1)
        return geometry(camera, keypoints[a], keypoints[b], found, rng)

    jobs = [(pair, True) for pair in sample] + [(pair, False) for pair in enough]
    with ThreadPoolExecutor(threads) as pool, Progress("pairs of images", len(jobs)) as progress:
        found = []
        for each in pool.map(judged, jobs):
            found.append(each)
            progress.advance()
    chance = max((each.rate for each in found[: len(sample)] if each is not None), default=0.0)
    return {
        pair: each for pair, each in zip(enough, found[len(sample) :], strict=True) if each is not None and each.rate > chance
    }


def geometry(
    camera: pycolmap.Camera, first: Floats, second: Floats, matches: Indices, rng: np.random.Generator
) -> Geometry | None:
    """The geometry that most of the consistent matches agree with; None if they are too few.

    Parameters
    ----------
    first, second : (N, 2), (N', 2) keypoints
    matches : (M, 2)
    """
    a, b = first[matches[:, 0]].astype(np.float64), second[matches[:, 1]].astype(np.float64)  # (M, 2) pixels
    longer = float(max(camera.width, camera.height))
    kept = consistent(a, b, longer, FEWEST, rng)
    # RANSAC stops before its trials where it takes a share of inliers for granted; it shall not.
    options = pycolmap.RANSACOptions(
        max_error=ERROR,
        max_num_trials=TRIALS,
        min_inlier_ratio=0.01,
        confidence=CONFIDENCE,
        random_seed=int(rng.integers(2**31)),
    )
    found = pycolmap.estimate_essential_matrix(a[kept], b[kept], camera, camera, options)
    if found is None or found["num_inliers"] < LEAST:
        return None
    agreeing = kept[found["inlier_mask"]]
    near = supported(a, b, agreeing, longer)
    near = near[_errors(camera, a[near], b[near], found["E"]) <= ERROR]
    return Geometry(
        matches=matches[np.union1d(agreeing, near)],
        essential=np.asarray(found["E"]),
        second_from_first=found["cam2_from_cam1"],
        rate=(len(agreeing) - SAMPLE) / (len(kept) - SAMPLE),
    )


def _errors(camera: pycolmap.Camera, first: Doubles, second: Doubles, essential: Doubles) -> Doubles:
    """Sampson errors in pixels. (M, 2), (M, 2) pixels -> (M,)"""
    if len(first) == 0:
        return np.empty(0)
    a, b = (np.asarray(camera.cam_from_img(points)) for points in (first, second))
    squared = np.asarray(pycolmap.compute_squared_sampson_error(a, b, essential))
    return np.sqrt(squared) * float(camera.mean_focal_length())
