"""A place as its server has it: the features of its reference images, and a dictionary clustered from them."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from bench import cache, provenance, spec, units
from bench.datasets.scene import Scene, SceneImage
from bench.errors import UserError
from bench.features import build, dictionary, kept
from bench.features.dictionary import Dictionary
from bench.plugin import Extractor
from bench.progress import Progress
from bench.types import Features

WORDS = 32_000  # of the dictionary, unless it is said how many
SEED = 0  # of the clustering


class Place:
    """What is made from the references of a scene, each when it is asked for and kept on disk."""

    def __init__(self, scene: Scene, extractor: Extractor) -> None:
        self.scene = scene
        self.extractor = extractor

    @cached_property
    def digest(self) -> str:
        """Of what the dictionary is made from and how, but for the number of its words."""
        hashes = [image.pixels.content_hash() for image in self.scene.references]
        return units.digest(["references", hashes, spec.written(self.extractor), SEED, provenance.source(build.__name__)])

    def features(self, image: SceneImage) -> Features:
        """Of a reference or a query."""
        return kept.features(self.extractor, image.pixels)

    @cached_property
    def references(self) -> tuple[Features, ...]:
        """The features of all references.

        Raises
        ------
        UnitError
            if one of them cannot be read.
        """
        found = []
        with Progress("reference images", len(self.scene.references)) as progress:
            for image in self.scene.references:
                found.append(self.features(image))
                progress.advance(note=image.name)
        return tuple(found)

    def dictionary(self, words: int) -> Dictionary:
        """So many words clustered from the references' descriptors; `WORDS` for 0.

        Raises
        ------
        UserError
            if the extractor has no 8-bit descriptors, or there are fewer descriptors than words.
        """
        size = words or WORDS
        arrays, meta = cache.fetch(dictionary.KIND, [self.digest, size], lambda: self._clustered(size))
        return Dictionary(arrays["words"], meta, f"{self.digest}, {size} words")

    def _clustered(self, size: int) -> cache.Made:
        found = [features.codes for features in self.references if features.codes is not None]
        if len(found) < len(self.references):
            raise UserError(f"{self.extractor.name()} gives no 8-bit descriptors, which a dictionary's words are made of")
        codes = np.concatenate(found)
        if len(codes) < size:
            raise UserError(f"{self.scene.name}: its references have {len(codes)} descriptors, too few for {size} words")
        words = build.cluster(codes, size, np.random.default_rng(SEED))
        photographs = sorted({image.pixels.content_hash() for image in self.scene.references})
        meta = {"extractor": spec.written(self.extractor), "photographs": photographs, "descriptors": len(codes), "seed": SEED}
        return {"words": words}, meta
