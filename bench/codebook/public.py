"""What everyone knows: dictionaries and databases, and where each photograph's descriptors quantise to."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bench.codebook import dictionary
from bench.codebook.dictionary import Dictionary
from bench.core.errors import UserError
from bench.types import Bytes, Features, Floats, Indices

if TYPE_CHECKING:
    from bench.localization.scene_index import Place

ASSETS = Path(__file__).parents[1] / "assets"

# What an asset's name stands for in this distribution. The attacker's database is made from other photographs.
SHIPPED = {"shipped": "dictionary.safetensors", "shipped-public": "public-database.safetensors"}
REFERENCES = "references"

Quantiser = Callable[[Dictionary, Bytes | Floats], Indices]


class Public:
    """Loads public assets once, and remembers the quantisation of what it has quantised.

    Parameters
    ----------
    quantiser : finds the nearest words of (N, D) rows in a dictionary
    remembered : number of photographs whose quantisation is kept; with 0, several threads may quantise at once
    known : dictionaries by name that are in no file
    place : what is served, where it is a place: the dictionary called `references` is made from its reference images
    """

    def __init__(
        self,
        quantiser: Quantiser = lambda known, rows: known.index.nearest(rows),
        remembered: int = 64,
        known: Mapping[str, Dictionary] | None = None,
        place: Place | None = None,
    ) -> None:
        self.place = place
        self._quantiser = quantiser
        self._dictionaries = {(name, 0): dictionary for name, dictionary in (known or {}).items()}
        self._quantised: OrderedDict[str, Indices] = OrderedDict()
        self._remembered = remembered

    def dictionary(self, asset: str, words: int = 0) -> Dictionary:
        """The first `words` words, all if 0, of the dictionary called `shipped` or `shipped-public`, or of that of a file.

        Of `references`: as many words, clustered from the reference images of the place.

        Raises
        ------
        UserError
            if it is missing or damaged.
        """
        if (asset, words) not in self._dictionaries:
            if asset == REFERENCES:  # clustered into so many words: the first of more words would serve worse
                known = self._served().dictionary(words)
            else:
                known = self.dictionary(asset).first(words) if words else dictionary.load(dictionary_path(asset))
            self._dictionaries[asset, words] = known
        return self._dictionaries[asset, words]

    def digest(self, asset: str) -> str:
        """What records know a dictionary by.

        Raises
        ------
        UserError
            if it is missing or damaged.
        """
        return self._served().digest if asset == REFERENCES else self.dictionary(asset).digest

    def _served(self) -> Place:
        if self.place is None:
            raise UserError(f"dictionary={REFERENCES} is made from a place's reference images, and this task is about no place")
        return self.place

    def nearest_words(self, asset: str, features: Features, words: int = 0) -> Indices:
        """For each descriptor the word of greatest cosine among the first `words`, ties to the lowest. -> (N,) int64, a copy

        Raises
        ------
        UserError
            if the descriptors are not as long as the words.
        """
        known = self.dictionary(asset, words)
        queries = features.descriptors if features.codes is None else features.codes
        if queries.shape[1] != known.words.shape[1]:
            raise UserError(f"the descriptors have length {queries.shape[1]}, the words of {asset} {known.words.shape[1]}")
        if not self._remembered:
            return self._quantiser(known, queries)
        key = hashlib.sha256(known.digest.encode() + str(queries.dtype).encode() + queries.tobytes()).hexdigest()
        if key in self._quantised:
            self._quantised.move_to_end(key)
            return self._quantised[key].copy()
        nearest = self._quantiser(known, queries)
        self._quantised[key] = nearest
        while len(self._quantised) > self._remembered:
            self._quantised.popitem(last=False)
        return nearest.copy()

    def forget(self) -> None:
        """Drop every cache."""
        self._dictionaries.clear()
        self._quantised.clear()


def dictionary_path(asset: str) -> Path:
    """The file that an asset's name stands for."""
    if asset in SHIPPED:
        path = ASSETS / SHIPPED[asset]
        if not path.is_file():
            raise UserError(f"{path.name} is not part of this installation; reinstall, or name a file")
        return path
    return Path(asset)
