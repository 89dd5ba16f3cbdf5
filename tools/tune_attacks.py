"""Chooses the settings of attacks on the photographs of `tune.txt`, on which nothing is reported, and writes docs/tuning.md.

    python tools/tune_attacks.py --data ../shared/data [--attack database]

Every setting of an attack's grid recovers the descriptors of the same releases: at each point of the defense, some keypoints of
each photograph, or all of a few where releases of others are looked at as well. The chosen setting has the smallest angle to the
true descriptors, averaged over the points; beside it stands what the best setting of each point would gain, and where releases of
others are looked at, the coverage that the attack believes to have. To have another attack tuned, add it to TUNINGS.
"""

from __future__ import annotations

import argparse
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attacks.clustering import Clustering, build_candidates, select_candidates
from attacks.database import Database
from attacks.intersection import Intersection, estimate_descriptors
from bench.api import DescriptorAttack, View, require_subspaces
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.extractors.sift import Sift
from bench.geometry.database_reconstruction import reconstruct_database
from bench.geometry.estimates import estimate
from bench.geometry.intersections import find_intersections_within
from bench.geometry.shared_sub_database import SharedSubDatabase, find_shared_sub_database
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.images import photographs
from bench.images.photographs import Source
from bench.registry import discovery, spec
from bench.runner.other_releases import ReleasePool
from bench.tasks.reconstruction import offer_knowledge
from bench.threat_model import DefenseDatabase, OtherReleases, PublicDatabase
from bench.types import Floats
from metrics.angle import Angle
from metrics.recovered import Recovered

TABLE = Path(__file__).parents[1] / "docs" / "tuning.md"
TITLE = """# How the attacks' settings were chosen

Written by `tools/tune_attacks.py`, on photographs that no result is reported on and that no dictionary was made from.
"""
METRICS = (Angle(), Recovered())
POINTS = ("affine:dim=2", "affine:dim=4", "affine:dim=8", "affine:dim=16")


# The estimates of one setting, and the coverage that it had of the words in the release; NaN where it looks at no other release.
Tried = tuple[Floats, float]


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """An attack, the settings to try, and the points of a defense to try them at."""

    attack: type[DescriptorAttack]
    grid: Mapping[str, Sequence[Any]]
    photographs: int  # of tune.txt
    keypoints: int | None  # of each, or all
    # What all settings make of one view. They share what work they can.
    recover: Callable[[View, Sequence[Any]], Iterator[Tried]]

    @property
    def settings(self) -> dict[str, DescriptorAttack]:
        """Every combination of the grid that the attack takes, by how it is written on the command line."""
        made = {}
        for values in itertools.product(*self.grid.values()):
            given = dict(zip(self.grid, values, strict=True))
            with suppress(UserError):
                made[",".join(f"{field}={value}" for field, value in given.items())] = self.attack(**given)
        return made


def recover_by_database(seen: View, settings: Sequence[Database]) -> Iterator[Tried]:
    """One search for all: fewer neighbours are the first of many."""
    release, adversarial = require_subspaces(seen)
    words = seen.know(DefenseDatabase).words
    most = max(attack.neighbours for attack in settings)
    found, distances = find_nearest_to_subspaces(release, words, adversarial + most)
    for attack in settings:
        few = slice(adversarial + attack.neighbours)
        yield estimate(release, words, found[:, few], distances[:, few], adversarial, attack.estimators), np.nan


def recover_by_clustering(seen: View, settings: Sequence[Clustering]) -> Iterator[Tried]:
    """One search, one clustering for each |V|, and one company for each c."""
    release, adversarial = require_subspaces(seen)
    z = seen.know(PublicDatabase).words
    found, distances = find_nearest_to_subspaces(release, z, max(attack.neighbours for attack in settings))

    @functools.cache
    def of(neighbours: int) -> Any:
        return build_candidates(release, z, found[:, :neighbours], distances[:, :neighbours], adversarial + 1)

    shared = companies(seen)
    for attack in settings:
        kept = shared(attack.others, attack.coverage)
        yield select_candidates(of(attack.neighbours), kept), kept.coverage


def recover_by_intersection(seen: View, settings: Sequence[Intersection]) -> Iterator[Tried]:
    """One company and one rebuilt database for each c."""
    release, adversarial = require_subspaces(seen)
    shared = companies(seen)

    @functools.cache
    def words(others: int, coverage: float) -> Any:
        return reconstruct_database(find_intersections_within(shared(others, coverage).subspaces))

    for attack in settings:
        asked = attack.others, attack.coverage
        yield estimate_descriptors(release, words(*asked), adversarial, attack.neighbours, attack.estimators), shared(*asked).coverage


def companies(seen: View) -> Callable[[int, float], SharedSubDatabase]:
    """From c and the share that is enough to the company of the release, each found once."""
    release, adversarial = require_subspaces(seen)
    others = seen.know(OtherReleases).draw
    return functools.cache(lambda count, enough: find_shared_sub_database(release, others(count), adversarial, enough))


