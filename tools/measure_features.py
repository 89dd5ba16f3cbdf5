"""Compares features under the same defenses, and writes docs/results/features.md.

    python tools/measure_features.py --work work/features

1. Reconstruction and identification of the built-in photographs. The learned extractors return as many keypoints of a photograph
   as upright SIFT finds in it.
2. Localization in a small gallery, with the same limit of keypoints.

A row that cannot be measured is n/a with its reason, such as features without a trained network. Records in WORK are reused, so
an interrupted run resumes.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from result_page import RECALLS, SMALL_GALLERY, format_interval, list_values, write_page

import bench
from bench.api import Defense
from bench.core.errors import UserError
from bench.core.table import markdown_row
from bench.extractors.sift import Sift
from bench.images.photographs import Source, list_builtin, read
from bench.images.views import LIMIT
from bench.registry import discovery, spec
from bench.runner.records import Record
from leaderboard.intervals import interval

TITLE = """# Features under the same defenses

Releases of the {count} built-in photographs in which upright SIFT finds {low} to {high} keypoints, 256 by 256 pixels, seed 0. For
each photograph, `xfeat` and `aliked` return as many keypoints as upright SIFT. Oriented SIFT finds the same points, and describes
a point with several main orientations once for each, up to 1,000 descriptors. In brackets: 95% intervals of Student's t over
photographs, which can exceed a metric's range.

- *true word*: chance that a word set contains the descriptor's own word. It depends on ε and on the size of the dictionary:
  256,000 words for SIFT, 16,000 for the others. Equal ε are therefore no equal leakage.
- Both kinds of SIFT use the dictionary of upright descriptors.
- The networks differ in training ([model card](../../bench/assets/MODEL_CARD.md)). The words of SIFT are weighed by a context
  model first, and the other features have none. So a lower score of a learned feature is no evidence that it leaks less.
"""
LIMITS = (250, 1000)  # keypoints for which the networks of the learned features are trained
EXTRACTORS = {  # -> their words; empty for the defaults of the defenses
    "sift": "",
    "sift:upright=false": "",
    "xfeat": "shipped-xfeat",
    "aliked:detection_threshold=0": "shipped-aliked",  # with a threshold it finds fewer than SIFT
}
FIELDS = {"affine": "database", "ldp": "dictionary"}  # of the words
DEFENSES = ("none", "affine:dim=4", "ldp:epsilon=12", "ldp:epsilon=10", "ldp:epsilon=8")
ATTACKS = ("dia", "database", "keypoints", "blank")
LOCALIZED = ("none", "affine:dim=4", "ldp:epsilon=12", "ldp:epsilon=10")
SHOWN = {"ssim": 3, "psnr": 2, "identified": 3}  # metric -> digits


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One row of a table."""

    features: str
    defense: str
    attack: str = ""
    records: Sequence[Record] = ()  # those with scores
    reason: str = ""  # why there are none


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder of records, reused between runs")
    args = parser.parse_args()
    write_results(args.work, list_builtin(), SMALL_GALLERY)


def write_results(work: Path, sources: Sequence[Source], dataset: str) -> None:
    """Measure what the folder lacks, and write the page."""
    work.mkdir(parents=True, exist_ok=True)
    low, high = LIMITS
    counts = {source: count for source in sources if low <= (count := count_keypoints(source)) <= high}
    attacked, localized = list(attack_features(work / "attacks", counts)), list(localize(work / "localization", dataset))
    parts = [TITLE.format(count=len(counts), low=low, high=high), write_attacks(attacked), write_localization(localized, dataset)]
    write_page("features.md", "\n".join(parts), [record for row in (*attacked, *localized) for record in row.records])


def attack_features(work: Path, counts: Mapping[Source, int]) -> Iterator[Row]:
    """Yield the results of each attack on each defense of each extractor, over the photographs with their keypoints."""
    for features, defense in itertools.product(EXTRACTORS, DEFENSES):
        print(features, defense, flush=True)
        attacks = list_attacks(defense)
        records, reason = measure(functools.partial(run_attacks, features, defense, attacks, counts, work))
        for attack in attacks:
            yield build_row(features, defense, [one for one in records if one["attack"]["name"] == attack], reason, attack)


def list_attacks(defense: str) -> list[str]:
    """Return the attacks on this kind of release."""
    releases = spec.read(defense, discovery.DEFENSE).releases
    return [name for name in ATTACKS if issubclass(releases, spec.read(name, discovery.ATTACK).accepts)]


def run_attacks(features: str, defense: str, names: Sequence[str], counts: Mapping[Source, int], work: Path) -> list[Record]:
    """Run the attacks. The extractor of each photograph has a limit of its own, so each photograph is a run."""
    attacks = [spec.read(name, discovery.ATTACK) for name in names]
    protection = read_defense(defense, EXTRACTORS[features])
    extractor: Any = spec.read(features, discovery.EXTRACTOR)
    records = []
    for source, limit in counts.items():
        limited = dataclasses.replace(extractor, **{LIMIT: limit}) if EXTRACTORS[features] else extractor
        records += bench.run([protection], attacks, [source], extractor=limited, out=work)
    return records


