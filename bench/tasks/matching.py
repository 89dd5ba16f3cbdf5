"""Matching: accuracy of a server's matches between two views of a plane, with one or both views privatised.

H is the homography from the first image to the second. The error of a match (i, j) is |H x_i − x_j| pixels. A match is correct if
its error is below `MAX_ERROR`. A true correspondence of a keypoint is a keypoint of the second image at an error below
`MAX_ERROR`.

- mean matching accuracy at t: the fraction of matches with an error below t;
- precision: the fraction of correct matches, which is the accuracy at `MAX_ERROR`;
- recall: the fraction of the first image's keypoints with a true correspondence that have a correct match.

Without any match all are zero. Sources: Mikolajczyk and Schmid, PAMI 2005; Dusmanu et al., CVPR 2019.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bench.api import Attack, Dataset, Defense, Extractor
from bench.codebook.public import Public
from bench.core import hashing
from bench.core.errors import SampleError, UserError
from bench.images.samples import Collection, Images, Sample
from bench.images.scene import File, Pixels
from bench.localization import two_view_matching
from bench.rendering import homographies
from bench.rendering.homographies import Pair
from bench.task_api import Outcome, Task, Trial
from bench.types import Descriptors, Floats, Indices, Subspaces, WordSets

Doubles = NDArray[np.float64]

MAX_ERROR = 3.0  # pixels
ACCURACY_LIMITS = range(1, 11)  # pixels
SEED = 0  # of the rendered pairs


@dataclass(frozen=True, kw_only=True)
class Matching(Task):
    """Accuracy of matches between two views of a plane: rendered views of the built-in photographs, or a folder of HPatches.

    The first image is privatised; the second only with `both`.
    """

    judges_attacks: ClassVar[bool] = False

    both: bool = False  # whether the second image is privatised too
    ratio: float = 1.0  # of Lowe's test, for mutually nearest pairs; 1 disables it
    each: int = 4  # pairs per built-in photograph

    def __post_init__(self) -> None:
        if not 0 < self.ratio <= 1:
            raise UserError(f"matching: ratio must be above 0 and at most 1, got {self.ratio}")
        if self.each < 1:
            raise UserError(f"matching: each must be at least 1, got {self.each}")

    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        if dataset is not None:
            raise UserError("matching takes pairs of images, not a dataset; give --images with a folder of HPatches")
        if images is None:
            return _build_collection("pairs", homographies.create_pairs(SEED, self.each))
        if not isinstance(images, (str, Path)):
            raise UserError("matching takes pairs of images; give a folder of HPatches")
        root = Path(images)
        pairs = homographies.load_hpatches(root)
        named = [replace(pair, first=_name_file(pair.first, root), second=_name_file(pair.second, root)) for pair in pairs]
        return _build_collection(root.resolve().name, named)

    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        if issubclass(defense.releases, (Descriptors, Subspaces, WordSets)):
            return None
        return f"nothing matches {defense.releases.__name__}"

    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        return {}

    def evaluate(self, trial: Trial) -> Outcome:
        pair = trial.sample.subject
        if not isinstance(pair, Pair):
            raise SampleError("matching needs a pair of images with a homography")
        query, reference = trial.images
        second = (
            reference.release
            if self.both
            else two_view_matching.prepare_unprotected(reference.secret, trial.defense, trial.public)
        )
        matches = two_view_matching.match_releases(query.release, second, self.ratio)
        return Outcome(metrics=compute_accuracy(query.release.keypoints, second.keypoints, pair.homography, matches))


def _name_file(image: Pixels, root: Path) -> Pixels:
    """Return the image with its file's name below `root`, by which stored features are found."""
    return replace(image, name=image.path.relative_to(root).as_posix()) if isinstance(image, File) else image


def compute_accuracy(first: Floats, second: Floats, homography: Doubles, matches: Indices) -> dict[str, float | None]:
    """Return the metrics defined at the top of this file; recall is None if no keypoint has a true correspondence.

    Parameters
    ----------
    first, second : (N, 2), (N', 2) keypoints
    homography : (3, 3) from the first image to the second
    matches : (M, 2)
    """
    from scipy.spatial import cKDTree

    expected = transfer(first, homography)  # (N, 2)
    errors = np.linalg.norm(expected[matches[:, 0]] - second[matches[:, 1]], axis=1)  # (M,)
    possible = np.zeros(len(first), dtype=bool)
    finite = np.isfinite(expected).all(axis=1)
    possible[finite] = cKDTree(second).query(expected[finite])[0] < MAX_ERROR
    correct = np.zeros(len(first), dtype=bool)
    correct[matches[errors < MAX_ERROR, 0]] = True
    return {
        "precision": _compute_fraction(errors < MAX_ERROR),
        "recall": float(correct[possible].mean()) if possible.any() else None,
        **{f"mma_{t:02}px": _compute_fraction(errors < t) for t in ACCURACY_LIMITS},
        "matches": float(len(matches)),
        "correspondences": float(possible.sum()),
    }


def transfer(points: Floats, homography: Doubles) -> Doubles:
    """Return points of the first image in the second; infinite on and beyond the horizon. (N, 2) -> (N, 2)"""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1, dtype=np.float64) @ homography.T  # (N, 3)
    depth = np.where(homogeneous[:, 2:] > 0, homogeneous[:, 2:], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(depth > 0, homogeneous[:, :2] / depth, np.inf)


def _compute_fraction(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if len(flags) else 0.0


def _build_collection(name: str, pairs: Sequence[Pair]) -> Collection:
    homographies_of = {pair.name: pair.homography.tolist() for pair in pairs}
    return Collection(
        name=name,
        samples=tuple(Sample(name=pair.name, images=(pair.first, pair.second), subject=pair) for pair in pairs),
        extra_inputs={"homographies": hashing.digest(homographies_of)},
    )


PLUGIN = Matching
