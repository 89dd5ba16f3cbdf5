"""Public dictionaries and databases, and the quantisation of descriptors by them."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bench.codebook import clustered, dictionary
from bench.codebook.dictionary import Dictionary
from bench.core.errors import UserError
from bench.types import Bytes, Features, Floats, Indices

if TYPE_CHECKING:
    from bench.localization.scene_index import SceneIndex

ASSETS = Path(__file__).parents[1] / "assets"

# The files of the shipped assets. The attacker's database is built from other photographs.
SHIPPED = {
    "shipped": "dictionary.safetensors",
    "shipped-public": "public-database.safetensors",
    "shipped-xfeat": "dictionary-xfeat.safetensors",
    "shipped-aliked": "dictionary-aliked.safetensors",
}
REFERENCES = "references"
CLUSTERED = {"shipped-clustered": "shipped"}  # dictionaries that are clustered from the words of another one

Clusterer = Callable[[Dictionary, int], Dictionary]
Quantiser = Callable[[Dictionary, Bytes | Floats], Indices]


class Public:
    """Loads public assets once and caches quantised descriptors.

    Parameters
    ----------
    quantiser : function that finds the nearest words of (N, D) rows in a dictionary
    cache_size : number of photographs whose quantisation is cached; 0 makes quantisation thread-safe
    dictionaries : further dictionaries by name, held in memory
    scene_index : the server's index; the dictionary `references` is built from its reference images
    clusterer : function that clusters a dictionary into fewer words
    """

    def __init__(
        self,
        quantiser: Quantiser = lambda words, rows: words.index.find_nearest(rows),
        cache_size: int = 64,
        dictionaries: Mapping[str, Dictionary] | None = None,
        scene_index: SceneIndex | None = None,
        clusterer: Clusterer = clustered.cluster_words,
    ) -> None:
        self.scene_index = scene_index
        self._quantiser = quantiser
        self._clusterer = clusterer
        self._dictionaries = {(name, 0): dictionary for name, dictionary in (dictionaries or {}).items()}
        self._quantised: OrderedDict[str, Indices] = OrderedDict()
        self._cache_size = cache_size

    def dictionary(self, asset: str, words: int = 0) -> Dictionary:
        """Return the first `words` words (0: all) of a shipped dictionary (`SHIPPED`) or of a file.

        For `references`, return that many words, clustered from the reference images of the scene. For `shipped-clustered`,
        return that many words, clustered from the words of `shipped`.

        Raises
        ------
        UserError
            if the dictionary is missing or damaged.
        """
        if (asset, words) not in self._dictionaries:
            if asset == REFERENCES:  # clustered into exactly that many words; the first words of a larger clustering are worse
                result = self._require_scene_index().build_dictionary(words)
            elif asset in CLUSTERED:
                source = self.dictionary(CLUSTERED[asset])
                result = self._clusterer(source, words) if words else source
            else:
                result = self.dictionary(asset).first(words) if words else dictionary.load(dictionary_path(asset))
            self._dictionaries[asset, words] = result
        return self._dictionaries[asset, words]

    def digest(self, asset: str) -> str:
        """Return the digest that identifies a dictionary in records.

        Raises
        ------
        UserError
            if the dictionary is missing or damaged.
        """
        if asset == REFERENCES:
            return self._require_scene_index().digest
        if asset in CLUSTERED:
            return clustered.name_digest(self.dictionary(CLUSTERED[asset]).digest)
        return self.dictionary(asset).digest

    def _require_scene_index(self) -> SceneIndex:
        if self.scene_index is None:
            raise UserError(f"dictionary={REFERENCES}: needs the reference images of a scene, but this task has no scene")
        return self.scene_index

    def nearest_words(self, asset: str, features: Features, words: int = 0) -> Indices:
        """Return for each descriptor the word of greatest cosine among the first `words` (0: all), ties to the lowest index.

        -> (N,) int64, a copy

        Raises
        ------
        UserError
            if the words cannot stand for the descriptors.
        """
        chosen = self.dictionary(asset, words)
        queries = features.exact
        chosen.check_suits(queries, asset)
        if not self._cache_size:
            return self._quantiser(chosen, queries)
        key = hashlib.sha256(chosen.digest.encode() + str(queries.dtype).encode() + queries.tobytes()).hexdigest()
        if key in self._quantised:
            self._quantised.move_to_end(key)
            return self._quantised[key].copy()
        nearest = self._quantiser(chosen, queries)
        self._quantised[key] = nearest
        while len(self._quantised) > self._cache_size:
            self._quantised.popitem(last=False)
        return nearest.copy()

    def clear(self) -> None:
        """Clear all caches."""
        self._dictionaries.clear()
        self._quantised.clear()


def dictionary_path(asset: str) -> Path:
    """Return the path of an asset's file."""
    if asset in SHIPPED:
        path = ASSETS / SHIPPED[asset]
        if not path.is_file():
            raise UserError(f"{path.name} is missing from this installation; reinstall, or give a file")
        return path
    return Path(asset)