def localize(work: Path, dataset: str) -> Iterator[Row]:
    """Yield the localization of each defense's releases of each extractor."""
    for features, defense in itertools.product(EXTRACTORS, LOCALIZED):
        print("localization", features, defense, flush=True)
        yield build_row(features, defense, *measure(functools.partial(run_localization, features, defense, dataset, work)))


def run_localization(features: str, defense: str, dataset: str, work: Path) -> list[Record]:
    return bench.run(
        [read_defense(defense, EXTRACTORS[features])],
        extractor=spec.read(features, discovery.EXTRACTOR),
        task=spec.read("localization", discovery.TASK),
        dataset=spec.read(dataset, discovery.DATASET),
        out=work,
    )


def measure(run: Callable[[], list[Record]]) -> tuple[list[Record], str]:
    """Return the records of a run, and the reason if this installation lacks an extractor or a dictionary."""
    try:
        return run(), ""
    except UserError as error:
        return [], str(error)


def build_row(features: str, defense: str, records: Sequence[Record], reason: str, attack: str = "") -> Row:
    """Return a row of the records with scores, or with the reason of the first that has none."""
    without = [record["reason"] for record in records if record["status"] != "ok"]
    if reason or without:
        return Row(features=features, defense=defense, attack=attack, reason=reason or without[0])
    return Row(features=features, defense=defense, attack=attack, records=records)


def count_keypoints(source: Source) -> int:
    """Return the number of keypoints that upright SIFT finds in a photograph."""
    return len(Sift().extract(read(source).pixels, source))


def read_defense(text: str, words: str) -> Defense:
    """Return a defense that uses the words of an extractor; an empty string stands for the defense's own default."""
    field = FIELDS.get(text.partition(":")[0])
    given = f"{',' if ':' in text else ':'}{field}={words}" if words and field else ""
    return spec.read(text + given, discovery.DEFENSE)


def format_true_word(row: Row) -> str:
    """Return the chance that a word set contains the true word; an empty text without words."""
    log10_true = row.records[0]["privacy"].get("log10_true") if row.records else None
    return "" if log10_true is None else f"{10**log10_true:.2f}"


def write_attacks(rows: Sequence[Row]) -> str:
    """Write the table of attacks."""
    lines = [
        "## Reconstruction and identification",
        "",
        "*identified*: [reciprocal rank](../method.md#identification) of the photograph among 256, the mean over photographs.",
        "*first*: photographs of rank 1. *keypoints*: the median over photographs.",
        "",
        markdown_row(("features", "keypoints", "defense", "true word", "attack", "SSIM", "PSNR", "identified", "first")),
        markdown_row(["---"] * 9),
    ]
    for row in rows:
        values = {metric: list_values(row.records, metric) for metric in SHOWN}
        scores = [format_interval(interval(values[metric]), digits) for metric, digits in SHOWN.items() if row.records]
        scores += [f"{int((values['identified'] == 1).sum())} of {len(row.records)}"] if row.records else []
        counts = [record["privacy"]["keypoints"] for record in row.records]
        middle = f"{np.median(counts):.0f}" if counts else ""
        names = f"`{row.features}`", middle, f"`{row.defense}`", format_true_word(row), f"`{row.attack}`"
        lines.append(markdown_row((*names, *(scores or ["n/a", "n/a", "n/a", "n/a"]))))
    return "\n".join([*lines, "", *list_reasons(rows), ""])


def write_localization(rows: Sequence[Row], dataset: str) -> str:
    """Write the table of localization."""
    lines = [
        "## Localization",
        "",
        f"Dataset `{dataset}`, at most 1,000 keypoints an image. A difference of one or two of its queries is no evidence. The",
        "thresholds have the fractions of all queries. *matches*: the median over queries.",
        "",
        markdown_row(("features", "defense", "true word", "queries", *RECALLS.values(), "matches")),
        markdown_row(["---"] * (5 + len(RECALLS))),
    ]
    for row in rows:
        recalls = [f"{list_values(row.records, metric).mean():.2f}" if row.records else "n/a" for metric in RECALLS]
        matches = list_values(row.records, "matches")
        middle = f"{np.median(matches):.0f}" if len(matches) else ""
        count = str(len(row.records)) if row.records else ""
        lines.append(markdown_row((f"`{row.features}`", f"`{row.defense}`", format_true_word(row), count, *recalls, middle)))
    return "\n".join([*lines, "", *list_reasons(rows), ""])


def list_reasons(rows: Sequence[Row]) -> list[str]:
    """Return the reasons of the rows without scores, each once with its rows."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if row.reason:
            name = f"`{row.features}` with `{row.defense}`" + (f" under `{row.attack}`" if row.attack else "")
            reasons.setdefault(row.reason, []).append(name)
    return ["n/a:", "", *(f"- {', '.join(names)}: {reason}" for reason, names in reasons.items())] if reasons else []


if __name__ == "__main__":
    main()
