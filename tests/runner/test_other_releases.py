"""Other users' releases: unlimited, repeatable, and never of the attacked photograph."""

from pathlib import Path

import numpy as np
import pytest
from fakes import write_album

from bench.codebook.public import Public
from bench.core import randomness as seeds
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.images.photographs import Source, list_photographs
from bench.runner.other_releases import ReleasePool, random_window
from defenses.none import Undefended


def randomness(*parts: object) -> np.random.Generator:
    return seeds.derive_generator("test", *parts)


@pytest.fixture
def sources(tmp_path: Path) -> list[Source]:
    return list_photographs(write_album(tmp_path / "album", 3))


def population(sources: list[Source]) -> ReleasePool:
    return ReleasePool(sources, Sift(), Undefended(), Public(), randomness)


def similarity(release, source: Source) -> float:
    """Return the mean greatest cosine of a release's descriptors with those of a photograph at its own size, mirrored or not."""
    seen = [Sift().extract(random_window(source, np.random.default_rng(seed))).descriptors for seed in range(8)]
    return float((unit_rows(release.descriptors) @ np.concatenate(seen).T).max(axis=1).mean())


@pytest.mark.slow
def test_the_list_is_unlimited_and_repeatable(sources) -> None:
    first = list(population(sources).without("0.png")(7))
    assert len(first) == 7
    again = list(population(sources).without("0.png")(9))
    for one, other in zip(first, again, strict=False):
        assert np.array_equal(one.descriptors, other.descriptors)
    assert not np.array_equal(first[0].keypoints, first[2].keypoints)  # another window of the same photograph


@pytest.mark.slow
def test_it_excludes_the_attacked_photograph(sources) -> None:
    releases = list(population(sources).without("0.png")(6))
    to_the_attacked = np.mean([similarity(release, sources[0]) for release in releases])
    to_the_others = np.mean([max(similarity(release, source) for source in sources[1:]) for release in releases])
    assert to_the_others > to_the_attacked + 0.05
    everything = list(population(sources).without("none of them")(6))  # negative control: then it is among them
    assert np.mean([similarity(release, sources[0]) for release in everything[::3]]) > to_the_attacked + 0.05


def test_attackers_of_different_photographs_see_the_same_releases(sources) -> None:
    """The k-th release does not depend on the attacked photograph."""
    everyone = population(sources)
    of_first = [release.keypoints for release in everyone.without("0.png")(4)]
    of_second = [release.keypoints for release in everyone.without("1.png")(4)]
    assert any(np.array_equal(a, b) for a in of_first for b in of_second)


def test_photographs_that_cannot_be_read_are_skipped(sources, tmp_path) -> None:
    broken = Source("broken.png", tmp_path / "broken.png")
    broken.path.write_bytes(b"no image")
    assert len(list(population([*sources, broken]).without("0.png")(5))) == 5
    assert list(population([broken, sources[0]]).without("0.png")(5)) == []
    assert list(population(sources[:1]).without("0.png")(5)) == []


def test_windows_are_squares_of_the_photograph(sources) -> None:
    assert all(random_window(sources[0], np.random.default_rng(seed)).shape == (256, 256, 3) for seed in range(4))
    first, second = (random_window(sources[0], np.random.default_rng(seed)) for seed in (0, 1))
    assert not np.array_equal(first, second)
