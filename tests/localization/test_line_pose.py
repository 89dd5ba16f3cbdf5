"""Poses from lines through synthetic keypoints, against the true poses; and lines that must give none."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from bench.localization import line_pose, pose

TRIALS = 2000
SIZE = np.array([640, 480])

Problem = tuple[np.ndarray, np.ndarray, pycolmap.Camera, pycolmap.Rigid3d]


def draw_lines(rng: np.random.Generator, xy: np.ndarray) -> np.ndarray:
    angles = rng.uniform(0, np.pi, len(xy))
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.column_stack([normals, -(normals * xy).sum(axis=1)])


def problem(rng: np.random.Generator, true: int, false: int, noise: float = 0.0, model: str = "SIMPLE_PINHOLE") -> Problem:
    """Lines through keypoints of their points, followed by lines with wrong points."""
    camera = pycolmap.Camera.create_from_model_name(1, model, 520.0, *SIZE)
    camera.params = [value or 0.02 for value in camera.params]
    truth = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(random_state=rng).as_quat()), rng.normal(0, 3, 3))
    xy = rng.uniform(0, 1, (true + false, 2)) * SIZE
    in_camera = np.column_stack([camera.cam_from_img(xy), np.ones(len(xy))]) * rng.uniform(2, 8, (len(xy), 1))
    xyz = truth.inverse() * in_camera
    xyz[true:] = xyz[true:][rng.permutation(false)]
    return draw_lines(rng, xy + rng.normal(0, noise, xy.shape)), xyz, camera, truth


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL"])
def test_exact_lines_give_the_exact_pose(rng: np.random.Generator, model: str) -> None:
    lines, xyz, camera, truth = problem(rng, 60, 0, model=model)
    result = line_pose.estimate(lines, xyz, camera, trials=TRIALS, seed=0)
    assert result is not None
    assert result.inliers.all()
    np.testing.assert_allclose(pose.compute_errors(result.cam_from_world, truth), 0, atol=1e-5)


def test_a_line_beyond_the_lens_model_does_not_hide_the_others(rng: np.random.Generator) -> None:
    """Barrel distortion has a greatest radius. A line across a corner extends to pixels that have no ray."""
    _, _, camera, truth = problem(rng, 1, 0, model="SIMPLE_RADIAL")
    camera.params = [*camera.params[:3], -0.25]
    xy = np.concatenate([[[632, 474]], rng.uniform(0.1, 0.9, (159, 2)) * SIZE])
    xyz = truth.inverse() * (np.column_stack([camera.cam_from_img(xy), np.ones(160)]) * rng.uniform(2, 8, (160, 1)))
    xyz[60:] = xyz[60:][rng.permutation(100)]
    lines = draw_lines(rng, xy)
    lines[0] = 0.8, 0.6, -xy[0] @ (0.8, 0.6)
    assert np.flatnonzero(np.isnan(line_pose._find_planes(lines, camera)[1])).tolist() == [0]
    result = line_pose.estimate(lines, xyz, camera, trials=TRIALS, seed=0)
    assert result is not None
    assert result.inliers[:60].all()
    np.testing.assert_allclose(pose.compute_errors(result.cam_from_world, truth), 0, atol=0.1)


def test_true_lines_are_found_among_wrong_ones(rng: np.random.Generator) -> None:
    lines, xyz, camera, truth = problem(rng, 100, 60, noise=0.5)
    result = line_pose.estimate(lines, xyz, camera, trials=TRIALS, seed=0)
    assert result is not None
    distance, angle = pose.compute_errors(result.cam_from_world, truth)
    assert distance < 0.03
    assert angle < 0.3
    assert result.inliers[:100].all()
    assert result.inliers[100:].mean() < 0.15


@pytest.mark.parametrize("seed", range(5))
def test_wrong_lines_give_no_pose(seed: int) -> None:
    lines, xyz, camera, _ = problem(np.random.default_rng(seed), 0, 150)
    assert line_pose.estimate(lines, xyz, camera, trials=500, seed=0) is None


def test_lines_through_one_pixel_give_no_pose(rng: np.random.Generator) -> None:
    """A camera so far away that all points fall on that pixel has all lines as inliers. It is no evidence."""
    _, xyz, camera, _ = problem(rng, 0, 100)
    lines = draw_lines(rng, np.tile(SIZE / 2, (100, 1)))
    assert line_pose.estimate(lines, xyz, camera, trials=500, seed=0) is None


def test_same_seed_gives_the_same(rng: np.random.Generator) -> None:
    lines, xyz, camera, _ = problem(rng, 40, 40)
    one, other = (line_pose.estimate(lines, xyz, camera, trials=TRIALS, seed=3) for _ in range(2))
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.cam_from_world.matrix(), other.cam_from_world.matrix())


def test_six_lines_are_too_few(rng: np.random.Generator) -> None:
    lines, xyz, camera, _ = problem(rng, 6, 0)
    assert line_pose.estimate(lines, xyz, camera, trials=TRIALS, seed=0) is None
