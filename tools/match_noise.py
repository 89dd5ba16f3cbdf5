"""Matched-noise control: finds Gaussian noise with the utility of each defense, attacks both, and compares their leakage.

    python tools/match_noise.py --defense affine:dim=4 --defense ldp:epsilon=12 --work work/noise

The utility is the matching score: the mean recall of the task `matching` between rendered views of the built-in photographs. It
falls as sigma grows, so bisection finds the sigma of each defense. All attacks run on the defenses and on the noise. Writes
docs/results/matched-noise.md. Records in WORK are reused, so an interrupted run resumes, and `bench leaderboard --results WORK`
shows the control on each row.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from result_page import list_values, write_page

import bench
from bench.api import Defense, Extractor
from bench.core.errors import UserError
from bench.core.table import markdown_row, to_markdown
from bench.registry import discovery, spec
from bench.runner import attack_suite
from bench.runner.records import Record
from bench.tasks.matching import Matching
from defenses.noise import Noise
from leaderboard.comparison import LocatedRecord, build_groups
from leaderboard.noise_control import get_tolerance
from leaderboard.suite_table import build_group_tables

TITLE = """# Matched-noise control

Each defense beside Gaussian noise on raw descriptors with the same matching score. At an equal score, noise can have a lower
*precision*, and then serves a server less. [Standard suite](../standard-suite.md#matched-noise-control) explains the comparison.

{adapted}
"""
ADAPTED = "`dia` reads the noise with a network that was trained for it."
UNADAPTED = (
    "No network was trained for noise. The attacks on it are `denoise`, which estimates descriptors for the network for raw "
    "ones, and the baselines. An adapted network may find more. So no defense has the flag *leaks more than noise* here."
)
SCORE = "recall"  # of the task `matching`
LARGEST = 16.0  # sigma; at it hardly any descriptor finds its match
EVALUATIONS = 14  # of the matching score, for each defense
DENOISE = tuple(f"denoise:estimate={estimate}" for estimate in ("released", "word", "mean"))


@dataclass(frozen=True, kw_only=True)
class Utility:
    """Means over pairs of images."""

    score: float  # the matching score
    precision: float


@dataclass(frozen=True, kw_only=True)
class Match:
    """Noise with the utility of a defense."""

    sigma: float
    noise: Utility
    target: Utility  # of the defense

    @property
    def difference(self) -> float:
        """The absolute difference of the scores."""
        return abs(self.noise.score - self.target.score)

    @property
    def is_close(self) -> bool:
        """Whether the scores are equal within the tolerance of the leaderboard."""
        return self.difference <= get_tolerance(self.target.score)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--defense", action="append", required=True, metavar="SPEC", help="may be repeated")
    parser.add_argument("--attack", action="append", metavar="SPEC", help="an attack or a suite (default: the latest suite)")
    further = "further attacks, of which denoise reads noise (default: %(default)s)"
    parser.add_argument("--noise-attack", nargs="*", default=DENOISE, metavar="SPEC", help=further)
    parser.add_argument("--network", type=Path, help="a network of `bench train --defense noise`, for dia")
    parser.add_argument("--images", type=Path, help="photographs to attack (default: built-in)")
    parser.add_argument("--extractor", default="sift", metavar="SPEC")
    parser.add_argument("--each", type=int, default=4, help="pairs for each photograph (default: %(default)s)")
    parser.add_argument("--work", type=Path, required=True, help="folder of records, reused between runs")
    args = parser.parse_args()
    network = [f"dia:weights={args.network}"] if args.network else []
    attacks = [*(args.attack or attack_suite.list_attack_suites()[-1:]), *args.noise_attack, *network]
    extractor: Extractor = spec.read(args.extractor, discovery.EXTRACTOR)
    try:
        matches, records = measure(args.defense, attacks, args.images, extractor, args.each, args.work)
    except UserError as error:
        parser.error(str(error))
    write_page("matched-noise.md", format_page(matches, records, bool(args.network)), records)


def measure(
    texts: Sequence[str], attacks: Sequence[str], images: Path | None, extractor: Extractor, each: int, work: Path
) -> tuple[dict[str, Match | str], list[Record]]:
    """Return the noise of each defense, and the records of the attacks on both and of their utility.

    A defense without a matching score has the reason instead.
    """
    utilities: list[Record] = []

    @functools.cache  # noise of one sigma is measured once, for all defenses
    def match(defense: Defense) -> Utility:
        records = bench.run([defense], task=Matching(each=each), extractor=extractor, out=work / "utility")
        utilities.extend(records)
        return average_utility(records)

    matches: dict[str, Match | str] = {}
    defenses = [spec.read(text, discovery.DEFENSE) for text in texts]
    for text, defense in zip(texts, defenses, strict=True):
        try:
            target = match(defense)
        except UserError as error:  # such as hidden positions
            matches[text] = str(error)
            continue
        found = matches[text] = find_sigma(target, lambda sigma: match(Noise(sigma=sigma)))
        print(f"{text}: {SCORE} {found.target.score:.4f}, sigma {found.sigma:g}: {found.noise.score:.4f}", flush=True)
    close = [found.sigma for found in matches.values() if isinstance(found, Match) and found.is_close]
    noises = [Noise(sigma=sigma) for sigma in dict.fromkeys(close)]
    attackers = attack_suite.read_attacks(attacks)
    return matches, [*bench.run([*defenses, *noises], attackers, images, extractor=extractor, out=work / "attacks"), *utilities]


def average_utility(records: Sequence[Record]) -> Utility:
    """Return the mean over the records of one defense.

    Raises
    ------
    UserError
        if it has none.
    """
    values = list_values(records, SCORE)
    if len(values) == 0:
        raise UserError(f"the defense has no matching score: {records[0]['reason']}")
    return Utility(score=float(values.mean()), precision=float(list_values(records, "precision").mean()))


def find_sigma(target: Utility, match: Callable[[float], Utility]) -> Match:
    """Return the noise whose score is nearest to the target, among the ends of the range and the steps of a bisection.

    `match` returns the utility of a sigma, whose score falls as sigma grows. The bisection ends at half the tolerance, or after
    `EVALUATIONS`.
    """
    low, high = 0.0, LARGEST
    matches = [Match(sigma=sigma, noise=match(sigma), target=target) for sigma in (low, high)]
    if matches[1].noise.score < target.score < matches[0].noise.score:
        while len(matches) < EVALUATIONS and matches[-1].difference > get_tolerance(target.score) / 2:
            middle = (low + high) / 2
            matches.append(Match(sigma=middle, noise=match(middle), target=target))
            low, high = (middle, high) if matches[-1].noise.score > target.score else (low, middle)
    return min(matches, key=lambda one: one.difference)


def format_page(matches: Mapping[str, Match | str], records: Sequence[Record], adapted: bool) -> str:
    """Return the page: the noise of each defense, and the worst cases by the measures that rank defenses."""
    groups = build_groups([LocatedRecord(record, Path()) for record in records])
    built = [build_group_tables(group, groups, brief=True) for group in groups if group.has_attacks]
    tables = [tables["worst-case"] for tables in built if tables]
    title = TITLE.format(adapted=ADAPTED if adapted else UNADAPTED)
    return "\n".join([title, *format_matches(matches), "", *(to_markdown(table) for table in tables)])


def format_matches(matches: Mapping[str, Match | str]) -> Iterator[str]:
    """Yield the table of the noise of each defense. Without noise of equal score it states the nearest one."""
    yield markdown_row(("defense", "matching score", "precision", "sigma", "matching score of the noise", "its precision"))
    yield markdown_row(["---"] * 6)
    for text, match in matches.items():
        if isinstance(match, str):
            yield markdown_row((f"`{text}`", f"n/a: {match}", "", "", "", ""))
            continue
        sigma = f"{match.sigma:g}" if match.is_close else f"n/a: nearest is {match.sigma:g}"
        numbers = (f"{value:.3f}" for each in (match.target, match.noise) for value in (each.score, each.precision))
        score, precision, *others = numbers
        yield markdown_row((f"`{text}`", score, precision, sigma, *others))


if __name__ == "__main__":
    main()
