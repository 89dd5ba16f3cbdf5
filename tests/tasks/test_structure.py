"""Structure from motion must recover the cameras of a synthetic scene, and build nothing from accidental matches."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from fakes import build_trial, write_scene
from scipy.spatial.transform import Rotation

from bench.api import Dataset, Defense
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.datasets.gallery import Gallery
from bench.datasets.walk import Walk
from bench.images.scene import File, Scene, SceneImage
from bench.settings import Asset
from bench.sfm import agreement, consistency, incremental_mapping, picture, verification
from bench.sfm.incremental_mapping import Mapper, Model
from bench.sfm.verification import Pair
from bench.task_api import Outcome
from bench.tasks.structure import Structure, compute_metrics
from bench.testing import build_image
from bench.types import Features, Indices
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

CAMERA = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480)
VIEWS, POINTS, ACCIDENTS = 5, 240, 1500


@pytest.fixture(scope="module", autouse=True)
def few_trials() -> Iterator[None]:
    """Enough trials of RANSAC for these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verification, "TRIALS", 2_000)
        yield


@pytest.fixture(scope="module")
def poses() -> list[pycolmap.Rigid3d]:
    """Cameras on an arc around the points, 8 metres away."""
    angles = np.linspace(-0.35, 0.35, VIEWS)
    turns = [Rotation.from_euler("yx", [angle, 0.05 * np.sin(9 * angle)]).as_quat() for angle in angles]
    return [pycolmap.Rigid3d(pycolmap.Rotation3d(turn), [0.02 * number, 0, 8]) for number, turn in enumerate(turns)]


@pytest.fixture(scope="module")
def keypoints(poses: list[pycolmap.Rigid3d]) -> list[np.ndarray]:
    """Projections of the points: keypoint i of every image is point i. (POINTS, 2) each"""
    rng = np.random.default_rng(1)
    plane = rng.uniform([-3, -2], [3, 2], (POINTS, 2))
    depth = 1.5 * np.sin(plane[:, :1]) + rng.normal(0, 0.05, (POINTS, 1))
    points = np.concatenate([plane, depth], axis=1)
    projections = [CAMERA.img_from_cam(points @ pose.rotation.matrix().T + pose.translation) for pose in poses]
    return [(np.asarray(each) + rng.normal(0, 0.2, (POINTS, 2))).astype(np.float32) for each in projections]


@pytest.fixture(scope="module")
def matches() -> dict[Pair, Indices]:
    """A quarter of the true matches, among many accidental ones."""
    rng = np.random.default_rng(2)
    found = {}
    for pair in itertools.combinations(range(VIEWS), 2):
        true = np.repeat(np.flatnonzero(rng.random(POINTS) < 0.25)[:, None], 2, axis=1)
        found[pair] = np.unique(np.concatenate([true, rng.integers(0, POINTS, (ACCIDENTS, 2))]), axis=0)
    return found


def shuffle(matches: Mapping[Pair, Indices]) -> dict[Pair, Indices]:
    rng = np.random.default_rng(3)
    return {pair: np.stack([rows[:, 0], rng.permutation(rows[:, 1])], axis=1) for pair, rows in matches.items()}


def is_true(rows: Indices) -> np.ndarray:
    return rows[:, 0] == rows[:, 1]


def test_support_by_enumeration(rng: np.random.Generator) -> None:
    first, second = rng.uniform(0, 100, (2, 50, 2))
    moved = second - first
    near = (np.abs(first[:, None] - first[None]) <= 30).all(axis=2)
    similar = (np.abs(moved[:, None] - moved[None]) <= 40).all(axis=2)
    expected = (near & similar).sum(axis=1) - 1
    assert consistency.count_support(first, second, 30, 40).tolist() == expected.tolist()
    assert len(set(expected.tolist())) > 2


def test_matches_that_support_trusted_ones_by_enumeration(rng: np.random.Generator) -> None:
    first, second = rng.uniform(0, 100, (2, 50, 2))
    trusted, moved = np.array([3, 17, 41]), second - first
    near = (np.abs(first[:, None] - first[trusted]) <= consistency.NEAR * 300).all(axis=2)
    similar = (np.abs(moved[:, None] - moved[trusted]) <= consistency.SIMILAR * 300).all(axis=2)
    near[trusted, range(3)] = False
    assert (
        consistency.find_supported(first, second, trusted, 300).tolist() == np.flatnonzero((near & similar).any(axis=1)).tolist()
    )


def test_true_matches_are_found_among_accidental_ones(keypoints: list[np.ndarray], matches: dict[Pair, Indices]) -> None:
    rows = matches[2, 3]
    assert is_true(rows).mean() < 0.05
    left = consistency.select_consistent(
        keypoints[2][rows[:, 0]].astype(float), keypoints[3][rows[:, 1]].astype(float), 640, 80, np.random.default_rng(0)
    )
    assert is_true(rows[left]).sum() > 0.8 * is_true(rows).sum()
    assert len(left) < 0.15 * len(rows)


