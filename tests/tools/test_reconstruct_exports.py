"""COLMAP reconstructs exported raw descriptors, and nothing from the same descriptors in another order."""

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import reconstruct_exports
from reconstruct_exports import reconstruct, write_views

from bench.datasets.walk import Walk

VIEWS = 4


def shuffle_descriptors(path: Path, rng: np.random.Generator) -> None:
    """Give each keypoint of an exported database the descriptor of another one in its image, and remove the matches."""
    with pycolmap.Database.open(path) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
        stored = {image.image_id: opened.read_descriptors(image.image_id) for image in opened.read_all_images()}
        opened.clear_descriptors()
        for image, descriptors in stored.items():
            descriptors.data = rng.permutation(descriptors.data)
            opened.write_descriptors(image, descriptors)


@pytest.mark.slow
def test_raw_descriptors_give_a_model_and_shuffled_ones_none(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reconstruct_exports, "VIEWS", VIEWS)
    write_views(Walk(views=VIEWS, width=320, height=240), tmp_path)
    keypoints, images, points, error = reconstruct(tmp_path, "none", None)
    assert images == f"{VIEWS} of {VIEWS}"
    assert int(points) > 100
    assert float(error) < 1.0  # pixels
    shutil.rmtree(tmp_path / "none-released")
    shuffle_descriptors(tmp_path / "none-released.db", rng)  # negative control
    assert reconstruct(tmp_path, "none", None) == (keypoints, f"0 of {VIEWS}", "no model", "n/a")
