"""Samples of a scene, cached features, and the dictionary of its references."""

import dataclasses
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from fakes import draw_texture, write_scene

from bench.cache import feature_cache, provenance, store
from bench.codebook.public import Public
from bench.core import environment
from bench.core.errors import UserError
from bench.datasets.gallery import Gallery
from bench.extractors.sift import Sift
from bench.images import samples
from bench.images.scene import Pixels, Scene
from bench.localization.scene_index import SceneIndex
from bench.tasks.collisions import Collisions
from bench.testing import are_equal

TINY = Gallery(views=2, queries=3, width=64, height=48, detail=0.1)


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))


def test_queries_become_samples_and_the_whole_scene_is_hashed() -> None:
    collection = samples.collect_queries(TINY)
    assert [unit.condition for unit in collection.samples] == ["day", "day", "night"]
    assert len({unit.content_hash() for unit in collection.samples}) == 3
    other = samples.collect_queries(dataclasses.replace(TINY, views=3))  # another map, and so another dataset
    assert collection.extra_inputs != other.extra_inputs


def test_task_of_photographs_takes_no_dataset() -> None:
    with pytest.raises(UserError, match="takes photographs, not a dataset"):
        Collisions().collect(None, TINY)


class Counted(Pixels):
    """A texture that counts its reads."""

    def __init__(self, seed: int) -> None:
        self.seed, self.reads = seed, 0

    def content_hash(self) -> str:
        return f"texture {self.seed}"

    def read(self) -> np.ndarray:
        self.reads += 1
        return np.array(draw_texture(self.seed))


def test_features_are_cached_by_content_and_computed_again_if_damaged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    image, extractor = Counted(1), Sift()
    first = feature_cache.extract(extractor, image)
    assert are_equal(first, extractor.extract(np.array(draw_texture(1))))
    assert are_equal(first, feature_cache.extract(extractor, image))
    assert image.reads == 1
    assert len(feature_cache.extract(Sift(max_keypoints=3), image)) <= 3  # another extractor
    assert not are_equal(first, feature_cache.extract(extractor, Counted(2)))  # another image
    assert image.reads == 2
    for file in (tmp_path / "cache").rglob("*.safetensors"):
        file.write_bytes(file.read_bytes()[:-9])
    assert are_equal(first, feature_cache.extract(extractor, image))
    assert image.reads == 3
    assert "computed again" in caplog.text
    monkeypatch.setattr(environment, "version", lambda library: "0.0" if library == "kornia" else metadata.version(library))
    feature_cache.extract(extractor, image)
    assert image.reads == 4  # another version of the library of the learned extractors


def test_dictionary_of_the_references_has_the_given_size(tmp_path: Path) -> None:
    index = SceneIndex(write_scene(tmp_path / "scene"), Sift())
    public = Public(scene_index=index)
    few, more = public.dictionary("references", 20), public.dictionary("references", 40)
    assert (len(few), len(more)) == (20, 40)
    assert not set(map(bytes, few.words)) <= set(map(bytes, more.words))  # not the first of more
    assert few.digest != more.digest
    again = Public(scene_index=SceneIndex(write_scene(tmp_path / "scene"), Sift())).dictionary("references", 20)
    np.testing.assert_array_equal(again.words, few.words)
    with pytest.raises(UserError, match="too few for 1000000 words"):
        public.dictionary("references", 1_000_000)
    with pytest.raises(UserError, match="this task has no scene"):
        Public().dictionary("references")


def test_another_source_of_the_extractor_is_another_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the map and the dictionary in the cache would be those of features that nobody extracts any more."""
    scene, hash_modules = write_scene(tmp_path / "scene"), provenance.hash_modules
    digest = SceneIndex(scene, Sift()).digest

    def hash_changed(*modules: str) -> str:
        return hash_modules(*modules) + "changed" * (Sift.__module__ in modules)

    monkeypatch.setattr(provenance, "hash_modules", hash_changed)
    assert SceneIndex(scene, Sift()).digest != digest


def test_large_dictionary_is_built_without_the_limit_on_keypoints(tmp_path: Path) -> None:
    index = SceneIndex(write_scene(tmp_path / "scene"), Sift(max_keypoints=5))
    assert sum(map(len, index.reference_features)) == 15
    assert len(index.build_dictionary(15)) == 15
    assert len(index.build_dictionary(40)) == 40


def test_scene_index_holds_no_query(tmp_path: Path) -> None:
    whole = write_scene(tmp_path / "scene")
    assert whole.queries
    assert SceneIndex(whole, Sift()).scene.queries == ()
    assert SceneIndex(whole, Sift()).scene.references == whole.references


def test_scene_without_queries_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bare: Scene = dataclasses.replace(write_scene(tmp_path / "scene"), queries=())
    monkeypatch.setattr(Gallery, "scene", lambda self: bare)
    with pytest.raises(UserError, match="has no queries"):
        samples.collect_queries(TINY)
