"""Chooses τ of the task `collisions` on photographs of `tune.txt`, on which nothing is reported, and writes it to docs/tuning.md.

    python tools/tune_collisions.py --data ../shared/data

A collision should mean that the clustering attack cannot distinguish d from the other words. So τ is chosen such that "no
collision" predicts the success of the attack best. The attack succeeds if its estimate is nearer to d than to any a_i. The
criterion is Pr(no collision | success) − Pr(no collision | failure) (Youden 1950), averaged over the dimensions.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tune_attacks import format_row, save_section

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
        "--photographs", type=int, default=8, help="number of lifted photographs; other releases are of all of tune.txt"
    )
    args = parser.parse_args()
    sources = [Source(name, args.data / "train" / name) for name in (args.data / "tune.txt").read_text().split()]
    youden = np.empty((len(DIMS), len(TOLERANCES)))  # Youden's J
    clear = np.empty_like(youden)  # fraction without a collision
    success = np.empty(len(DIMS))
    with Progress("collisions", len(DIMS) * args.photographs) as progress:
        for row, dim in enumerate(DIMS):
            results = list(measure_photographs(dim, sources, args.photographs, progress))
            right, nearest = np.concatenate([one[0] for one in results]), np.concatenate([one[1] for one in results])
            success[row] = right.mean()
            for column, tolerance in enumerate(TOLERANCES):
                without = is_collision_free(nearest, tolerance)
                youden[row, column] = without[right].mean() - without[~right].mean()
                clear[row, column] = without.mean()
    save_section("collisions", write_section(youden, clear, success, args.photographs))


def measure_photographs(
    dim: int, sources: list[Source], count: int, progress: Progress
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield for each of the first photographs the success of the attack, (N,), and the input of `no_collision`, (N, 1 + a)."""
    public, extractor, defense, attack = Public(), Sift(), Affine(dim=dim), Clustering()
    words = unit_rows(public.dictionary(defense.database).words)
    pool = ReleasePool(sources, extractor, defense, public, partial(create_generator, dim))
    for number, source in enumerate(sources[:count]):
        secret = extractor.extract(photographs.read(source.path).pixels)
        lifted = defense.lift(secret, public, np.random.default_rng([SEED, dim, number]))
        knowledge: dict[type[Knowledge], Callable[[], Any]] = {
            PublicDatabase: lambda: PublicDatabase(words=public.dictionary(attack.database).words),
            OtherReleases: partial(OtherReleases, draw=pool.without(source.name)),
        }
        view = View(release=lifted.release, defense=defense, extractor=extractor, knowledge=knowledge)
        estimate = attack.recover(view, np.random.default_rng(SEED))
        points = np.concatenate([secret.descriptors[:, None], words[lifted.words]], axis=1)  # (N, 1 + a, D)
        right = (points @ estimate[:, :, None])[:, :, 0].argmax(axis=1) == 0
        shared = find_shared_sub_database(
            lifted.release, view.know(OtherReleases).draw(attack.others), defense.adversarial, attack.coverage
        )
        progress.advance(note=f"dim {dim}, {shared.summary()}")
        yield right, compute_intersection_distances(points.astype(np.float64), shared)


def create_generator(dim: int, *parts: object) -> np.random.Generator:
    """Create a generator for each other release."""
    return np.random.default_rng([SEED, dim, *str(parts).encode()])


def write_section(youden: np.ndarray, clear: np.ndarray, success: np.ndarray, count: int) -> str:
    """Write the section of docs/tuning.md."""
    best = int(youden.mean(axis=0).argmax())
    lines = [
        f"`python tools/tune_collisions.py --data DATA --photographs {count}`: τ of the task `collisions`, by how well *no "
        "collision* goes with the success of the clustering attack. Cells: Pr(no collision | success) less Pr(no collision | "
        "failure), and the fraction without a collision.",
        "",
        f"Chosen: `tolerance={TOLERANCES[best]:g}`.",
        "",
        format_row("τ", *(f"dim {dim}, success {fraction:.3f}" for dim, fraction in zip(DIMS, success, strict=True)), "mean"),
        format_row(*["---"] * (len(DIMS) + 2)),
    ]
    for column, tolerance in enumerate(TOLERANCES):
        cells = [f"{one:.3f}, {fraction:.3f}" for one, fraction in zip(youden[:, column], clear[:, column], strict=True)]
        lines.append(format_row(f"{tolerance:g}", *cells, f"{youden[:, column].mean():.3f}"))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
