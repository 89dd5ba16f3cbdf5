"""Selection of the descriptor among several candidates."""

import numpy as np

from bench.geometry.candidates import count_maxima, count_zeros, find_recurring, select_descriptors
from bench.geometry.nearest_words import unit_rows

PLAIN = [9, 1, 2, 3, 4, 5]
SPARSE = [9, 1, 2, 3, 0, 0]
CUT = [9, 9, 9, 3, 4, 5]
SHARED = [9, 9, 9, 9, 0, 0]


def rows(*codes: list[int]) -> np.ndarray:
    return unit_rows(np.array(codes, dtype=np.uint8))


def test_counts():
    assert count_maxima(rows(PLAIN, CUT, SHARED)).tolist() == [1, 3, 4]
    assert count_zeros(rows(PLAIN, SPARSE, SHARED)).tolist() == [0, 2, 2]


def test_ties_before_zeros():
    owners = np.array([0, 0, 0, 2, 2])
    assert select_descriptors(owners, rows(PLAIN, CUT, SPARSE, PLAIN, SPARSE), 4).tolist() == [1, -1, 4, -1]


def test_a_word_of_two_keypoints_comes_last():
    owners = np.array([0, 0, 1, 1, 2])
    candidates = rows(SHARED, PLAIN, SHARED, SPARSE, CUT)
    assert find_recurring(owners, candidates).tolist() == [True, False, True, False, False]
    assert select_descriptors(owners, candidates, 3).tolist() == [1, 3, 4]


def test_a_word_twice_at_one_keypoint_does_not_recur():
    owners = np.array([0, 0, 1])
    assert not find_recurring(owners, rows(CUT, CUT, PLAIN)).any()


def test_a_word_of_two_keypoints_is_selected_without_alternative():
    assert select_descriptors(np.array([0, 1]), rows(SHARED, SHARED), 2).tolist() == [0, 1]


def test_no_candidate_at_all():
    assert select_descriptors(np.empty(0, np.int64), np.empty((0, 6), np.float32), 2).tolist() == [-1, -1]
