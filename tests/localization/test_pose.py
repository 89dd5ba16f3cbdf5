"""Poses of synthetic cameras that see synthetic points, against the true poses; and inputs that must fail."""

from copy import deepcopy

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from bench.core.errors import UserError
from bench.localization import pose
from bench.localization.pose import Solver

TRIALS = 2000
SIZE = np.array([640, 480])

Problem = tuple[np.ndarray, np.ndarray, pycolmap.Camera, pycolmap.Rigid3d]


def lens(model: str = "SIMPLE_PINHOLE") -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(1, model, 520.0, *SIZE)
    camera.params = [value or 0.02 for value in camera.params]  # some distortion, where the model has any
    return camera


def problem(
    rng: np.random.Generator, true: int = 60, false: int = 140, model: str = "SIMPLE_PINHOLE", flat: bool = False
) -> Problem:
    """Keypoints half a pixel off their points, followed by keypoints with wrong points."""
    camera = lens(model)
    truth = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(random_state=rng).as_quat()), rng.normal(0, 3, 3))
    xy = rng.uniform(0, 1, (true + false, 2)) * SIZE
    depths = np.full(len(xy), 3.0) if flat else rng.uniform(2, 8, len(xy))
    in_camera = np.column_stack([camera.cam_from_img(xy), np.ones(len(xy))]) * depths[:, None]
    xyz = truth.inverse() * in_camera
    xyz[true:] = xyz[true:][rng.permutation(false)]
    return xy + rng.normal(0, 0.5, xy.shape), xyz, camera, truth


@pytest.mark.parametrize("solver", ["poselib", "pycolmap"])
@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV", "SIMPLE_RADIAL_FISHEYE"])
def test_known_pose_is_found(rng: np.random.Generator, solver: Solver, model: str) -> None:
    xy, xyz, camera, truth = problem(rng, model=model)
    found = pose.estimate(xy, xyz, camera, trials=TRIALS, seed=0, solver=solver)
    assert found is not None
    distance, angle = pose.compute_errors(found.cam_from_world, truth)
    assert distance < 0.03
    assert angle < 0.3
    assert found.inliers[:60].all()
    assert found.inliers[60:].mean() < 0.1
    assert pose.estimate_focal_mismatch(xy, xyz, camera, found) is None


def test_same_seed_gives_the_same(rng: np.random.Generator) -> None:
    xy, xyz, camera, _ = problem(rng, true=8)
    one, other = (pose.estimate(xy, xyz, camera, trials=TRIALS, seed=3) for _ in range(2))
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.cam_from_world.matrix(), other.cam_from_world.matrix())


def test_number_of_trials_is_reported(rng: np.random.Generator) -> None:
    """It is the maximum if nearly no match is right, and the minimum if nearly all are."""
    hopeless, easy = problem(rng, true=0, false=200), problem(rng, true=200, false=1)
    for trials in (500, 5000):
        found = pose.estimate(*hopeless[:3], trials=trials, seed=0)
        assert found is not None
        assert found.trials == trials
    found = pose.estimate(*easy[:3], trials=5000, seed=0)
    assert found is not None
    assert found.trials == pytest.approx(pose.MIN_TRIALS, abs=1)
    found = pose.estimate(*easy[:3], trials=1500, seed=0, solver="pycolmap")
    assert found is not None
    assert found.trials == 1500


@pytest.mark.parametrize("solver", ["poselib", "pycolmap"])
def test_shuffled_matches_localize_nothing(rng: np.random.Generator, solver: Solver) -> None:
    xy, xyz, camera, truth = problem(rng, true=200, false=0)
    found = pose.estimate(xy, xyz[rng.permutation(len(xyz))], camera, trials=TRIALS, seed=0, solver=solver)
    assert found is None or pose.compute_errors(found.cam_from_world, truth)[0] > 0.25


def test_errors_of_the_exact_pose_and_of_known_offsets(rng: np.random.Generator) -> None:
    truth = problem(rng)[3]
    assert pose.compute_errors(truth, truth) == pytest.approx((0.0, 0.0), abs=1e-5)
    moved = pycolmap.Rigid3d(truth.rotation, truth.translation + truth.rotation * np.array([0.3, 0.0, 0.4]))
    assert pose.compute_errors(moved, truth) == pytest.approx((0.5, 0.0), abs=1e-5)
    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.from_euler("y", 7, degrees=True).as_quat()), np.zeros(3)) * truth
    assert pose.compute_errors(turned, truth) == pytest.approx((0.0, 7.0), abs=1e-5)


def test_map_of_twice_the_size_puts_the_camera_elsewhere(rng: np.random.Generator) -> None:
    xy, xyz, camera, truth = problem(rng)
    found = pose.estimate(xy, 2 * xyz, camera, trials=TRIALS, seed=0)
    assert found is not None
    distance, angle = pose.compute_errors(found.cam_from_world, truth)
    assert angle < 0.3
    assert distance == pytest.approx(np.linalg.norm(truth.inverse().translation), rel=0.02)


@pytest.mark.parametrize("factor", [0.7, 0.9, 1.15, 1.5])
def test_wrong_focal_length_is_noticed(rng: np.random.Generator, factor: float) -> None:
    xy, xyz, camera, _ = problem(rng)
    wrong = deepcopy(camera)
    wrong.params = [factor * camera.params[0], *camera.params[1:]]
    found = pose.estimate(xy, xyz, wrong, trials=TRIALS, seed=0)
    assert found is not None
    ratio = pose.estimate_focal_mismatch(xy, xyz, wrong, found)
    assert ratio == pytest.approx(1 / factor, rel=0.02)


def test_plane_that_faces_the_camera_gives_no_focal_length(rng: np.random.Generator) -> None:
    xy, xyz, camera, _ = problem(rng, flat=True)
    wrong = deepcopy(camera)
    wrong.params = [1.2 * camera.params[0], *camera.params[1:]]
    found = pose.estimate(xy, xyz, wrong, trials=TRIALS, seed=0)
    assert found is not None
    assert pose.estimate_focal_mismatch(xy, xyz, wrong, found) is None


@pytest.mark.parametrize("solver", ["poselib", "pycolmap"])
def test_too_few_matches(rng: np.random.Generator, solver: Solver) -> None:
    xy, xyz, camera, _ = problem(rng)
    assert pose.estimate(xy[:3], xyz[:3], camera, trials=TRIALS, seed=0, solver=solver) is None
    assert pose.estimate(xy[:0], xyz[:0], camera, trials=TRIALS, seed=0, solver=solver) is None


def test_points_behind_the_camera_are_infinitely_far(rng: np.random.Generator) -> None:
    xy, xyz, camera, truth = problem(rng, true=20, false=0)
    behind = truth.inverse() * ((truth * xyz) * [1, 1, -1])
    assert np.isinf(pose.compute_reprojection_errors(truth, camera, xy, behind)).all()
    assert (pose.compute_reprojection_errors(truth, camera, xy, xyz) < 3).all()


def test_unknown_solver_is_refused(rng: np.random.Generator) -> None:
    with pytest.raises(UserError, match="unknown solver 'opencv'"):
        pose.estimate(*problem(rng)[:3], trials=1, seed=0, solver="opencv")  # type: ignore[arg-type]