def test_clean_matches_are_all_selected(keypoints: list[np.ndarray]) -> None:
    every = np.arange(POINTS)
    first, second = (keypoints[image].astype(float) for image in (2, 3))
    assert consistency.select_consistent(first, second, 640, 80, np.random.default_rng(0)).tolist() == every.tolist()


@pytest.fixture(scope="module")
def geometries(keypoints: list[np.ndarray], matches: dict[Pair, Indices]) -> dict[Pair, verification.Geometry]:
    return verification.verify_pairs(CAMERA, keypoints, matches, 0)


@pytest.mark.slow
def test_estimated_geometry_is_the_true_one(geometries: dict[Pair, verification.Geometry], poses: list[pycolmap.Rigid3d]) -> None:
    assert len(geometries) > 0.8 * VIEWS * (VIEWS - 1) / 2
    true = {(a, b): (poses[b] * poses[a].inverse()).rotation for a, b in geometries}
    turns = np.degrees([true[pair].angle_to(found.second_from_first.rotation) for pair, found in geometries.items()])
    assert np.median(turns) < 2
    assert (turns < 5).mean() > 0.8
    assert np.median([is_true(found.matches).mean() for found in geometries.values()]) > 0.7


@pytest.mark.slow
def test_threads_and_repetition_change_nothing(
    geometries: dict[Pair, verification.Geometry], keypoints: list[np.ndarray], matches: dict[Pair, Indices]
) -> None:
    alone = verification.verify_pairs(CAMERA, keypoints, matches, 0, threads=1)
    assert list(alone) == list(geometries)
    for pair, found in alone.items():
        np.testing.assert_array_equal(found.matches, geometries[pair].matches)
        np.testing.assert_array_equal(found.essential, geometries[pair].essential)


@pytest.mark.slow
def test_shuffled_matches_have_no_geometry(keypoints: list[np.ndarray], matches: dict[Pair, Indices]) -> None:
    """Negative control."""
    found = verification.verify_pairs(CAMERA, keypoints, shuffle(matches), 0)
    assert len(found) <= 2
    assert incremental_mapping.build_model(CAMERA, keypoints, found, "global", 0) is None


@pytest.mark.slow
@pytest.mark.parametrize("mapper", ["global", "incremental"])
def test_the_mapped_cameras_are_the_true_ones(
    mapper: Mapper, geometries: dict[Pair, verification.Geometry], keypoints: list[np.ndarray], poses: list[pycolmap.Rigid3d]
) -> None:
    model = incremental_mapping.build_model(CAMERA, keypoints, geometries, mapper, 0)
    again = incremental_mapping.build_model(CAMERA, keypoints, geometries, mapper, 0)
    assert model is not None
    assert again is not None
    assert len(model.images) == VIEWS == agreement.count_correct_poses(model, poses)
    assert len(model.points) > 60
    assert model.reprojection_error < 1
    np.testing.assert_array_equal(model.points, again.points)
    np.testing.assert_array_equal(model.centres, again.centres)
    mirrored = [pycolmap.Rigid3d(pose.rotation.inverse(), pose.translation * [-1, 1, 1]) for pose in poses]
    assert agreement.count_correct_poses(model, mirrored) < 3  # negative control: other cameras


def build_model(poses: list[pycolmap.Rigid3d]) -> Model:
    points = np.random.default_rng(0).normal(size=(50, 3))
    return Model(images=tuple(range(len(poses))), poses=tuple(poses), points=points, observations=150, reprojection_error=0.5)


def test_agreement_is_up_to_a_similarity(poses: list[pycolmap.Rigid3d]) -> None:
    moved = pycolmap.Sim3d(3.0, pycolmap.Rotation3d(Rotation.from_euler("xyz", [1, 2, 3]).as_quat()), [5, -2, 9])
    found = [moved.transform_camera_world(pose) for pose in poses]
    assert agreement.count_correct_poses(build_model(found), poses) == VIEWS
    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.from_euler("z", 0.2).as_quat()), [0, 0, 0])
    found[0] = turned * found[0]  # at its true position, but in another direction
    found[4] = pycolmap.Rigid3d(found[4].rotation, found[4].translation + 6)
    assert agreement.count_correct_poses(build_model(found), poses) == VIEWS - 2


def test_measures(poses: list[pycolmap.Rigid3d]) -> None:
    found = compute_metrics(build_model(poses), poses)
    assert found == {"registered": 5, "points": 50, "track_length": 3, "reprojection_error": 0.5, "right_poses": 5}
    assert compute_metrics(build_model(poses), [*poses[:4], None])["right_poses"] is None
    nothing = {"registered": 0, "points": 0, "track_length": None, "reprojection_error": None, "right_poses": 0}
    assert compute_metrics(None, poses) == nothing


