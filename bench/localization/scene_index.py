"""A place as its server has it: features of its reference images, and the map and the dictionaries that are made of them."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np

from bench.api import Extractor
from bench.cache import feature_cache, provenance, store
from bench.codebook import build, dictionary
from bench.codebook.dictionary import Dictionary
from bench.core import hashing
from bench.core.errors import UserError
from bench.images import samples
from bench.images.scene import Scene, SceneImage
from bench.localization import covisibility, mapping, maps
from bench.localization.maps import Map
from bench.localization.retrieval import Bags
from bench.registry import spec
from bench.types import Bytes, Features, Indices

WORDS = 32_000  # of the dictionary, unless it is said how many
SEED = 0  # of the clustering


class Place:
    """What is made from the references of a scene, each when it is asked for and kept on disk."""

    def __init__(self, scene: Scene, extractor: Extractor) -> None:
        self.scene = dataclasses.replace(scene, queries=())  # attackers have the place, and a query is the secret
        self.extractor = extractor
        self._words: dict[str, Indices] = {}  # by the dictionary's digest
        self._bags: dict[str, Bags] = {}
        self.misfits: dict[str, float | None] = {}  # query -> by how much its focal length is off, where it is, once known

    @cached_property
    def digest(self) -> str:
        """Of what the dictionary is made from and how, but for the number of its words."""
        hashes = [image.pixels.content_hash() for image in self.scene.references]
        return hashing.digest(["references", hashes, spec.written(self.extractor), SEED, provenance.source(build.__name__)])

    def features(self, image: SceneImage) -> Features:
        """Of a reference or a query."""
        return feature_cache.features(self.extractor, image.pixels)

    @cached_property
    def map(self) -> Map:
        """The map of the references.

        Raises
        ------
        UnitError
            if a reference cannot be read.
        UserError
            if no point could be triangulated.
        """
        source = provenance.source(mapping.__name__, covisibility.__name__)
        key = [self.digest, samples.fingerprint(self.scene.references), source]
        arrays, meta = store.fetch(maps.KIND, key, lambda: mapping.build(self.scene.references, self.references).to_arrays())
        return maps.from_arrays(arrays, meta)

    def words(self, known: Dictionary) -> Indices:
        """What the map's keypoints quantise to. -> (T,)"""
        if known.digest not in self._words:
            self._words[known.digest] = known.index.nearest(self.map.descriptors if self.map.codes is None else self.map.codes)
        return self._words[known.digest]

    def bags(self, known: Dictionary) -> Bags:
        """The references as bags of a dictionary's words."""
        if known.digest not in self._bags:
            self._bags[known.digest] = Bags(words=self.words(known), starts=self.map.starts, size=len(known))
        return self._bags[known.digest]

    @cached_property
    def references(self) -> tuple[Features, ...]:
        """The features of all references.

        Raises
        ------
        UnitError
            if one of them cannot be read.
        """
        return tuple(feature_cache.all_features(self.extractor, [image.pixels for image in self.scene.references]))

    def dictionary(self, words: int) -> Dictionary:
        """So many words clustered from the references' descriptors; `WORDS` for 0.

        Where the extractor has a limit on keypoints, and with it there are too few descriptors, all that there are serve.

        Raises
        ------
        UserError
            if the extractor has no 8-bit descriptors, or there are fewer descriptors than words.
        """
        size = words or WORDS
        arrays, meta = store.fetch(dictionary.KIND, [self.digest, size], lambda: self._clustered(size))
        return Dictionary(arrays["words"], meta, f"{self.digest}, {size} words")

    def _clustered(self, size: int) -> store.Content:
        codes = self._codes(self.extractor)
        if len(codes) < size:
            codes = self._codes(self.extractor.without_limit())
        if len(codes) < size:
            raise UserError(f"{self.scene.name}: its references have {len(codes)} descriptors, too few for {size} words")
        words = build.cluster(codes, size, np.random.default_rng(SEED))
        photographs = sorted({image.pixels.content_hash() for image in self.scene.references})
        meta = {"extractor": spec.written(self.extractor), "photographs": photographs, "descriptors": len(codes), "seed": SEED}
        return {"words": words}, meta

    def _codes(self, extractor: Extractor) -> Bytes:
        """The descriptors of all references. -> (n, D)"""
        found = [
            features.codes
            for features in feature_cache.all_features(extractor, [image.pixels for image in self.scene.references])
        ]
        codes = [each for each in found if each is not None]
        if len(codes) < len(found):
            raise UserError(f"{extractor.name()} gives no 8-bit descriptors, which a dictionary's words are made of")
        return np.concatenate(codes)
