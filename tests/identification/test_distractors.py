"""The shipped distractors: origin, attribution, and ranks among them."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from bench.core.errors import UserError
from bench.formats import tensor_file
from bench.identification import distractors
from bench.identification.distractors import COUNT, DUPLICATE, FILE, KIND, MOST_SIMILAR, load_distractors, rank_photograph
from bench.identification.thumbnails import compare_thumbnails, compute_thumbnail
from bench.images import photographs


def read_photograph(path: Path) -> np.ndarray:
    return photographs.read(path).pixels / 255


def test_shapes_and_names() -> None:
    shipped = load_distractors()
    assert shipped.thumbnails.shape == (COUNT + 1, 16, 16)
    assert shipped.colours.shape == (COUNT + 1, 3)
    assert len(set(shipped.names)) == COUNT + 1
    assert 0 <= shipped.thumbnails.min() < shipped.thumbnails.max() <= 1


def test_every_photograph_has_author_page_and_licence() -> None:
    with FILE.with_suffix(".csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["photograph"] for row in rows] == [Path(name).stem for name in load_distractors().names]
    assert all(row["author"].strip() and re.match(r"https?://(www\.)?flickr\.com/", row["page"]) for row in rows)
    assert {row["licence"] for row in rows} == {"https://creativecommons.org/licenses/by/2.0/"}


def test_no_two_distractors_can_both_be_the_photograph() -> None:
    thumbnails = load_distractors().thumbnails
    similarities = compare_thumbnails(thumbnails[:, None], thumbnails[None])
    np.fill_diagonal(similarities, 0)
    assert similarities.max() < MOST_SIMILAR == pytest.approx(np.cos(2 * np.arccos(DUPLICATE)))


@pytest.mark.slow
def test_none_is_a_built_in_photograph() -> None:
    for source in photographs.list_builtin():
        assert compare_thumbnails(compute_thumbnail(read_photograph(source.path)), load_distractors().thumbnails).max() < 0.9


def test_a_file_with_other_distractors_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays, meta, _ = tensor_file.load(FILE, KIND)
    arrays["thumbnails"][0, 0, 0] ^= 1
    tensor_file.save(tmp_path / FILE.name, KIND, arrays, meta)
    monkeypatch.setattr(distractors, "FILE", tmp_path / FILE.name)
    with pytest.raises(UserError, match="holds other distractors"):
        distractors.load_distractors.__wrapped__()


def test_the_mean_colour_has_the_least_squared_error() -> None:
    shipped = load_distractors()
    best = shipped.mean_colour()

    def measure_error(colour: np.ndarray) -> float:
        return float(np.square(shipped.colours.astype(np.float64) - colour).sum())

    for channel in range(3):
        for step in (-1e-3, 1e-3):
            assert measure_error(best + step * np.eye(3)[channel]) > measure_error(best)


def test_rank_counts_the_distractors_of_greater_similarity() -> None:
    """Against np.corrcoef, one distractor after the other, for a mixture of two photographs."""
    truth, other = (read_photograph(source.path) for source in photographs.list_builtin()[:2])
    for weight in (0.0, 0.2, 0.4, 1.0):
        estimate = weight * truth + (1 - weight) * other
        thumbnail, own = compute_thumbnail(estimate).ravel(), compute_thumbnail(truth).ravel()
        reference = np.corrcoef(thumbnail, own)[0, 1]
        rivals = [np.corrcoef(thumbnail, row.ravel())[0, 1] for row in load_distractors().thumbnails[:COUNT]]
        assert rank_photograph(truth, estimate, load_distractors()) == 1 + sum(rival > reference for rival in rivals)
    assert rank_photograph(truth, truth, load_distractors()) == 1
    assert rank_photograph(truth, other, load_distractors()) > 1


def test_a_photograph_among_the_distractors_does_not_compete_with_itself(shared_data: Path) -> None:
    """The spare replaces it, so there are 256 candidates, and its reconstruction has rank 1 and not 1.5."""
    shipped = load_distractors()
    for number in (0, 100, COUNT):  # the last is the spare
        image = read_photograph(shared_data / "train" / shipped.names[number])
        similarities = compare_thumbnails(compute_thumbnail(image), shipped.thumbnails)
        assert similarities.argmax() == number
        assert (similarities >= DUPLICATE).sum() == 1
        assert rank_photograph(image, image, shipped) == 1
        assert rank_photograph(image, np.full_like(image, 0.5), shipped) == 128.5


@pytest.mark.slow
def test_ranks_by_chance_are_uniform(rng: np.random.Generator) -> None:
    """Photographs of another kind: the mean rank of unrelated smooth images is the mean of 1 to 256, within 4 deviations."""
    truths = [read_photograph(source.path) for source in photographs.list_builtin()]
    ranks = [rank_photograph(truth, rng.random(truth.shape), load_distractors()) for truth in truths for _ in range(10)]
    deviation = np.sqrt((256**2 - 1) / 12 / len(ranks))
    assert abs(np.mean(ranks) - 128.5) < 4 * deviation
    assert min(ranks) < 40
    assert max(ranks) > 216