def test_picture_shows_points_and_cameras(poses: list[pycolmap.Rigid3d]) -> None:
    image = picture.draw_from_above(build_model(poses))
    assert image.shape == (picture.SIDE, picture.SIDE, 3)
    assert image.dtype == np.float32
    assert 0 <= image.min() < image.max() <= 1
    red = (image[..., 0] - image[..., 1] > 0.3).nonzero()
    grey = (np.ptp(image, axis=2) < 0.05) & (image[..., 0] < 0.8)
    assert red[0].mean() > grey.nonzero()[0].mean()  # the points are farther up the page than the cameras


def evaluate(defense: Defense, poses: list[pycolmap.Rigid3d], keypoints: list[np.ndarray], independent: bool = False) -> Outcome:
    """Evaluate images whose keypoint i has the same descriptor in all images, or independent ones."""
    base = build_trial(defense, draw_features(POINTS))
    shots = []
    for number, each in enumerate(keypoints):
        secret: Features = replace(draw_features(POINTS, seed=number * independent), keypoints=each, size=(640, 480))
        shots.append(build_image(secret, defense.protect(secret, Public(), np.random.default_rng(number))))
    nowhere = File(path=Path("none"), size=(640, 480))
    images = [
        SceneImage(name=f"{number}", camera=CAMERA, cam_from_world=pose, condition="day", pixels=nowhere)
        for number, pose in enumerate(poses)
    ]
    return Structure().evaluate(replace(base, sample=replace(base.sample, subject=tuple(images)), images=tuple(shots)))


@pytest.fixture
def words(tmp_path: Path) -> Asset:
    return write_dictionary(tmp_path, 20_000)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["none", "ldp", "affine"])
def test_releases_are_mapped(name: str, words: Asset, poses: list[pycolmap.Rigid3d], keypoints: list[np.ndarray]) -> None:
    defense: Defense = {
        "none": Undefended(),
        "ldp": LDP(dictionary=words, epsilon=8.0, subset_size=8),
        "affine": Affine(database=words, dim=2),
    }[name]
    outcome = evaluate(defense, poses, keypoints)
    assert outcome.metrics["registered"] == outcome.metrics["right_poses"] == VIEWS
    assert outcome.image is not None


@pytest.mark.slow
def test_independent_descriptors_are_not_mapped(words: Asset, poses: list[pycolmap.Rigid3d], keypoints: list[np.ndarray]) -> None:
    """Negative control: each image has other descriptors."""
    outcome = evaluate(LDP(dictionary=words, epsilon=8.0, subset_size=8), poses, keypoints, independent=True)
    assert outcome.metrics["registered"] == outcome.metrics["right_poses"] == 0
    assert outcome.image is None


@pytest.mark.slow
def test_no_privacy_budget_no_model(words: Asset, poses: list[pycolmap.Rigid3d], keypoints: list[np.ndarray]) -> None:
    """Negative control: at ε = 0 words are random."""
    outcome = evaluate(LDP(dictionary=words, epsilon=0.0, subset_size=8), poses, keypoints)
    assert outcome.metrics["registered"] == 0


@pytest.mark.slow
def test_references_of_the_walk_exclude_the_stretch() -> None:
    found = Walk(views=5, others=30, steps=40, detail=0.1).scene()
    numbers = [int(image.name[-8:-4]) for image in found.queries]
    assert numbers == list(range(numbers[0], numbers[0] + 5))
    assert len({image.name for image in found.references}) == 30
    assert not {image.name for image in found.references} & {image.name for image in found.queries}
    assert all(image.name.startswith("db/courtyard-1") for image in found.queries)


@pytest.mark.slow
def test_the_task_takes_the_first_queries_of_a_scene() -> None:
    walk = Walk(views=5, others=3, steps=40, detail=0.1)
    collection = Structure(images=4).collect(None, walk)
    assert [len(sample.images) for sample in collection.samples] == [4]
    assert collection.scene is not None
    assert len(collection.scene.references) == 3


class Fixed(Dataset):
    """A given scene."""

    def __init__(self, fixed_scene: Scene) -> None:
        self._scene = fixed_scene

    def scene(self) -> Scene:
        return self._scene


def test_invalid_settings_and_inputs_are_refused(tmp_path: Path) -> None:
    for wrong in ({"images": 2}, {"ratio": 0.0}, {"ratio": float("nan")}, {"mapper": "hierarchical"}):
        with pytest.raises(UserError, match=r"structure: .* must be"):
            Structure(**wrong)
    for wrong in ({"views": 1}, {"others": 0}, {"start": 1.5}, {"views": 300, "others": 100}):
        with pytest.raises(UserError, match="walk: "):
            Walk(**wrong)
    with pytest.raises(UserError, match="matching must be one of unique-words, words, descriptors, got sift"):
        Structure(matching="sift")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="takes a dataset and no images"):
        Structure().collect(tmp_path, None)
    with pytest.raises(UserError, match="2 queries; structure needs at least 3"):
        Structure().collect(None, Fixed(write_scene(tmp_path, queries=2)))
    with pytest.raises(UserError, match="have different cameras"):
        Structure().collect(None, Gallery(views=2, queries=12, rooms=1, detail=0.1))
