"""Pairs of images with known homographies: rendered ones, and HPatches' layout, intact and damaged."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from fakes import draw_texture

from bench.core.errors import UserError
from bench.rendering import homographies
from bench.rendering.homographies import SIDE, create_pairs, load_hpatches

SHIFT = np.array([[1, 0, 3.0], [0, 1, -2.0], [0, 0, 1]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two sequences in HPatches' layout; each image is the first, scaled by a half and shifted."""
    for sequence in ("i_wall", "v_roof"):
        (tmp_path / sequence).mkdir()
        for number in range(1, 7):
            draw_texture(number).save(tmp_path / sequence / f"{number}.ppm")
        for number in range(2, 7):
            np.savetxt(tmp_path / sequence / f"H_1_{number}", SHIFT @ np.diag([0.5, 0.5, 1.0]))
    (tmp_path / "README").write_text("not a sequence")
    return tmp_path


def test_hpatches_is_read(folder: Path) -> None:
    pairs = load_hpatches(folder)
    assert [pair.name for pair in pairs] == [f"{name}-{number}" for name in ("i_wall", "v_roof") for number in range(2, 7)]
    np.testing.assert_array_equal(pairs[0].first.read(), np.asarray(draw_texture(1)))
    np.testing.assert_array_equal(pairs[6].second.read(), np.asarray(draw_texture(3)))


def test_homographies_of_hpatches_are_converted_by_half_a_pixel(folder: Path) -> None:
    # There the first pixel's centre is (0, 0), which goes to (3, -2); here that is (0.5, 0.5) to (3.5, -1.5).
    found = load_hpatches(folder)[0].homography @ [0.5, 0.5, 1]
    np.testing.assert_allclose(found, [3.5, -1.5, 1])
    assert not np.allclose(SHIFT @ np.diag([0.5, 0.5, 1]) @ [0.5, 0.5, 1], [3.5, -1.5, 1])  # a matrix as stored fails


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda path: path.write_text("1 0 0\n0 1\n0 0 1\n"), r"H_1_3:2: a homography has three lines of three numbers"),
        (lambda path: path.write_text("1 0 0\n0 1 0\n0 0 1\n0 0 1\n"), r"H_1_3:4: a homography has three lines"),
        (lambda path: path.write_text("1 0 0\n0 1 0\n"), r"H_1_3: a homography .* but there are 2"),
        (lambda path: path.write_text("1 0 0\n0 nan 0\n0 0 1\n"), r"H_1_3:2: .*not all of these are finite"),
        (lambda path: path.write_text("1 0 0\n1 0 0\n0 0 1\n"), r"H_1_3: this matrix has no inverse"),
        (lambda path: path.unlink(), r"H_1_3: no such file"),
        (lambda path: (path.parent / "3.ppm").unlink(), r"3\.ppm: no such file"),
        (lambda path: (path.parent / "3.ppm").write_text("P9"), r"3\.ppm: not an image"),
    ],
)
def test_damaged_sequences_are_refused(folder: Path, damage: Callable[[Path], object], complaint: str) -> None:
    damage(folder / "v_roof" / "H_1_3")
    with pytest.raises(UserError, match=complaint):
        load_hpatches(folder)


def test_folders_without_sequences_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        load_hpatches(tmp_path / "absent")
    with pytest.raises(UserError, match="no sequence of HPatches"):
        load_hpatches(tmp_path)


@pytest.mark.slow
def test_created_pairs_agree_with_their_homography() -> None:
    """OpenCV's alignment improves nothing from the stated homography, but it improves another one (negative control)."""
    pairs = create_pairs(0, 2)
    assert len({pair.name for pair in pairs}) == len(pairs) == 14
    for pair in pairs[:4]:
        first, second = (cv2.cvtColor(image.read(), cv2.COLOR_RGB2GRAY) for image in (pair.first, pair.second))
        assert measure_drift(first, second, pair.homography) < 0.3
        assert measure_drift(first, second, SHIFT @ pair.homography) > 2


def measure_drift(first: np.ndarray, second: np.ndarray, homography: np.ndarray) -> float:
    """Measure by how many pixels alignment by correlation moves points in the middle."""
    stated = np.linalg.inv(homographies.HALF_PIXEL) @ homography @ homographies.HALF_PIXEL
    steps = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-6)
    visible = cv2.warpPerspective(np.full_like(first, 255), np.linalg.inv(stated), first.shape[::-1], flags=cv2.INTER_NEAREST)
    back = (stated / stated[2, 2]).astype(np.float32)
    _, found = cv2.findTransformECC(first, second, back, cv2.MOTION_HOMOGRAPHY, steps, None, 5)
    points = np.array([[[x, y]] for x in (0.4, 0.5, 0.6) for y in (0.4, 0.5, 0.6)]) * SIDE
    assert visible.any()
    moved = cv2.perspectiveTransform(points, found.astype(float)) - cv2.perspectiveTransform(points, stated)
    return float(np.median(np.linalg.norm(moved[:, 0], axis=1)))


def test_created_pairs_follow_their_seed() -> None:
    one, same, other = create_pairs(3, 1)[0], create_pairs(3, 1)[0], create_pairs(4, 1)[0]
    np.testing.assert_array_equal(one.second.read(), same.second.read())
    assert one.second.content_hash() == same.second.content_hash() != one.first.content_hash()
    assert not np.allclose(one.homography, other.homography)
