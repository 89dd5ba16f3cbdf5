"""The server's index of a scene: features of the reference images, and the map and dictionaries built from them."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np

from bench.api import Extractor
from bench.cache import feature_cache, provenance, store
from bench.codebook import build, dictionary
from bench.codebook.dictionary import Dictionary
from bench.core import environment, hashing
from bench.core.errors import UserError
from bench.images import samples
from bench.images.scene import Scene
from bench.localization import covisibility, mapping, maps
from bench.localization.maps import Map
from bench.localization.retrieval import Bags
from bench.registry import spec
from bench.types import Features, Indices, Words

WORDS = 32_000  # of the dictionary by default
SEED = 0  # of the clustering


class SceneIndex:
    """Data built from the references of a scene. Each part is built at first use and cached on disk."""

    def __init__(self, scene: Scene, extractor: Extractor) -> None:
        self.scene = dataclasses.replace(scene, queries=())  # attackers read the index, and a query is the secret
        self.extractor = extractor
        self._words: dict[str, Indices] = {}  # by the dictionary's digest
        self._bags: dict[str, Bags] = {}
        self.focal_mismatches: dict[str, float | None] = {}  # query -> `Server.estimate_focal_mismatch`

    @cached_property
    def digest(self) -> str:
        """Digest of everything that determines the dictionary, except its number of words."""
        hashes = [image.pixels.content_hash() for image in self.scene.references]
        source = provenance.hash_modules(build.__name__, type(self.extractor).__module__)
        return hashing.digest(["references", hashes, spec.to_json(self.extractor), SEED, source])

    @cached_property
    def map(self) -> Map:
        """The map of the references.

        Raises
        ------
        SampleError
            if a reference cannot be read.
        UserError
            if no point could be triangulated.
        """
        source = provenance.hash_modules(mapping.__name__, covisibility.__name__)
        images = samples.hash_scene_images(self.scene.references)
        references, ratio = self.scene.references, self.extractor.match_ratio
        key = [self.digest, images, source, environment.list_extractor_library_versions(), ratio]
        arrays, meta = store.fetch(
            maps.KIND, key, lambda: mapping.build_map(references, self.reference_features, ratio).to_arrays()
        )
        return maps.from_arrays(arrays, meta)

    def quantize_map(self, words: Dictionary) -> Indices:
        """Return the nearest word of each of the map's keypoints. -> (T,)"""
        if words.digest not in self._words:
            rows = self.map.descriptors if self.map.codes is None else self.map.codes
            self._words[words.digest] = words.index.find_nearest(rows)
        return self._words[words.digest]

    def build_bags(self, words: Dictionary) -> Bags:
        """Return the references as bags of a dictionary's words."""
        if words.digest not in self._bags:
            self._bags[words.digest] = Bags(words=self.quantize_map(words), starts=self.map.starts, size=len(words))
        return self._bags[words.digest]

    @cached_property
    def reference_features(self) -> tuple[Features, ...]:
        """The features of all references.

        Raises
        ------
        SampleError
            if a reference cannot be read.
        """
        return tuple(feature_cache.extract_all(self.extractor, [image.pixels for image in self.scene.references]))

    def build_dictionary(self, words: int) -> Dictionary:
        """Return a dictionary of `words` words (0: `WORDS`), clustered from the references' descriptors.

        If the extractor's limit on keypoints leaves too few descriptors, the limit is dropped.

        Raises
        ------
        UserError
            if there are fewer descriptors than words.
        """
        size = words or WORDS
        key = [self.digest, size, environment.list_extractor_library_versions()]
        arrays, meta = store.fetch(dictionary.KIND, key, lambda: self._cluster(size))
        return Dictionary(arrays["words"], meta, f"{self.digest}, {size} words")

    def _cluster(self, size: int) -> store.Content:
        codes = self._collect_codes(self.extractor)
        if len(codes) < size:
            codes = self._collect_codes(self.extractor.without_limit())
        if len(codes) < size:
            raise UserError(f"{self.scene.name}: its references have {len(codes)} descriptors, too few for {size} words")
        words = build.cluster(codes, size, np.random.default_rng(SEED))
        photographs = sorted({image.pixels.content_hash() for image in self.scene.references})
        meta = {"extractor": spec.to_json(self.extractor), "photographs": photographs, "descriptors": len(codes), "seed": SEED}
        return {"words": words}, meta

    def _collect_codes(self, extractor: Extractor) -> Words:
        """Return the descriptors of all references as words. -> (n, D)"""
        images = [image.pixels for image in self.scene.references]
        return np.concatenate([dictionary.encode(features) for features in feature_cache.extract_all(extractor, images)])