TUNINGS = (
    Tuning(
        attack=Database,
        grid={"neighbours": (10, 100, 1000, 2000, 4000, 8000), "estimators": (1, 2, 3, 5, 10)},
        photographs=100,
        keypoints=15,
        recover=recover_by_database,
    ),
    Tuning(
        attack=Clustering,
        grid={"neighbours": (64, 128, 256, 512, 1024), "others": (100, 200, 400, 800)},
        photographs=8,
        keypoints=None,
        recover=recover_by_clustering,
    ),
    Tuning(
        attack=Intersection,
        grid={"neighbours": (512, 1024, 2048, 4096), "estimators": (1, 2, 4, 8)},
        photographs=4,
        keypoints=None,
        recover=recover_by_intersection,
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [tuning.attack.name() for tuning in TUNINGS]
    parser.add_argument("--data", type=Path, required=True, help="the folder of tune.txt and train/")
    parser.add_argument("--attack", choices=names, action="append", help="one to tune, may be repeated; all by default")
    args = parser.parse_args()
    sources = [Source(name, args.data / "train" / name) for name in (args.data / "tune.txt").read_text().split()]
    for tuning in TUNINGS:
        if tuning.attack.name() in (args.attack or names):
            section = report(tuning, measure(tuning, sources))
            print(section)
            write(tuning.attack.name(), section)


def measure(tuning: Tuning, sources: Sequence[Source]) -> np.ndarray:
    """Angle, share recovered, and coverage. -> (points, settings, photographs, 3)"""
    public, extractor = Public(), Sift()
    defenses = [spec.read(point, discovery.DEFENSE) for point in POINTS]
    populations = [
        ReleasePool(sources, extractor, defense, public, functools.partial(drawn, point))
        for point, defense in enumerate(defenses)
    ]
    settings = list(tuning.settings.values())
    chosen_sources = sources[: tuning.photographs]
    values = np.empty((len(defenses), len(settings), len(chosen_sources), len(METRICS) + 1))
    with Progress(tuning.attack.name(), len(chosen_sources) * len(defenses)) as progress:
        for number, source in enumerate(chosen_sources):
            secret = extractor.extract(photographs.read(source.path).pixels, source.path)
            rng = np.random.default_rng(number)
            if tuning.keypoints is not None:
                secret = secret.take(np.sort(rng.choice(len(secret), min(tuning.keypoints, len(secret)), replace=False)))
            for point, defense in enumerate(defenses):
                release = defense.protect(secret, public, np.random.default_rng([number, point]))
                others = populations[point].without(source.name)
                known = offer_knowledge(settings[0], defense, public) | {OtherReleases: lambda others=others: OtherReleases(draw=others)}
                seen = View(release=release, defense=defense, extractor=extractor, knowledge=known)
                for setting, (found, coverage) in enumerate(tuning.recover(seen, settings)):
                    values[point, setting, number] = [*(metric(secret.descriptors, found) for metric in METRICS), coverage]
                progress.advance()
    return values


def drawn(point: int, *parts: object) -> np.random.Generator:
    """A generator for each release of the population of one point."""
    return np.random.default_rng([point, *str(parts).encode()])


def report(tuning: Tuning, measured: np.ndarray) -> str:
    """A section of docs/tuning.md. (points, settings, photographs, 3)"""
    angles = measured[..., 0].mean(axis=2)  # (points, settings)
    settings = list(tuning.settings)
    best = int(angles.mean(axis=0).argmin())
    keypoints = "all keypoints" if tuning.keypoints is None else f"{tuning.keypoints} keypoints"
    covered = "" if np.isnan(measured[..., 2]).all() else ", and the coverage of the adversarial words by the attack's own count"
    lines = [
        f"`python tools/tune_attacks.py --data DATA --attack {tuning.attack.name()}`: {measured.shape[2]} photographs, "
        f"{keypoints} of each, upright SIFT.",
        "",
        f"Chosen, by the mean over the points: `{settings[best]}`. Cells: mean angle in degrees, the share recovered among "
        f"these keypoints{covered}. What is lost: degrees, with the standard error over photographs.",
        "",
        "| point | chosen | best there | which is | lost |",
        "| --- | --- | --- | --- | --- |",
    ]
    for point, values in zip(POINTS, measured, strict=True):
        there = int(values[..., 0].mean(axis=1).argmin())
        lost = values[best, :, 0] - values[there, :, 0]  # (photographs,)
        error = lost.std(ddof=1) / len(lost) ** 0.5
        lines.append(
            row(f"`{point}`", cell(values[best]), cell(values[there]), settings[there], f"{lost.mean():.2f} ± {error:.2f}")
        )
    lines += ["", row("setting", *(f"`{point}`" for point in POINTS), "mean angle")]
    lines.append(row(*["---"] * (len(POINTS) + 2)))
    for number, name in enumerate(settings):
        lines.append(row(name, *(cell(values[number]) for values in measured), f"{angles[:, number].mean():.2f}"))
    return "\n".join(lines) + "\n"


def cell(values: np.ndarray) -> str:
    """(photographs, 3)"""
    angle, share, coverage = values.mean(axis=0)
    return f"{angle:.2f}° {share:.3f}" + ("" if np.isnan(coverage) else f", {coverage:.2f}")


def row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def write(name: str, section: str) -> None:
    """Put the section in the place of the attack's former one, or at the end."""
    parts = TABLE.read_text(encoding="utf-8").split("\n## ") if TABLE.is_file() else [TITLE]
    sections = dict(part.split("\n", 1) for part in parts[1:]) | {name: "\n" + section}
    text = "".join(f"\n## {title}\n{body.rstrip()}\n" for title, body in sections.items())
    TABLE.write_text(TITLE + text, encoding="utf-8")


if __name__ == "__main__":
    main()
