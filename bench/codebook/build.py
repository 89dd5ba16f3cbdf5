"""Construction of a dictionary by spherical k-means in two levels.

The descriptors are those of every view of each photograph (`bench.images.views`). About sqrt(K) coarse clusters are built first.
Each of them gets a number of words in proportion to its descriptors, and is then clustered separately. An iteration costs about
4·n·sqrt(K)·D operations; brute force takes 2·n·K·D. Descriptors and
centroids are rounded to words (`bench.codebook.dictionary`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.api import Extractor
from bench.codebook import dictionary
from bench.codebook.dictionary import Dictionary, encode, round_rows
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.geometry.nearest_words import WordIndex, unit_rows
from bench.images.photographs import list_photographs
from bench.images.views import collect_views
from bench.registry import spec
from bench.types import Floats, Words

ITERATIONS = 12
SAMPLE = 20_000  # number of descriptors for the reported mean cosine


def build(images: Path, size: int, out: Path, extractor: Extractor, seed: int) -> Dictionary:
    """Cluster the descriptors of a folder's photographs into `size` words, write them to `out`, and return the dictionary.

    Raises
    ------
    UserError
        if there are fewer descriptors than words, or `out` exists.
    """
    if out.exists():
        raise UserError(f"{out} exists already; remove it, or give another --out")
    if size < 2:
        raise UserError(f"--size {size}: a dictionary needs at least 2 words")
    views = collect_views(list_photographs(images), extractor)
    codes = np.concatenate([encode(view.features) for view in views])
    if len(codes) < size:
        raise UserError(f"--size {size}: only {len(codes)} descriptors in {images}; use fewer words or more photographs")
    rng = np.random.default_rng(seed)
    words = cluster(codes, size, rng)
    sample = codes[rng.choice(len(codes), min(SAMPLE, len(codes)), replace=False)]
    meta = {
        "extractor": spec.to_json(extractor),
        "photographs": sorted({view.photograph for view in views}),
        "descriptors": len(codes),
        "mean_cosine": mean_cosine(sample, words),
        "seed": seed,
    }
    return dictionary.save(out, words, meta)


def mean_cosine(codes: Words, words: Words) -> float:
    """Return the mean cosine between descriptors and their nearest words. (N, D), (K, D)"""
    nearest = WordIndex(words).find_nearest(codes)
    return float((unit_rows(codes) * unit_rows(words[nearest])).sum(axis=1).mean())


def cluster(codes: Words, size: int, rng: np.random.Generator) -> Words:
    """Return distinct words in random order, by spherical k-means in two levels. (n, D) -> (size, D) of the same type"""
    rows = unit_rows(codes)
    coarse = max(1, round(size**0.5))
    clusters = _assign(rows, _run_kmeans(rows, coarse, rng))
    order = np.argsort(clusters, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(clusters, minlength=coarse))[:-1])
    word_counts = _apportion(np.array([len(cluster_rows) for cluster_rows in members]), size)
    centres = []
    with Progress("clustering", size) as progress:
        for cluster_rows, count in zip(members, word_counts, strict=True):
            if count:
                centres.append(_run_kmeans(rows[cluster_rows], int(count), rng))
            progress.advance(int(count))
    words = round_rows(np.concatenate(centres), codes.dtype)
    return rng.permutation(_make_distinct(words, codes, rng))


def _run_kmeans(rows: Floats, k: int, rng: np.random.Generator) -> Floats:
    """Return the centres of k-means. (n, D) unit rows -> (k, D) unit rows"""
    import faiss

    if len(rows) == k:
        return rows
    model = faiss.Kmeans(
        rows.shape[1],
        k,
        niter=ITERATIONS,
        spherical=True,
        seed=int(rng.integers(2**31)),
        min_points_per_centroid=1,
        max_points_per_centroid=1024,
    )
    model.train(rows)
    return np.asarray(model.centroids)


def _assign(rows: Floats, centres: Floats) -> np.ndarray:
    """Return the centre of greatest cosine of each row. (n, D), (k, D) -> (n,)"""
    step = 65_536  # rows at a time, to bound the memory for scores
    return np.concatenate([(rows[start : start + step] @ centres.T).argmax(axis=1) for start in range(0, len(rows), step)])


def _apportion(counts: np.ndarray, size: int) -> np.ndarray:
    """Return `size` split in proportion to `counts`, by largest remainders. No cluster gets more words than descriptors."""
    exact = counts * (size / counts.sum())
    word_counts = np.floor(exact).astype(np.int64)
    missing = size - word_counts.sum()
    word_counts[np.argsort(word_counts - exact, kind="stable")[:missing]] += 1
    return np.minimum(word_counts, counts)


def _make_distinct(words: Words, codes: Words, rng: np.random.Generator) -> Words:
    """Return the words, with descriptors in place of words that rounding made zero or equal to another word."""
    size = len(words)
    distinct: np.ndarray = np.unique(words[words.any(axis=1)], axis=0)
    while len(distinct) < size:
        candidates = codes[rng.choice(len(codes), min(len(codes), 4 * (size - len(distinct))), replace=False)]
        grown = np.unique(np.concatenate([distinct, candidates]), axis=0)
        if len(grown) == len(distinct) and len(np.unique(codes, axis=0)) + len(distinct) < size:
            raise UserError(f"--size {size}: there are fewer distinct descriptors; use fewer words or more photographs")
        distinct = grown
    return distinct[rng.choice(len(distinct), size, replace=False)] if len(distinct) > size else distinct
