"""Positions recovered from lines: against a brute-force search, and on photographs with the true neighbours."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bench.extractors.sift import Sift
from bench.geometry.lines import clip_lines
from bench.images import photographs
from bench.positions.neighbourhood import find_densest, recover_positions

SIZE = (200, 120)


def draw_lines(rng: np.random.Generator, xy: np.ndarray, axes: bool = False) -> np.ndarray:
    angles = rng.integers(0, 2, len(xy)) * np.pi / 2 if axes else rng.uniform(0, np.pi, len(xy))
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.column_stack([normals, -(normals * xy).sum(axis=1)])


def find_neighbours(xy: np.ndarray, count: int) -> np.ndarray:
    return cKDTree(xy).query(xy, count + 1)[1][:, 1:]


def test_the_ends_lie_on_the_line_and_on_the_border(rng: np.random.Generator) -> None:
    lines = draw_lines(rng, rng.uniform(0, 1, (50, 2)) * SIZE)
    clipped = clip_lines(lines, SIZE)
    for end in (clipped.first, clipped.last):
        xy = clipped.locate(end).astype(float)
        np.testing.assert_allclose((lines[:, :2] * xy).sum(axis=1) + lines[:, 2], 0, atol=1e-4)
        np.testing.assert_allclose(np.minimum(np.abs(xy), np.abs(xy - SIZE)).min(axis=1), 0, atol=1e-4)


@pytest.mark.parametrize("reach", [np.inf, 10.0])
def test_no_other_point_of_the_line_costs_less(rng: np.random.Generator, reach: float) -> None:
    xy = rng.uniform(0, 1, (40, 2)) * SIZE
    lines, neighbours, weights = draw_lines(rng, xy), find_neighbours(xy, 8), rng.uniform(0, 1, (40, 8))
    positions = recover_positions(lines, neighbours, weights, SIZE, reach)

    def compute_costs(row: int, points: np.ndarray) -> np.ndarray:
        near = lines[neighbours[row]]
        return np.minimum(np.abs(points @ near[:, :2].T + near[:, 2]), reach) @ weights[row]

    clipped = clip_lines(lines, SIZE)
    for row in range(40):
        grid = np.linspace(clipped.first[row], clipped.last[row], 2000)
        points = clipped.feet[row] + grid[:, None] * clipped.along[row]
        assert compute_costs(row, positions[row : row + 1])[0] <= compute_costs(row, points).min() + 1e-3


def test_neighbours_at_the_keypoint_itself_give_it_exactly(rng: np.random.Generator) -> None:
    xy = np.repeat(rng.uniform(0, 1, (5, 2)) * SIZE, 4, axis=0)
    neighbours = np.array([[4 * (row // 4) + (row + step) % 4 for step in (1, 2, 3)] for row in range(20)])
    positions = recover_positions(draw_lines(rng, xy), neighbours, np.ones((20, 3)), SIZE)
    np.testing.assert_allclose(positions, xy, atol=1e-3)


@pytest.mark.parametrize("axes", [False, True], ids=["lines", "axis-parallel lines"])
def test_true_neighbours_reveal_the_positions_in_photographs(axes: bool) -> None:
    """Chelani et al. report medians of about 5 to 12 pixels. Random neighbours and the density of all lines reveal nothing."""
    rng = np.random.default_rng(0)
    source = photographs.list_builtin()[0]
    features = Sift().extract(photographs.read(source.path).pixels)
    xy, count = features.keypoints.astype(float), len(features)
    lines, weights = draw_lines(rng, xy, axes), np.ones((count, 10))

    def error(positions: np.ndarray) -> float:
        return float(np.median(np.linalg.norm(positions - xy, axis=1)))

    assert error(recover_positions(lines, find_neighbours(xy, 10), weights, features.size)) < 6
    assert error(recover_positions(lines, rng.integers(count, size=(count, 10)), weights, features.size)) > 30
    assert error(find_densest(lines, features.size)) > 30


def test_a_neighbour_at_a_known_position_gives_the_nearest_point(rng: np.random.Generator) -> None:
    xy = rng.uniform(0, 1, (6, 2)) * SIZE
    lines, known = draw_lines(rng, xy), np.full((6, 2), np.nan)
    known[1:] = xy[0]  # all neighbours of the first keypoint lie at it
    neighbours = np.array([[1, 2, 3]] * 6)
    position = recover_positions(lines, neighbours, np.ones((6, 3)), SIZE, known=known)[0]
    np.testing.assert_allclose(position, xy[0], atol=1e-3)


def test_a_single_keypoint_is_estimated_near_the_centre() -> None:
    lines = np.array([[0.6, 0.8, -130.0]])  # 22 pixels from the centre
    position = recover_positions(lines, np.empty((1, 0), np.int64), np.empty((1, 0), np.float32), SIZE)
    np.testing.assert_allclose(position, np.array([[100, 60]]) + 22 * lines[:, :2], atol=1e-4)
