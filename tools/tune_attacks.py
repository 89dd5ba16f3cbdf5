"""Chooses the settings of attacks and of the task `collisions` on the photographs of `tune.txt`; writes docs/results/tuning.md.

    python tools/tune_attacks.py --data ../shared/data

Nothing is reported on these photographs. Results of each photograph are cached, so an interrupted run resumes.

Every setting of an attack's grid recovers the descriptors of the same releases: at each setting of the defense, some keypoints of
each photograph, or all of a few for attacks that use other releases. The chosen setting has the smallest angle to the true
descriptors, averaged over the settings of the defense. The tables also show the best setting at each of them and, for attacks
that use other releases, the coverage that the attack estimates. To tune another attack, add it to TUNINGS.
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
import tune_collisions
from result_page import cache_arrays, write_page

from attacks.clustering import Clustering, build_candidates, select_candidates
from attacks.database import Database
from attacks.intersection import Intersection, estimate_descriptors
from bench.api import DescriptorAttack, View, require_subspaces
from bench.codebook.public import Public
from bench.core import hashing
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.core.table import markdown_row
from bench.extractors.sift import Sift
from bench.geometry.database_reconstruction import reconstruct_database
from bench.geometry.estimates import estimate
from bench.geometry.intersections import find_intersections_within
from bench.geometry.shared_sub_database import SharedSubDatabase, find_shared_sub_database
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.images import photographs
from bench.images.photographs import Source
from bench.registry import spec
from bench.runner.other_releases import ReleasePool
from bench.tasks.reconstruction import offer_knowledge
from bench.threat_model import DefenseDatabase, OtherReleases, PublicDatabase
from bench.types import Floats
from defenses.affine import Affine
from metrics.angle import Angle
from metrics.recovered import Recovered

TITLE = """# Settings of the attacks

The photographs are those of `tune.txt`, 100 of `train/`. No result is reported on them, and no dictionary is built from them.
Features are upright SIFT.
"""
METRICS = (Angle(), Recovered())
DEFENSES = {f"affine:dim={dim}": Affine(dim=dim) for dim in (2, 4, 8, 16)}
PUBLIC, EXTRACTOR = Public(), Sift()


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
    parser.add_argument("--data", type=Path, required=True, help="the folder of tune.txt and train/")
    args = parser.parse_args()
    sources = [Source(name, args.data / "train" / name) for name in (args.data / "tune.txt").read_text().split()]
    sections = [write_section(tuning, measure(tuning, sources)) for tuning in TUNINGS]
    plugins = [*DEFENSES.values(), *(tuning.attack() for tuning in TUNINGS)]
    write_page(
        "tuning.md",
        "\n".join([TITLE, *sections, tune_collisions.tune(sources)]),
        [spec.to_json_with_digests(plugin, PUBLIC) for plugin in plugins],
    )


def measure(tuning: Tuning, sources: Sequence[Source]) -> np.ndarray:
    """Measure angle, fraction recovered, and coverage. -> (defenses, settings, photographs, 3)"""
    values = np.empty((len(DEFENSES), len(tuning.settings), tuning.photographs, len(METRICS) + 1))
    everyone = hashing.digest([source.content_hash() for source in sources])
    with Progress(tuning.attack.name(), len(DEFENSES) * tuning.photographs) as progress:
        for point, defense in enumerate(DEFENSES.values()):
            pool = ReleasePool(sources, EXTRACTOR, defense, PUBLIC, functools.partial(create_generator, point))
            for number in range(tuning.photographs):
                inputs = {
                    "attack": [spec.to_json_with_digests(tuning.attack(), PUBLIC), list(tuning.settings)],
                    "defense": [spec.to_json_with_digests(defense, PUBLIC), point],
                    "photograph": [everyone, number, tuning.keypoints],
                }
                compute = functools.partial(measure_photograph, tuning, sources[number], number, defense, point, pool)
                values[point, :, number] = cache_arrays("tune_attacks", inputs, compute)["values"]
                progress.advance()
    return values


def measure_photograph(
    tuning: Tuning, source: Source, number: int, defense: Affine, point: int, pool: ReleasePool
) -> dict[str, np.ndarray]:
    """Measure all settings on one release. -> `values`, (settings, 3)"""
    secret = EXTRACTOR.extract(photographs.read(source.path).pixels, source)
    if tuning.keypoints is not None:
        count = min(tuning.keypoints, len(secret))
        secret = secret.take(np.sort(np.random.default_rng(number).choice(len(secret), count, replace=False)))
    release = defense.protect(secret, PUBLIC, np.random.default_rng([number, point]))
    settings = list(tuning.settings.values())
    knowledge = offer_knowledge(settings[0], defense, PUBLIC) | {
        OtherReleases: lambda: OtherReleases(draw=pool.without(source.name))
    }
    view = View(release=release, defense=defense, extractor=EXTRACTOR, knowledge=knowledge)
    values = [
        [*(metric(secret.descriptors, estimates) for metric in METRICS), coverage]
        for estimates, coverage in tuning.recover(view, settings)
    ]
    return {"values": np.array(values, dtype=np.float64)}


def create_generator(point: int, *parts: object) -> np.random.Generator:
    """Create a generator for each other release at one setting of the defense."""
    return np.random.default_rng([point, *str(parts).encode()])


def write_section(tuning: Tuning, measured: np.ndarray) -> str:
    """Write a section of the page. (defenses, settings, photographs, 3)"""
    angles = measured[..., 0].mean(axis=2)  # (defenses, settings)
    settings = list(tuning.settings)
    best = int(angles.mean(axis=0).argmin())
    keypoints = "all keypoints" if tuning.keypoints is None else f"{tuning.keypoints} keypoints"
    covered = "" if np.isnan(measured[..., 2]).all() else ", and the coverage of the adversarial words that the attack estimates"
    lines = [
        f"## {tuning.attack.name()}",
        "",
        f"{measured.shape[2]} photographs, {keypoints} of each. Chosen by the mean angle over the defenses: `{settings[best]}`.",
        "",
        f"Entries: mean angle in degrees, fraction recovered among these keypoints{covered}. Loss: difference of the angles in "
        "degrees, with its standard error over photographs.",
        "",
        markdown_row(("defense", "chosen setting", "best setting", "name of the best", "loss")),
        markdown_row(["---"] * 5),
    ]
    for defense, values in zip(DEFENSES, measured, strict=True):
        own = int(values[..., 0].mean(axis=1).argmin())
        loss = values[best, :, 0] - values[own, :, 0]  # (photographs,)
        error = loss.std(ddof=1) / len(loss) ** 0.5
        entries = format_entry(values[best]), format_entry(values[own]), settings[own], f"{loss.mean():.2f} ± {error:.2f}"
        lines.append(markdown_row((f"`{defense}`", *entries)))
    lines += ["", markdown_row(("setting", *(f"`{defense}`" for defense in DEFENSES), "mean angle"))]
    lines.append(markdown_row(["---"] * (len(DEFENSES) + 2)))
    for number, name in enumerate(settings):
        own_entries = (format_entry(values[number]) for values in measured)
        lines.append(markdown_row((name, *own_entries, f"{angles[:, number].mean():.2f}")))
    return "\n".join([*lines, ""])


def format_entry(values: np.ndarray) -> str:
    """Format the means of (photographs, 3)."""
    angle, fraction, coverage = values.mean(axis=0)
    return f"{angle:.2f}° {fraction:.3f}" + ("" if np.isnan(coverage) else f", {coverage:.2f}")


if __name__ == "__main__":
    main()
