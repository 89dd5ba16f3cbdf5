"""The blank attack: a constant image, the same for every release and photograph."""

import numpy as np
import pytest

import bench
from attacks.blank import Blank
from bench.api import Defense, View
from bench.codebook.examples import draw_features
from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.identification.distractors import load_distractors
from bench.images import photographs
from bench.registry import discovery
from bench.types import Release
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended


def reconstruct(release: Release, defense: Defense) -> np.ndarray:
    view = View(release=release, defense=defense, extractor=Sift())
    return Blank().reconstruct(view, np.random.default_rng(0))


@pytest.fixture(scope="module")
def public() -> Public:
    return Public()


@pytest.mark.slow
@pytest.mark.parametrize("defense", [Undefended(), LDP(), Affine()], ids=lambda defense: defense.name())
def test_every_release_gives_the_same_constant_image(defense: Defense, public: Public) -> None:
    releases = [defense.protect(draw_features(9, seed), public, np.random.default_rng(seed)) for seed in range(2)]
    images = [reconstruct(release, defense) for release in releases]
    for image, release in zip(images, releases, strict=True):
        width, height = release.size
        assert image.shape == (height, width, 3)
        assert image.dtype == np.float32
        assert (image == load_distractors().mean_colour()).all()


def test_it_applies_to_every_defense(public: Public) -> None:
    for plugin in discovery.load_plugins(discovery.DEFENSE):
        assert Blank().explain_not_applicable(plugin(), Sift(), public) is None


@pytest.mark.slow
def test_records_hold_the_distractors_and_the_rank_of_chance() -> None:
    sources = photographs.list_builtin()[:2]
    for record in bench.run([Undefended()], [Blank()], [source.path for source in sources]):
        assert record["status"] == "ok"
        assert record["metrics"]["identified"] == 1 / 128.5
        digest = record["metric_settings"]["identified"]["distractors"]
        assert record["attack"] == {"name": "blank", "colour": digest}
        assert digest.startswith("sha256:")


def test_no_constant_grey_has_a_smaller_squared_error_over_the_public_photographs() -> None:
    """By the photographs' mean colours: the error within a photograph is the same for every constant."""
    shipped = load_distractors()

    def measure_error(colour: np.ndarray) -> float:
        return float(np.square(shipped.colours.astype(np.float64) - colour).mean())

    assert measure_error(shipped.mean_colour()) < min(measure_error(np.full(3, grey)) for grey in np.linspace(0, 1, 101))
