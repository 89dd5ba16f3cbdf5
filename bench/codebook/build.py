"""Builds a dictionary by spherical k-means in two levels.

The descriptors are those of every view of each photograph (`views.py`). About sqrt(K) coarse cells are clustered first; each
then gets words in proportion to its descriptors, and is clustered on its own. An iteration so costs about 4·n·sqrt(K)·D
operations where brute force takes 2·n·K·D. Centroids are rounded to 8 bits at SIFT's norm of 512.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.api import Extractor
from bench.codebook import dictionary
from bench.codebook.dictionary import Dictionary
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.geometry.nearest_words import WordIndex, unit_rows
from bench.images.photographs import folder
from bench.images.views import collect
from bench.registry import spec
from bench.types import Bytes, Floats

ITERATIONS = 12
NORM = 512.0  # of SIFT's 8-bit vectors
SAMPLE = 20_000  # descriptors that the reported mean cosine is taken over


def build(images: Path, size: int, out: Path, extractor: Extractor, seed: int) -> Dictionary:
    """Cluster the descriptors of a folder's photographs into `size` words and write them to `out`.

    Raises
    ------
    UserError
        if there are fewer descriptors than words, or `out` is there already.
    """
    if out.exists():
        raise UserError(f"{out} is there already; remove it, or name another --out")
    if size < 2:
        raise UserError(f"--size {size}: a dictionary needs at least 2 words")
    seen = collect(folder(images), extractor)
    if any(view.features.codes is None for view in seen):
        raise UserError(f"{extractor.name()} gives no 8-bit descriptors, which a dictionary's words are made of")
    codes = np.concatenate([view.features.codes for view in seen if view.features.codes is not None])
    if len(codes) < size:
        raise UserError(f"--size {size}: only {len(codes)} descriptors in {images}; ask for fewer words or give more photographs")
    rng = np.random.default_rng(seed)
    words = cluster(codes, size, rng)
    sample = codes[rng.choice(len(codes), min(SAMPLE, len(codes)), replace=False)]
    meta = {
        "extractor": spec.written(extractor),
        "photographs": sorted({view.photograph for view in seen}),
        "descriptors": len(codes),
        "mean_cosine": mean_cosine(sample, words),
        "seed": seed,
    }
    return dictionary.save(out, words, meta)


def mean_cosine(codes: Bytes, words: Bytes) -> float:
    """Mean cosine between descriptors and their nearest words. (N, D), (K, D) uint8"""
    nearest = WordIndex(words).nearest(codes)
    return float((unit_rows(codes) * unit_rows(words[nearest])).sum(axis=1).mean())


def cluster(codes: Bytes, size: int, rng: np.random.Generator) -> Bytes:
    """Spherical k-means in two levels. (n, D) uint8 -> (size, D) uint8 distinct words in random order"""
    rows = unit_rows(codes)
    coarse = max(1, round(size**0.5))
    cells = _assign(rows, _kmeans(rows, coarse, rng))
    order = np.argsort(cells, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(cells, minlength=coarse))[:-1])
    shares = _apportion(np.array([len(rows_of_cell) for rows_of_cell in members]), size)
    centres = []
    with Progress("clustering", size) as progress:
        for rows_of_cell, share in zip(members, shares, strict=True):
            if share:
                centres.append(_kmeans(rows[rows_of_cell], int(share), rng))
            progress.advance(int(share))
    words = np.clip(np.rint(np.concatenate(centres) * NORM), 0, 255).astype(np.uint8)
    return rng.permutation(_distinct(words, codes, rng))


def _kmeans(rows: Floats, k: int, rng: np.random.Generator) -> Floats:
    """(n, D) unit rows -> (k, D) unit centres"""
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
    """The centre of greatest cosine of each row; (n, D), (k, D) -> (n,)"""
    step = 65_536  # rows at a time, to bound the memory for scores
    return np.concatenate([(rows[start : start + step] @ centres.T).argmax(axis=1) for start in range(0, len(rows), step)])


def _apportion(counts: np.ndarray, size: int) -> np.ndarray:
    """Split `size` words in proportion to `counts` by largest remainders, no cell getting more words than descriptors."""
    exact = counts * (size / counts.sum())
    shares = np.floor(exact).astype(np.int64)
    missing = size - shares.sum()
    shares[np.argsort(shares - exact, kind="stable")[:missing]] += 1
    return np.minimum(shares, counts)


def _distinct(words: Bytes, codes: Bytes, rng: np.random.Generator) -> Bytes:
    """Replace words that are zero or stand twice after rounding by descriptors that are not words yet."""
    wanted = len(words)
    kept = np.unique(words[words.any(axis=1)], axis=0)
    while len(kept) < wanted:
        spare = codes[rng.choice(len(codes), min(len(codes), 4 * (wanted - len(kept))), replace=False)]
        grown = np.unique(np.concatenate([kept, spare]), axis=0)
        if len(grown) == len(kept) and len(np.unique(codes, axis=0)) + len(kept) < wanted:
            raise UserError(f"--size {wanted}: there are not so many distinct descriptors; ask for fewer words")
        kept = grown
    return kept[rng.choice(len(kept), wanted, replace=False)] if len(kept) > wanted else kept
