"""The inlier attack reads the release and the server's map, and not the secret."""

import math
from pathlib import Path

import numpy as np
import pytest
from gallery_stretch import list_queries, list_references

from attacks.inlier import Inlier
from bench.api import View
from bench.codebook.examples import write_dictionary
from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.images.samples import Sample
from bench.images.scene import Scene
from bench.localization.scene_index import SceneIndex
from bench.testing import check_applicability, check_attack
from bench.types import Floats
from defenses.ldp import LDP
from defenses.none import Undefended

SIFT = Sift(max_keypoints=400)


@pytest.fixture(scope="module")
def scene_index() -> SceneIndex:
    return SceneIndex(Scene(name="stretch", references=list_references(), queries=()), SIFT)


@pytest.fixture(scope="module")
def query() -> Sample:
    image = list_queries()[0]
    return Sample(name=image.name, images=(image.pixels,), subject=image)


@pytest.mark.slow
@pytest.mark.parametrize("defense", ["none", "ldp"])
def test_the_secret_is_not_read(scene_index: SceneIndex, query: Sample, defense: str, tmp_path: Path) -> None:
    secret = scene_index.extractor.extract(query.images[0].read())
    protection = (
        Undefended() if defense == "none" else LDP(epsilon=math.inf, subset_size=1, dictionary=write_dictionary(tmp_path))
    )
    attack = Inlier(trials=1000)
    assert check_applicability(attack, protection, SIFT, Public(scene_index=scene_index))
    check_attack(attack, protection, SIFT, secret, sample=query, scene_index=scene_index)


@pytest.mark.slow
def test_an_attack_that_reads_the_secret_is_detected(scene_index: SceneIndex, query: Sample) -> None:
    """Negative control."""
    secret = scene_index.extractor.extract(query.images[0].read())

    class Peeking(Inlier):
        def select(self, view: View, rng: np.random.Generator) -> Floats:
            selection = super().select(view, rng)
            selection.descriptors[:1] = HELD[0].descriptors[:1]
            return selection

    class Keeping(Undefended):
        def protect(self, secret, public, rng):
            HELD[:] = [secret]
            return super().protect(secret, public, rng)

    HELD: list = []
    with pytest.raises(AssertionError, match="saw more"):
        check_attack(Peeking(trials=1000), Keeping(), SIFT, secret, sample=query, scene_index=scene_index)
