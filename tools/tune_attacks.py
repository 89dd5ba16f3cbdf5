"""Chooses the settings of attacks on the photographs of `tune.txt`, on which nothing is reported, and writes docs/tuning.md.

    python tools/tune_attacks.py --data ../shared/data [--attack database]

Every setting of an attack's grid recovers the descriptors of the same releases: at each setting of the defense, some keypoints of
each photograph, or all of a few for attacks that use other releases. The chosen setting has the smallest angle to the true
descriptors, averaged over the settings of the defense. The tables also show the gain of the best setting at each of them and, for
attacks that use other releases, the coverage that the attack estimates. To tune another attack, add it to TUNINGS.
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
    """An attack, its grid of settings, and the size of the sample."""

    attack: type[DescriptorAttack]
    grid: Mapping[str, Sequence[Any]]
    photographs: int  # of tune.txt
    keypoints: int | None  # of each, or all
    # Yields the estimates of all settings for one view; the settings share work.
    recover: Callable[[View, Sequence[Any]], Iterator[Tried]]

    @property
    def settings(self) -> dict[str, DescriptorAttack]:
        """Every valid combination of the grid, by its text on the command line."""
        settings = {}
        for values in itertools.product(*self.grid.values()):
            given = dict(zip(self.grid, values, strict=True))
            with suppress(UserError):
                settings[",".join(f"{field}={value}" for field, value in given.items())] = self.attack(**given)
        return settings


def recover_by_database(view: View, settings: Sequence[Database]) -> Iterator[Tried]:
    """Recover with one search for all settings: fewer neighbours are the first of many."""
    release, adversarial = require_subspaces(view)
    words = view.know(DefenseDatabase).words
    most = max(attack.neighbours for attack in settings)
    nearest, distances = find_nearest_to_subspaces(release, words, adversarial + most)
    for attack in settings:
        few = slice(adversarial + attack.neighbours)
        yield estimate(release, words, nearest[:, few], distances[:, few], adversarial, attack.estimators), np.nan


def recover_by_clustering(view: View, settings: Sequence[Clustering]) -> Iterator[Tried]:
    """Recover with one search, one clustering per |V|, and one shared sub-database per c."""
    release, adversarial = require_subspaces(view)
    z = view.know(PublicDatabase).words
    nearest, distances = find_nearest_to_subspaces(release, z, max(attack.neighbours for attack in settings))

    @functools.cache
    def build(neighbours: int) -> Any:
        return build_candidates(release, z, nearest[:, :neighbours], distances[:, :neighbours], adversarial + 1)

    shared = create_sub_database_finder(view)
    for attack in settings:
        sub_database = shared(attack.others, attack.coverage)
        yield select_candidates(build(attack.neighbours), sub_database), sub_database.coverage


def recover_by_intersection(view: View, settings: Sequence[Intersection]) -> Iterator[Tried]:
    """Recover with one shared sub-database and one reconstructed database per c."""
    release, adversarial = require_subspaces(view)
    shared = create_sub_database_finder(view)

    @functools.cache
    def words(others: int, coverage: float) -> Any:
        return reconstruct_database(find_intersections_within(shared(others, coverage).subspaces))

    for attack in settings:
        limits = attack.others, attack.coverage
        yield (
            estimate_descriptors(release, words(*limits), adversarial, attack.neighbours, attack.estimators),
            shared(*limits).coverage,
        )


def create_sub_database_finder(view: View) -> Callable[[int, float], SharedSubDatabase]:
    """Return a function from c and the sufficient coverage to the shared sub-database of the release, each computed once."""
    release, adversarial = require_subspaces(view)
    others = view.know(OtherReleases).draw
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
            section = write_section(tuning, measure(tuning, sources))
            print(section)
            save_section(tuning.attack.name(), section)


def measure(tuning: Tuning, sources: Sequence[Source]) -> np.ndarray:
    """Measure angle, fraction recovered, and coverage. -> (points, settings, photographs, 3)"""
    public, extractor = Public(), Sift()
    defenses = [spec.read(point, discovery.DEFENSE) for point in POINTS]
    pools = [
        ReleasePool(sources, extractor, defense, public, functools.partial(create_generator, point))
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
                others = pools[point].without(source.name)
                knowledge = offer_knowledge(settings[0], defense, public) | {
                    OtherReleases: lambda others=others: OtherReleases(draw=others)
                }
                view = View(release=release, defense=defense, extractor=extractor, knowledge=knowledge)
                for setting, (estimates, coverage) in enumerate(tuning.recover(view, settings)):
                    values[point, setting, number] = [*(metric(secret.descriptors, estimates) for metric in METRICS), coverage]
                progress.advance()
    return values


def create_generator(point: int, *parts: object) -> np.random.Generator:
    """Create a generator for each other release at one setting of the defense."""
    return np.random.default_rng([point, *str(parts).encode()])


def write_section(tuning: Tuning, measured: np.ndarray) -> str:
    """Write a section of docs/tuning.md. (points, settings, photographs, 3)"""
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
            format_row(
                f"`{point}`",
                format_cell(values[best]),
                format_cell(values[there]),
                settings[there],
                f"{lost.mean():.2f} ± {error:.2f}",
            )
        )
    lines += ["", format_row("setting", *(f"`{point}`" for point in POINTS), "mean angle")]
    lines.append(format_row(*["---"] * (len(POINTS) + 2)))
    for number, name in enumerate(settings):
        lines.append(format_row(name, *(format_cell(values[number]) for values in measured), f"{angles[:, number].mean():.2f}"))
    return "\n".join(lines) + "\n"


def format_cell(values: np.ndarray) -> str:
    """Format the means of (photographs, 3)."""
    angle, fraction, coverage = values.mean(axis=0)
    return f"{angle:.2f}° {fraction:.3f}" + ("" if np.isnan(coverage) else f", {coverage:.2f}")


def format_row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def save_section(name: str, section: str) -> None:
    """Replace the section of the attack, or append it."""
    parts = TABLE.read_text(encoding="utf-8").split("\n## ") if TABLE.is_file() else [TITLE]
    sections = dict(part.split("\n", 1) for part in parts[1:]) | {name: "\n" + section}
    text = "".join(f"\n## {title}\n{body.rstrip()}\n" for title, body in sections.items())
    TABLE.write_text(TITLE + text, encoding="utf-8")


if __name__ == "__main__":
    main()
