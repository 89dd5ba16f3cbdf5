"""Retrieval of similar references by bags of words with tf-idf weights (Sivic and Zisserman, ICCV 2003).

With the nearest words of raw descriptors, the ranking is the same for all defenses, as in the paper. With the words of a release,
the ranking leaks nothing beyond the release.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.types import Indices

if TYPE_CHECKING:
    import scipy.sparse

TOP = 20  # references of a query (the paper's Sec. 6.2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Bags:
    """The bag of words of each reference."""

    words: Indices  # (T,) of the map's keypoints
    starts: Indices  # (V + 1,) as the map's
    size: int  # words of the dictionary

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """log(V / number of references with the word), 0 for a word in no reference. -> (K,)"""
        count = len(self.starts) - 1
        frequencies = np.asarray((self._counts > 0).sum(axis=0)).ravel()  # (K,)
        return np.where(frequencies > 0, np.log(count / np.maximum(frequencies, 1)), 0.0)

    @cached_property
    def _counts(self) -> scipy.sparse.csr_matrix:
        """(V, K) the number of times that each reference has each word."""
        import scipy.sparse

        ones = np.ones(len(self.words))
        return scipy.sparse.csr_matrix((ones, self.words, self.starts), shape=(len(self.starts) - 1, self.size))

    @cached_property
    def _rows(self) -> scipy.sparse.csr_matrix:
        """(V, K) unit norm."""
        return _normalize(self._counts.multiply(self.weights).tocsr())

    def rank(self, words: Indices, count: int = TOP) -> Indices:
        """Return the references of greatest cosine to the query's bag, ties to the first.

        Parameters
        ----------
        words : of the query's keypoints, of any shape

        Returns
        -------
        (min(count, V),) int64
        """
        bag = np.bincount(words.ravel(), minlength=self.size) * self.weights  # (K,)
        return np.argsort(-(self._rows @ bag), kind="stable")[:count]


def _normalize(rows: scipy.sparse.csr_matrix) -> scipy.sparse.csr_matrix:
    import scipy.sparse

    norms = np.sqrt(np.asarray(rows.multiply(rows).sum(axis=1)).ravel())
    return scipy.sparse.diags(1 / np.where(norms > 0, norms, 1)) @ rows
