"""Chooses τ of the task `collisions` on photographs of `tune.txt`, on which nothing is reported, and writes it to docs/tuning.md.

    python tools/tune_collisions.py --data ../shared/data

A collision is meant to say that the clustering attack cannot tell d from the words beside it. So the τ is chosen at which "no
collision" goes best with the attack's success, which is that its estimate is nearer to d than to any a_i: that of the greatest
Pr(no collision | success) − Pr(no collision | failure) (Youden 1950), averaged over the dimensions.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tune_attacks import row, write

from attacks.clustering import Clustering
from bench.api import View
from bench.codebook.public import Public
from bench.core.progress import Progress
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import compute_intersection_distances, find_shared_sub_database
from bench.images import photographs
from bench.images.photographs import Source
from bench.runner.other_releases import ReleasePool
from bench.tasks.collisions import is_collision_free
from bench.threat_model import Knowledge, OtherReleases, PublicDatabase
from defenses.affine import Affine

DIMS = (2, 4, 8, 16)
TOLERANCES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
SEED = 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of tune.txt and train/")
    parser.add_argument(
        "--photographs", type=int, default=8, help="that are lifted; releases of others come from all of tune.txt"
    )
    args = parser.parse_args()
    sources = [Source(name, args.data / "train" / name) for name in (args.data / "tune.txt").read_text().split()]
    told = np.empty((len(DIMS), len(TOLERANCES)))  # Youden's J
    clear = np.empty_like(told)  # share without a collision
    success = np.empty(len(DIMS))
    with Progress("collisions", len(DIMS) * args.photographs) as progress:
        for place, dim in enumerate(DIMS):
            found = list(measured(dim, sources, args.photographs, progress))
            right, nearest = np.concatenate([one[0] for one in found]), np.concatenate([one[1] for one in found])
            success[place] = right.mean()
            for column, tolerance in enumerate(TOLERANCES):
                without = is_collision_free(nearest, tolerance)
                told[place, column] = without[right].mean() - without[~right].mean()
                clear[place, column] = without.mean()
    write("collisions", report(told, clear, success, args.photographs))


def measured(dim: int, sources: list[Source], count: int, progress: Progress) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of each of the first photographs: where the attack succeeds, (N,), and what `no_collision` is computed from, (N, 1 + a)."""
    public, extractor, defense, attack = Public(), Sift(), Affine(dim=dim), Clustering()
    words = unit_rows(public.dictionary(defense.database).words)
    population = ReleasePool(sources, extractor, defense, public, partial(drawn, dim))
    for number, source in enumerate(sources[:count]):
        secret = extractor.extract(photographs.read(source.path).pixels)
        lifted = defense.lift(secret, public, np.random.default_rng([SEED, dim, number]))
        knowledge: dict[type[Knowledge], Callable[[], Any]] = {
            PublicDatabase: lambda: PublicDatabase(words=public.dictionary(attack.database).words),
            OtherReleases: lambda: OtherReleases(draw=population.without(source.name)),
        }
        seen = View(release=lifted.release, defense=defense, extractor=extractor, knowledge=knowledge)
        estimate = attack.recover(seen, np.random.default_rng(SEED))
        points = np.concatenate([secret.descriptors[:, None], words[lifted.words]], axis=1)  # (N, 1 + a, D)
        right = (points @ estimate[:, :, None])[:, :, 0].argmax(axis=1) == 0
        shared = find_shared_sub_database(lifted.release, seen.know(OtherReleases).draw(attack.others), defense.adversarial, attack.coverage)
        progress.advance(note=f"dim {dim}, {shared.summary()}")
        yield right, compute_intersection_distances(points.astype(np.float64), shared)


def drawn(dim: int, *parts: object) -> np.random.Generator:
    """A generator for each release of the population."""
    return np.random.default_rng([SEED, dim, *str(parts).encode()])


def report(told: np.ndarray, clear: np.ndarray, success: np.ndarray, count: int) -> str:
    """The section of docs/tuning.md."""
    best = int(told.mean(axis=0).argmax())
    lines = [
        f"`python tools/tune_collisions.py --data DATA --photographs {count}`: τ of the task `collisions`, by how well *no "
        "collision* goes with the success of the clustering attack. Cells: Pr(no collision | success) less Pr(no collision | "
        "failure), and the share without a collision.",
        "",
        f"Chosen: `tolerance={TOLERANCES[best]:g}`.",
        "",
        row("τ", *(f"dim {dim}, success {share:.3f}" for dim, share in zip(DIMS, success, strict=True)), "mean"),
        row(*["---"] * (len(DIMS) + 2)),
    ]
    for column, tolerance in enumerate(TOLERANCES):
        cells = [f"{one:.3f}, {share:.3f}" for one, share in zip(told[:, column], clear[:, column], strict=True)]
        lines.append(row(f"{tolerance:g}", *cells, f"{told[:, column].mean():.3f}"))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
