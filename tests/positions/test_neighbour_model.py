"""The neighbour model: its ratios on word sets against a direct sum, and its predictions on photographs."""

import numpy as np
import pytest

from bench.api import Extractor
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.formats import tensor_file
from bench.images import photographs
from bench.images.photographs import Source
from bench.positions import neighbour_model
from bench.positions.lines import draw_lines
from bench.positions.neighbour_model import SHAPES, NeighbourModel, load, select_neighbours, weigh
from bench.positions.neighbourhood import recover_positions
from bench.types import Features


class Disk(Extractor):
    @classmethod
    def name(cls) -> str:
        return "disk"

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        raise NotImplementedError


def draw_model(rng: np.random.Generator) -> NeighbourModel:
    sizes = ((6, 8), (6,), (4, 6), (4,), (4,), ())
    arrays = {name: rng.normal(size=size).astype(np.float32) for name, size in zip(SHAPES, sizes, strict=True)}
    return NeighbourModel(arrays=arrays, meta={}, digest="")


def test_ratios_of_word_sets_average_over_the_true_words(rng: np.random.Generator) -> None:
    model, words = draw_model(rng), rng.normal(size=(5, 2, 8)).astype(np.float32)
    chance = 0.7  # of the true word in its set
    odds = np.log(chance / 2 / (1 - chance))
    single = np.exp(model.log_ratios(words.reshape(10, 1, 8))).reshape(5, 2, 5, 2)
    expected = 1 - chance**2 + (chance / 2) ** 2 * single.sum(axis=(1, 3))
    apart = ~np.eye(5, dtype=bool)
    np.testing.assert_allclose(np.exp(model.log_ratios(words, odds))[apart], expected[apart], rtol=1e-4)


def test_without_a_chance_of_the_true_word_there_is_no_evidence(rng: np.random.Generator) -> None:
    logs = draw_model(rng).log_ratios(rng.normal(size=(5, 2, 8)).astype(np.float32), -20.0)
    np.testing.assert_allclose(logs[~np.eye(5, dtype=bool)], 0, atol=1e-3)


def test_the_likeliest_come_first_and_nobody_is_a_neighbour_of_themselves(rng: np.random.Generator) -> None:
    logs = draw_model(rng).log_ratios(rng.normal(size=(9, 1, 8)).astype(np.float32))
    rows, values = select_neighbours(logs, 20)
    assert rows.shape == (9, 8)
    assert (rows != np.arange(9)[:, None]).all()
    assert (np.diff(values, axis=1) <= 0).all()


def test_predicted_neighbours_reveal_positions_in_photographs() -> None:
    """Control: the same predictions for other keypoints reveal nothing."""
    rng = np.random.default_rng(0)
    features = Sift().extract(photographs.read(photographs.list_builtin()[0].path).pixels)
    lines = draw_lines(features.keypoints, rng.uniform(0, np.pi, len(features))).lines
    near, logs = select_neighbours(load().log_ratios(features.descriptors[:, None]), 30)

    def error(rows: np.ndarray) -> float:
        positions = recover_positions(lines, rows, weigh(logs), features.size, 15.0)
        return float(np.median(np.linalg.norm(positions - features.keypoints, axis=1)))

    assert error(near) < 20
    assert error(rng.permutation(len(features))[near]) > 35


def test_a_file_without_a_tensor_is_refused(tmp_path, rng: np.random.Generator) -> None:
    arrays = draw_model(rng).arrays
    del arrays["scale"]
    tensor_file.save(tmp_path / "x.safetensors", neighbour_model.KIND, arrays, {})
    with pytest.raises(UserError, match="scale"):
        load(tmp_path / "x.safetensors")


def test_the_model_is_for_the_features_of_its_training() -> None:
    """Name and fields of the extractor count, as for other networks."""
    model = load()
    assert model.explain_other_features(Sift(), Public()) is None
    assert "upright True, not False" in str(model.explain_other_features(Sift(upright=False), Public()))
    assert "features of sift, not disk" in str(model.explain_other_features(Disk(), Public()))
