"""Compares features under the same defenses at equal numbers of keypoints, and writes docs/results/features.md.

    python tools/measure_features.py --work work/features

1. Reconstruction and identification of the built-in photographs. Each learned extractor returns as many keypoints of a photograph
   as upright SIFT finds in it, within the limits of its networks.
2. Localization in a small gallery, with the same limit of keypoints.

Records in WORK are reused, so an interrupted run resumes.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from result_page import RECALLS, SMALL_GALLERY, format_interval, list_values, write_page

import bench
from bench.api import Defense, Extractor
from bench.codebook.public import Public
from bench.core.table import markdown_row
from bench.extractors.sift import Sift
from bench.images.photographs import Source, crop_square, decode, list_builtin
from bench.images.views import LIMIT
from bench.registry import discovery, spec
from bench.runner.records import Record
from leaderboard.intervals import interval

TITLE = """# Features under the same defenses

Releases of the seven built-in photographs, 256 by 256 pixels, seed 0. XFeat and ALIKED return as many keypoints as upright SIFT
finds in the photograph, but at least {low} and at most {high}, for which their networks were trained. Oriented SIFT returns all
that it finds. In brackets: 95% intervals of Student's t over photographs.

*true word*: chance that a word set contains the descriptor's own word. It depends on ε and on the size of the dictionary: 256,000
words for SIFT, 16,000 for the others. Equal ε are therefore no equal leakage.

The networks differ in size and training (model card). The words of SIFT are weighed by a context model first; the other
features have none. So a lower score of a learned feature is no evidence that it leaks less.
"""
LIMITS = (250, 1000)  # keypoints for which the networks of the learned features were trained
EXTRACTORS = {"sift": "", "sift:upright=false": "", "xfeat": "shipped-xfeat", "aliked": "shipped-aliked"}  # -> their words
DEFENSES = ("none", "affine:dim=4", "ldp:epsilon=12", "ldp:epsilon=10", "ldp:epsilon=8")
ATTACKS = ("dia", "keypoints", "blank")
FIELDS = {"affine": "database", "ldp": "dictionary"}  # of the words
SHOWN = {"ssim": 3, "psnr": 2, "identified": 3}  # metric -> digits
LOCALIZED = ("none", "affine:dim=4", "ldp:epsilon=12", "ldp:epsilon=10")


class Row(NamedTuple):
    """One row of a table."""

    extractor: str
    defense: str
    attack: str
    true_word: float  # chance; NaN without words
    records: list[Record]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder of records, reused between runs")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    attacked = list(attack_features(args.work / "attacks"))
    localized = list(localize(args.work / "localization"))
    records = [record for row in (*attacked, *localized) for record in row.records]
    parts = [TITLE.format(low=LIMITS[0], high=LIMITS[1]), write_attacks(attacked), write_localization(localized)]
    write_page("features.md", "\n".join(parts), records)


def attack_features(work: Path) -> Iterator[Row]:
    """Yield the results of each attack on each defense of each extractor, over the photographs."""
    attacks = [spec.read(attack, discovery.ATTACK) for attack in ATTACKS]
    sources = list_builtin()
    counts = [count_keypoints(source) for source in sources]
    for name, words in EXTRACTORS.items():
        extractor = spec.read(name, discovery.EXTRACTOR)
        limited = [limit_keypoints(extractor, count) if words else extractor for count in counts]
        for text in DEFENSES:
            defense = read_defense(text, words)
            print(name, text, flush=True)
            records = [
                record
                for source, limit in zip(sources, limited, strict=True)
                for record in bench.run([defense], attacks, [source], extractor=limit, out=work)
            ]
            for attack in ATTACKS:
                used = [record for record in records if record["attack"]["name"] == attack]
                yield Row(name, text, attack, find_true_word_chance(defense), used)


def count_keypoints(source: Source) -> int:
    """Return the number of keypoints that upright SIFT finds in a photograph, within `LIMITS`."""
    return int(np.clip(len(Sift().extract(crop_square(decode(source.path)[0], 256), source)), *LIMITS))


def limit_keypoints(extractor: Extractor, count: int) -> Extractor:
    limited: Extractor = dataclasses.replace(extractor, **{LIMIT: count})  # type: ignore[type-var]
    return limited


def read_defense(text: str, words: str) -> Defense:
    """Return a defense that uses the words of an extractor; an empty string stands for the defense's own default."""
    name = text.partition(":")[0]
    given = f"{FIELDS[name]}={words}" if words and name in FIELDS else ""
    return spec.read(f"{text},{given}" if given and ":" in text else text, discovery.DEFENSE)


def find_true_word_chance(defense: Defense) -> float:
    log10_true = defense.privacy(Public()).log10_true
    return float("nan") if log10_true is None else 10**log10_true


def localize(work: Path) -> Iterator[Row]:
    """Yield the localization of each defense's releases of each extractor."""
    for name, words in EXTRACTORS.items():
        for text in LOCALIZED:
            defense = read_defense(text, words)
            print("localization", name, text, flush=True)
            records = bench.run(
                [defense],
                extractor=spec.read(name, discovery.EXTRACTOR),
                task=spec.read("localization", discovery.TASK),
                dataset=spec.read(SMALL_GALLERY, discovery.DATASET),
                out=work,
            )
            yield Row(name, text, "", find_true_word_chance(defense), records)


def write_attacks(rows: Sequence[Row]) -> str:
    """Write the table of attacks. A row without a score is n/a."""
    lines = [
        "## Reconstruction and identification",
        "",
        markdown_row(("features", "keypoints", "defense", "true word", "attack", "SSIM", "PSNR", "identified")),
        markdown_row(["---"] * 8),
    ]
    for row in rows:
        scores = {metric: list_values(row.records, metric) for metric in SHOWN}
        cells = [format_interval(interval(scores[metric]), digits) for metric, digits in SHOWN.items() if len(scores[metric])]
        keypoints = list_values(row.records, "keypoints")
        middle = f"{np.median(keypoints):.0f}" if len(keypoints) else ""
        chance = "" if np.isnan(row.true_word) else f"{row.true_word:.2f}"
        cells = cells or ["n/a", "", ""]
        lines.append(markdown_row((f"`{row.extractor}`", middle, f"`{row.defense}`", chance, f"`{row.attack}`", *cells)))
    return "\n".join([*lines, ""])


def write_localization(rows: Sequence[Row]) -> str:
    """Write the table of localization."""
    lines = [
        "## Localization",
        "",
        f"Dataset `{SMALL_GALLERY}`, at most 1,000 keypoints an image. A small scene, so differences of a few queries mean "
        "nothing. Fraction of queries within the thresholds.",
        "",
        markdown_row(("features", "defense", "true word", "queries", *RECALLS.values(), "matches")),
        markdown_row(["---"] * 8),
    ]
    for row in rows:
        recalls = [f"{values.mean():.2f}" if len(values := list_values(row.records, metric)) else "n/a" for metric in RECALLS]
        chance = "" if np.isnan(row.true_word) else f"{row.true_word:.2f}"
        matches = list_values(row.records, "matches")
        middle = f"{np.median(matches):.0f}" if len(matches) else ""
        lines.append(markdown_row((f"`{row.extractor}`", f"`{row.defense}`", chance, len(row.records), *recalls, middle)))
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    main()
