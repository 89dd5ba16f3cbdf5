"""Chooses the settings of attacks on the photographs of `tune.txt`, on which nothing is reported, and writes docs/tuning.md.

    python tools/tune_attacks.py --data ../shared/data [--attack database]

Every setting of an attack's grid recovers the descriptors of the same releases: at each point of the defense, some keypoints of
each photograph. The chosen setting has the smallest angle to the true descriptors, averaged over the points; beside it stands
what the best setting of each point would gain. To have another attack tuned, add it to TUNINGS.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attacks.database import Database
from bench import registry, spec
from bench.datasets import photographs
from bench.errors import UserError
from bench.features.sift import Sift
from bench.kernels.estimates import estimate
from bench.kernels.subspaces import nearest_to_subspaces
from bench.plugin import DescriptorAttack, Lifting, View
from bench.progress import Progress
from bench.public import Public
from bench.tasks.reconstruction import offered
from bench.types import Floats, Knowledge, Subspaces
from metrics.angle import Angle
from metrics.recovered import Recovered

TABLE = Path(__file__).parents[1] / "docs" / "tuning.md"
TITLE = """# How the attacks' settings were chosen

Written by `tools/tune_attacks.py`, on photographs that no result is reported on and that no dictionary was made from.
"""
METRICS = (Angle(), Recovered())


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """An attack, the settings to try, and the points of a defense to try them at."""

    attack: type[DescriptorAttack]
    grid: Mapping[str, Sequence[Any]]
    points: Sequence[str]
    # The estimates of all settings from one view, which share what work they can.
    recover: Callable[[View, Sequence[Any]], Iterator[Floats]]

    @property
    def settings(self) -> dict[str, DescriptorAttack]:
        """Every combination of the grid that the attack takes, by how it is written on the command line."""
        made = {}
        for values in itertools.product(*self.grid.values()):
            given = dict(zip(self.grid, values, strict=True))
            with suppress(UserError):
                made[",".join(f"{field}={value}" for field, value in given.items())] = self.attack(**given)
        return made


def recover_by_database(seen: View, settings: Sequence[Database]) -> Iterator[Floats]:
    """One search for all: fewer neighbours are the first of many."""
    release, defense = seen.release, seen.defense
    assert isinstance(release, Subspaces)
    assert isinstance(defense, Lifting)
    words, adversarial = seen.know(Knowledge.DATABASE).words, defense.adversarial
    most = max(attack.neighbours for attack in settings)
    found, distances = nearest_to_subspaces(release, words, adversarial + most)
    for attack in settings:
        few = slice(adversarial + attack.neighbours)
        yield estimate(release, words, found[:, few], distances[:, few], adversarial, attack.estimators)


TUNINGS = (
    Tuning(
        attack=Database,
        grid={"neighbours": (10, 100, 1000, 2000, 4000, 8000), "estimators": (1, 2, 3, 5, 10)},
        points=("affine:dim=2", "affine:dim=4", "affine:dim=8", "affine:dim=16"),
        recover=recover_by_database,
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [tuning.attack.name() for tuning in TUNINGS]
    parser.add_argument("--data", type=Path, required=True, help="the folder of tune.txt and train/")
    parser.add_argument("--attack", choices=names, action="append", help="one to tune, may be repeated; all by default")
    parser.add_argument("--keypoints", type=int, default=15, help="of each photograph")
    args = parser.parse_args()
    photos = [args.data / "train" / name for name in (args.data / "tune.txt").read_text().split()]
    for tuning in TUNINGS:
        if tuning.attack.name() in (args.attack or names):
            measured = measure(tuning, photos, args.keypoints)  # (points, settings, photographs, metrics)
            section = report(tuning, measured, args.keypoints)
            print(section)
            write(tuning.attack.name(), section)


def measure(tuning: Tuning, photos: Sequence[Path], keypoints: int) -> np.ndarray:
    """Angle and share recovered. -> (points, settings, photographs, 2)"""
    public, extractor = Public(), Sift()
    defenses = [spec.read(point, registry.DEFENSE) for point in tuning.points]
    settings = list(tuning.settings.values())
    values = np.empty((len(defenses), len(settings), len(photos), len(METRICS)))
    with Progress(tuning.attack.name(), len(photos)) as progress:
        for number, path in enumerate(photos):
            secret = extractor.extract(photographs.read(path).pixels, path)
            rng = np.random.default_rng(number)
            secret = secret.take(np.sort(rng.choice(len(secret), min(keypoints, len(secret)), replace=False)))
            for point, defense in enumerate(defenses):
                release = defense.protect(secret, public, np.random.default_rng([number, point]))
                known = offered(settings[0], defense, public)
                seen = View(release=release, defense=defense, extractor=extractor, knowledge=known)
                for setting, found in enumerate(tuning.recover(seen, settings)):
                    values[point, setting, number] = [metric(secret.descriptors, found) for metric in METRICS]
            progress.advance()
    return values


def report(tuning: Tuning, measured: np.ndarray, keypoints: int) -> str:
    """A section of docs/tuning.md. (points, settings, photographs, 2)"""
    angles = measured[..., 0].mean(axis=2)  # (points, settings)
    settings = list(tuning.settings)
    chosen = int(angles.mean(axis=0).argmin())
    lines = [
        f"`python tools/tune_attacks.py --data DATA --attack {tuning.attack.name()} --keypoints {keypoints}`: "
        f"{measured.shape[2]} photographs, {keypoints} keypoints of each, upright SIFT.",
        "",
        f"Chosen, by the mean over the points: `{settings[chosen]}`. Cells: mean angle in degrees, and the share recovered among "
        f"the {keypoints}. What is lost: degrees, with the standard error over photographs.",
        "",
        "| point | chosen | best there | which is | lost |",
        "| --- | --- | --- | --- | --- |",
    ]
    for point, values in zip(tuning.points, measured, strict=True):
        best = int(values[..., 0].mean(axis=1).argmin())
        lost = values[chosen, :, 0] - values[best, :, 0]  # (photographs,)
        error = lost.std(ddof=1) / len(lost) ** 0.5
        lines.append(
            row(f"`{point}`", cell(values[chosen]), cell(values[best]), settings[best], f"{lost.mean():.2f} ± {error:.2f}")
        )
    lines += ["", row("setting", *(f"`{point}`" for point in tuning.points), "mean angle")]
    lines.append(row(*["---"] * (len(tuning.points) + 2)))
    for number, name in enumerate(settings):
        lines.append(row(name, *(cell(values[number]) for values in measured), f"{angles[:, number].mean():.2f}"))
    return "\n".join(lines) + "\n"


def cell(values: np.ndarray) -> str:
    """(photographs, 2)"""
    angle, share = values.mean(axis=0)
    return f"{angle:.2f}° {share:.3f}"


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
