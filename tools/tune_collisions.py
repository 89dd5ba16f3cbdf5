"""Chooses τ of the task `collisions`, for `tune_attacks.py`.

A collision should mean that the clustering attack cannot distinguish d from the other words. So τ is chosen such that "no
collision" predicts the success of the attack best. The attack succeeds if its estimate is nearer to d than to any a_i. The
criterion is Pr(no collision | success) − Pr(no collision | failure) (Youden 1950), averaged over the dimensions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from result_page import cache_arrays

from attacks.clustering import Clustering
from bench.api import View
from bench.codebook.public import Public
from bench.core import hashing
from bench.core.progress import Progress
from bench.core.table import markdown_row
from bench.extractors.sift import Sift
from bench.formats.tensor_file import Arrays
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import compute_intersection_distances, find_shared_sub_database
from bench.images import photographs
from bench.images.photographs import Source
from bench.registry import spec
from bench.runner.other_releases import ReleasePool
from bench.tasks.collisions import is_collision_free
from bench.threat_model import Knowledge, OtherReleases, PublicDatabase
from defenses.affine import Affine

DIMS = (2, 4, 8, 16)
TOLERANCES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
PHOTOGRAPHS = 8  # that are lifted; other releases are of all
SEED = 0
PUBLIC, EXTRACTOR, ATTACK = Public(), Sift(), Clustering()


def tune(sources: Sequence[Source]) -> str:
    """Return a section of docs/results/tuning.md."""
    youden = np.empty((len(DIMS), len(TOLERANCES)))  # Youden's J
    clear = np.empty_like(youden)  # fraction without a collision
    success = np.empty(len(DIMS))
    everyone = hashing.digest([source.content_hash() for source in sources])
    with Progress("collisions", len(DIMS) * PHOTOGRAPHS) as progress:
        for row, dim in enumerate(DIMS):
            defense, results = Affine(dim=dim), []
            pool = ReleasePool(sources, EXTRACTOR, defense, PUBLIC, partial(create_generator, dim))
            for number in range(PHOTOGRAPHS):
                plugins = [spec.to_json_with_digests(plugin, PUBLIC) for plugin in (defense, ATTACK)]
                compute = partial(measure_photograph, defense, sources[number], number, pool)
                results.append(cache_arrays("tune_collisions", [plugins, everyone, number], compute))
                progress.advance(note=f"dim {dim}")
            right, nearest = (np.concatenate([arrays[name] for arrays in results]) for name in ("right", "nearest"))
            success[row] = right.mean()
            for column, tolerance in enumerate(TOLERANCES):
                without = is_collision_free(nearest, tolerance)
                youden[row, column] = without[right].mean() - without[~right].mean()
                clear[row, column] = without.mean()
    return write_section(youden, clear, success)


def measure_photograph(defense: Affine, source: Source, number: int, pool: ReleasePool) -> Arrays:
    """Return the success of the attack, `right`, (N,), and the input of `no_collision`, `nearest`, (N, 1 + a)."""
    words = unit_rows(PUBLIC.dictionary(defense.database).words)
    secret = EXTRACTOR.extract(photographs.read(source.path).pixels)
    lifted = defense.lift(secret, PUBLIC, np.random.default_rng([SEED, defense.dim, number]))
    knowledge: dict[type[Knowledge], Callable[[], Any]] = {
        PublicDatabase: lambda: PublicDatabase(words=PUBLIC.dictionary(ATTACK.database).words),
        OtherReleases: partial(OtherReleases, draw=pool.without(source.name)),
    }
    view = View(release=lifted.release, defense=defense, extractor=EXTRACTOR, knowledge=knowledge)
    estimate = ATTACK.recover(view, np.random.default_rng(SEED))
    points = np.concatenate([secret.descriptors[:, None], words[lifted.words]], axis=1)  # (N, 1 + a, D)
    right = (points @ estimate[:, :, None])[:, :, 0].argmax(axis=1) == 0
    shared = find_shared_sub_database(
        lifted.release, view.know(OtherReleases).draw(ATTACK.others), defense.adversarial, ATTACK.coverage
    )
    return {"right": right, "nearest": compute_intersection_distances(points.astype(np.float64), shared)}


def create_generator(dim: int, *parts: object) -> np.random.Generator:
    """Create a generator for each other release."""
    return np.random.default_rng([SEED, dim, *str(parts).encode()])


def write_section(youden: np.ndarray, clear: np.ndarray, success: np.ndarray) -> str:
    """Write the section. (dims, tolerances), (dims, tolerances), (dims,)"""
    best = int(youden.mean(axis=0).argmax())
    lines = [
        "## collisions",
        "",
        f"τ of the task `collisions`: {PHOTOGRAPHS} photographs. Success is that of `clustering`: its estimate is nearer to the "
        f"descriptor than to any adversarial word. Chosen by the mean over the dimensions: `tolerance={TOLERANCES[best]:g}`.",
        "",
        "Entries: Pr(no collision | success) - Pr(no collision | failure), and the fraction without a collision.",
        "",
        markdown_row(("τ", *(f"dim {dim}, success {each:.3f}" for dim, each in zip(DIMS, success, strict=True)), "mean")),
        markdown_row(["---"] * (len(DIMS) + 2)),
    ]
    for column, tolerance in enumerate(TOLERANCES):
        entries = [f"{one:.3f}, {fraction:.3f}" for one, fraction in zip(youden[:, column], clear[:, column], strict=True)]
        lines.append(markdown_row((f"{tolerance:g}", *entries, f"{youden[:, column].mean():.3f}")))
    return "\n".join([*lines, ""])
