"""Structure from motion: a server's model of a scene, built from releases alone (the paper's supplement, Table S2).

All images are privatised. Two keypoints match by words, by mutually nearest descriptors, or by mutually nearest subspaces.
`bench/sfm/` verifies the pairs of images and builds the model.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np

from bench.api import Attack, Dataset, Defense, Extractor
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.datasets.walk import Walk
from bench.images import samples
from bench.images.samples import Collection, Images, Sample
from bench.images.scene import SceneImage
from bench.localization import two_view_matching
from bench.sfm import agreement, incremental_mapping, picture, verification
from bench.sfm.incremental_mapping import Mapper, Model
from bench.task_api import Outcome, Task, Trial
from bench.types import Descriptors, Release, Subspaces, WordSets

if TYPE_CHECKING:
    import pycolmap

# How word sets match: by words that both images release and that are unique in each, by all words that both release, or by
# words with mutually nearest descriptors.
Matching = Literal["unique-words", "words", "descriptors"]


@dataclass(frozen=True, kw_only=True)
class Structure(Task):
    """Size and accuracy of the model that structure from motion builds from releases of a scene's queries.

    References, if there are any, serve the dictionary alone.
    """

    judges_attacks: ClassVar[bool] = False
    needs_scene: ClassVar[bool] = True

    images: int = 25  # largest number of queries, the first ones of the scene
    ratio: float = 0.8  # of Lowe's test among descriptors; 1 disables it
    mapper: Mapper = "global"
    matching: Matching = "unique-words"  # of word sets

    def __post_init__(self) -> None:
        if self.images < incremental_mapping.MIN_IMAGES:
            raise UserError(f"structure: images must be at least {incremental_mapping.MIN_IMAGES}, got {self.images}")
        if not 0 < self.ratio <= 1:
            raise UserError(f"structure: ratio must be above 0 and at most 1, got {self.ratio}")
        if self.mapper not in ("incremental", "global"):
            raise UserError(f"structure: mapper must be incremental or global, got {self.mapper}")
        if self.matching not in get_args(Matching):
            raise UserError(f"structure: matching must be one of {', '.join(get_args(Matching))}, got {self.matching}")

    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        if images is not None:
            raise UserError("structure takes a dataset and no images; give --dataset, such as captured:path=DIR,leading=25")
        scene = (dataset or Walk()).scene()
        queries = scene.queries[: self.images]
        if len(queries) < incremental_mapping.MIN_IMAGES:
            raise UserError(f"{scene.name}: {len(queries)} queries; structure needs at least {incremental_mapping.MIN_IMAGES}")
        for image in queries:
            if _intrinsics_key(image.camera) != _intrinsics_key(queries[0].camera):
                raise UserError(
                    f"{scene.name}: {queries[0].name} and {image.name} have different cameras; structure needs one camera"
                )
        sample = Sample(name=scene.name, images=tuple(image.pixels for image in queries), subject=queries)
        return Collection(
            name=scene.name, samples=(sample,), scene=scene, extra_inputs={"scene": samples.hash_scene_images(queries)}
        )

    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        if issubclass(defense.releases, (Descriptors, Subspaces, WordSets)):
            return None
        return f"nothing matches {defense.releases.__name__}"

    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        return {}

    def evaluate(self, trial: Trial) -> Outcome:
        images: tuple[SceneImage, ...] = trial.sample.subject
        releases = [shot.release for shot in trial.images]
        keypoints = [release.keypoints for release in releases]
        camera, seed = images[0].camera, int(trial.rng.integers(2**31))
        matches = {(a, b): self._match(releases[a], releases[b]) for a, b in itertools.combinations(range(len(releases)), 2)}
        geometries = verification.verify_pairs(camera, keypoints, matches, seed)
        model = incremental_mapping.build_model(camera, keypoints, geometries, self.mapper, seed)
        counts = {
            "images": float(len(images)),
            "tried_matches": float(np.mean([len(pairs) for pairs in matches.values()])),
            "verified_pairs": float(len(geometries)),
            "verified_matches": float(sum(len(geometry.matches) for geometry in geometries.values())),
        }
        return Outcome(
            metrics={**compute_metrics(model, [image.cam_from_world for image in images]), **counts},
            image=None if model is None else picture.draw_from_above(model),
        )

    def _match(self, first: Release, second: Release) -> np.ndarray:
        try:
            # No ratio test for subspaces: the distances to the nearest and the second nearest are about equal.
            ratio = 1.0 if isinstance(first, Subspaces) else self.ratio
            if self.matching == "descriptors" and isinstance(first, WordSets) and isinstance(second, WordSets):
                return two_view_matching.match_by_word_descriptors(first, second, ratio)
            return two_view_matching.match_releases(first, second, ratio, unique=self.matching == "unique-words")
        except TypeError as error:
            raise SampleError(str(error)) from None


def compute_metrics(model: Model | None, truth: Sequence[pycolmap.Rigid3d | None]) -> dict[str, float | None]:
    """Return the paper's four measures, and the number of images with a correct pose, which is None if poses are withheld.

    Parameters
    ----------
    model : None if no model was built
    truth : cam_from_world of every image
    """
    poses = [pose for pose in truth if pose is not None]
    if model is None:
        return {
            "registered": 0.0,
            "points": 0.0,
            "track_length": None,
            "reprojection_error": None,
            "right_poses": 0.0 if len(poses) == len(truth) else None,
        }
    return {
        "registered": float(len(model.images)),
        "points": float(len(model.points)),
        "track_length": model.track_length,
        "reprojection_error": model.reprojection_error,
        "right_poses": float(agreement.count_correct_poses(model, poses)) if len(poses) == len(truth) else None,
    }


def _intrinsics_key(camera: pycolmap.Camera) -> tuple[Any, ...]:
    return camera.model, camera.width, camera.height, tuple(camera.params)


PLUGIN = Structure
