"""Compares defenses with the same ε: the reconstruction of an attacker trained for each, and the localization by a server.

    python tools/compare_defenses.py --data ../shared/data --work work/defenses

|K| is 8,000 instead of the paper's 256,000, and its ε of 10 and 12 are reduced by ln 32, so that the chance of the true word in
`ldp` is the same. Each network starts from one for raw descriptors. All are trained equally long, for all settings of their
defense, on photographs that the shipped dictionary was not built from. No choice was made on the test data: `test.txt`, the
built-in photographs, and the gallery. Finished trainings and measurements are reused. Writes docs/results/better-defenses.md.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from make_assets import split_photographs
from result_page import format_interval, write_page

import bench
from attacks.dia import DIA
from attacks.keypoints import Keypoints
from attacks.repeat import Repeat
from bench.api import Attack, Dataset, Defense
from bench.codebook.public import ASSETS
from bench.core.table import markdown_row
from bench.datasets.gallery import Gallery
from bench.extractors.sift import Sift
from bench.images.photographs import list_photographs
from bench.images.scene import Scene
from bench.inversion import weights
from bench.inversion.data import Target
from bench.inversion.plan import Plan, Training
from bench.inversion.train import train
from bench.registry import discovery, spec
from bench.runner.records import Record
from bench.settings import Asset, Between, OneOf
from bench.tasks.localization import Localization
from defenses.none import Undefended
from defenses.privunit import expected_cosine
from leaderboard.intervals import Interval, interval, proportion

WORDS, SHIFT = 8000, math.log(32)  # 256,000 words over these
PAPER_EPSILONS = (10, 12)  # ε of the paper's size
BATCH, RATE = 8, 1e-3
PHOTOGRAPHS, VALIDATION = 48, 6
REPEATS = 8  # releases for `repeat`

EPSILON = Between(5.0, 12.0)
SUPPORTED: dict[str, Mapping[str, Between | OneOf]] = {
    "ldp": {"epsilon": EPSILON, "subset_size": OneOf((1, 2))},
    "plateau": {"epsilon": EPSILON, "subset_size": OneOf((1, 2)), "near": OneOf((2, 4))},
    "privunit": {"epsilon": EPSILON},
    "exponential": {"epsilon": EPSILON},
    "metric-ldp": {"epsilon": Between(10.0, 40.0)},
}
SETTINGS = {  # beside ε and |K|; those that are compared
    "ldp": ("subset_size=1", "subset_size=2"),
    "plateau": ("subset_size=1,near=2", "subset_size=2,near=2", "subset_size=2,near=4"),
    "privunit": ("",),
    "exponential": ("subset_size=1",),
}
DISTANCES = (16, 24)  # ε of metric-ldp, per unit of distance
WITHIN = "recall_0.25m_2deg"
DOMINATES = "**dominates**"
Attacked = Mapping[str, Mapping[str, Sequence[Record]]]  # defense -> attack -> records
Localized = Mapping[str, Sequence[Record]]
BASE = "ldp:subset_size=2"  # the paper's, which the others are compared with


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="folder of networks and records, reused between runs")
    parser.add_argument(
        "--initial-checkpoint",
        type=Path,
        default=ASSETS / "inversion-none.safetensors",
        help="a network for raw descriptors, such as one of tools/measure_encodings.py (default: shipped)",
    )
    parser.add_argument("--steps", type=int, default=300, help="of each network's training (default: %(default)s)")
    parser.add_argument("--tested", type=int, default=100, help="photographs of test.txt (default: %(default)s)")
    parser.add_argument("--queries", type=int, default=120, help="of the gallery (default: %(default)s)")
    parser.add_argument(
        "--networks", nargs="+", choices=SUPPORTED, default=list(SUPPORTED), help="train and attack these (default: all)"
    )
    parser.add_argument("--only", choices=("networks", "attacks", "server"), help="run this part only, without writing the page")
    args = parser.parse_args()
    study = Study(args.data, args.work, args.initial_checkpoint, args.steps, args.tested, args.queries)
    if args.only in (None, "server"):
        study.localize()
    if args.only in (None, "networks", "attacks"):
        networks = {name: study.train_network(name) for name in args.networks}
    if args.only in (None, "attacks"):
        study.attack(networks)
    if args.only is None:
        write_results(study, networks)


def list_rows() -> list[tuple[str, str, str]]:
    """List for each row its comparison group, its name, and the configuration of the defense without its dictionary."""
    rows = []
    for paper in PAPER_EPSILONS:
        for name, settings in SETTINGS.items():
            for setting in settings:
                given = [f"epsilon={paper - SHIFT:.3f}", *([setting] if setting else [])]
                if name != "privunit":
                    given.append(f"words={WORDS}")
                rows.append((f"{paper - SHIFT:.3f}", f"{name}:{setting}".rstrip(":"), f"{name}:{','.join(given)}"))
    by_distance = [(f"{each} per distance", "metric-ldp", f"metric-ldp:epsilon={each},words={WORDS}") for each in DISTANCES]
    return rows + by_distance


@dataclass(frozen=True, kw_only=True)
class FirstQueries(Dataset):
    """The gallery with its first queries, which are by day. References, map and words are those of the whole gallery."""

    first: int

    def scene(self) -> Scene:
        whole = Gallery().scene()
        return replace(whole, queries=whole.queries[: self.first])


class Study:
    """Equally trained networks, their reconstructions, and the localization by a server; each is measured once."""

    def __init__(self, data: Path, work: Path, initial_checkpoint: Path, steps: int, tested: int, queries: int) -> None:
        folders = split_photographs(data, work / "photographs")
        self.work, self.initial_checkpoint, self.steps, self.queries = work, initial_checkpoint, steps, queries
        self.widths = tuple(weights.load(initial_checkpoint).meta["shape"]["widths"])
        self.photographs = list_photographs(folders["2"])[:PHOTOGRAPHS]
        self.validation = list_photographs(folders["tune"])[:VALIDATION]
        self.tested = [data / "train" / name for name in (data / "test.txt").read_text().split()[:tested]]

    def train_network(self, name: str) -> Path:
        """Train the network of a defense, for all its settings."""
        file = self.work / f"{name}-{self.steps}.safetensors"
        given = "" if name == "privunit" else f":words={WORDS}"
        print(f"network for {name}", flush=True)
        plan = Plan(
            targets=[Target(defense=spec.read(name + given, discovery.DEFENSE), supported_settings=SUPPORTED[name])],
            photographs=self.photographs,
            validation=self.validation,
            extractor=Sift(),
            initial_checkpoint=self.initial_checkpoint,
            widths=self.widths,
            training=Training(steps=self.steps, batch=BATCH, rate=RATE, warmup=20),
        )
        train(plan, file)
        return file

    def attack(self, networks: Mapping[str, Path]) -> dict[str, dict[str, list[Record]]]:
        """Run the attacks. -> defense -> attack -> records, those of test.txt before the built-in ones"""
        results: dict[str, dict[str, list[Record]]] = {}
        for name, network in networks.items():
            attacks: list[Attack] = [DIA(weights=Asset(network))]
            if name != "privunit":
                attacks.append(Repeat(releases=REPEATS))
            defenses = [_read_defense(text) for _, _, text in list_rows() if text.partition(":")[0] == name]
            for images in (self.tested, None):
                print(f"attacks on {name}", flush=True)
                records = bench.run(defenses, attacks, images, out=self.work / "attacks")
                for index, record in enumerate(records):
                    pair = index % (len(defenses) * len(attacks))
                    defense = [text for _, _, text in list_rows() if text.partition(":")[0] == name][pair // len(attacks)]
                    attack = attacks[pair % len(attacks)].name()
                    results.setdefault(defense, {}).setdefault(attack, []).append(record)
        return results

    def attack_positions(self) -> list[Record]:
        """Reconstruct the same photographs from positions alone, which every defense releases."""
        both = [bench.run([Undefended()], [Keypoints()], images, out=self.work / "attacks") for images in (self.tested, None)]
        return [record for records in both for record in records]

    def localize(self) -> dict[str, list[Record]]:
        """Localize queries. -> defense -> records"""
        texts = [text for _, _, text in list_rows()]
        dataset = FirstQueries(first=self.queries)
        defenses = [_read_defense(text, "" if text.startswith("privunit") else "references") for text in texts]
        records = bench.run(defenses, task=Localization(), dataset=dataset, out=self.work / "localization")
        return {text: records[number :: len(texts)] for number, text in enumerate(texts)}


def _read_defense(text: str, dictionary: str = "") -> Defense:
    return spec.read(f"{text},dictionary={dictionary}" if dictionary else text, discovery.DEFENSE)


def write_results(study: Study, networks: Mapping[str, Path]) -> None:
    attacked, served, positions = study.attack(networks), study.localize(), study.attack_positions()
    alone = np.array([record["metrics"]["ssim"] for record in positions])
    lines = [
        write_heading(study, alone),
        *write_table(attacked, served),
        "",
        *compare_rows(attacked, served, alone),
        "",
        *write_reasons(),
    ]
    by_attack = (group for groups in attacked.values() for group in groups.values())
    records = itertools.chain(positions, *by_attack, *served.values())
    start = {"initial_checkpoint": weights.load(study.initial_checkpoint).digest}
    write_page("better-defenses.md", "\n".join(lines), [start, *records])


def write_heading(study: Study, alone: np.ndarray) -> str:
    widths = ", ".join(map(str, study.widths))
    return (
        "# Defenses at the same ε\n\n"
        f"|K| is {WORDS:,}: ε = {PAPER_EPSILONS[0] - SHIFT:.3f} releases the true word as often as "
        f"ε = {PAPER_EPSILONS[0]} with 256,000.\n\n"
        "- **SSIM**: quality of the reconstruction by `dia` with a network for that defense. Each network has "
        f"{widths} channels, started from `{study.initial_checkpoint.name}`, a network for raw descriptors, "
        f"and was trained for {study.steps} "
        f"steps of {BATCH} samples from {len(study.photographs)} photographs. That is a short training: the results are lower "
        "bounds of the leakage, and differences may grow or vanish with longer training. Each was trained once; intervals "
        f"do not include the variation between seeds. Measured on {len(study.tested)} photographs of `test.txt` and the 7 "
        "built-in, which no network was trained or chosen on.\n"
        "- Positions alone, which every defense releases, give "
        f"{format_interval(interval(alone), 3)} with the shipped network "
        "for them. A network below this baseline has not learned to use its input; comparisons use the baseline instead.\n"
        f"- **recall**: the fraction of {study.queries} queries of the gallery, by day, that a server localizes within "
        "0.25 m and 2°.\n"
        f"- **repeated**: SSIM for the estimates of `repeat` from {REPEATS} releases of a photograph, with the network for raw "
        "descriptors; **recovered**: the fraction of descriptors that it finds. It selects the most frequent word, which is the "
        "likeliest for `ldp` alone.\n\n"
        "n/a: no network was trained for that defense, or it releases no words, which `repeat` needs. "
        "In brackets: 95% intervals, Student's over photographs or Wilson's over queries.\n"
    )


def list_ssim(attacked: Attacked, text: str) -> np.ndarray:
    return np.array([record["metrics"]["ssim"] for record in attacked[text]["dia"]])


def list_recall(served: Localized, text: str) -> np.ndarray:
    return np.array([record["metrics"][WITHIN] for record in served[text]])


def select_strongest(attacked: Attacked, text: str, alone: np.ndarray) -> np.ndarray:
    """Return the better SSIM on average, from a release or from positions alone."""
    released = list_ssim(attacked, text)
    return released if released.mean() > alone.mean() else alone


def write_table(attacked: Attacked, served: Localized) -> list[str]:
    names = ("ε", "defense", "SSIM", "recall, %", "SSIM, repeated", "recovered, %")
    lines = [markdown_row(names), markdown_row(["---"] * len(names))]
    for epsilon, name, text in list_rows():
        repeated = [record["metrics"] for record in attacked.get(text, {}).get("repeat", ())]
        reconstruction = format_interval(interval(list_ssim(attacked, text)), 3) if text in attacked else "n/a"
        localized = format_interval(proportion(list_recall(served, text), 100), 1)
        multi_release = format_interval(interval([each["ssim"] for each in repeated]), 3) if repeated else "n/a"
        fraction = f"{100 * np.mean([each['recovered'] for each in repeated]):.1f}" if repeated else "n/a"
        lines.append(markdown_row((epsilon, f"`{name}`", reconstruction, localized, multi_release, fraction)))
    return lines


def compare_rows(attacked: Attacked, served: Localized, alone: np.ndarray) -> list[str]:
    """Write paired differences from the paper's defense at the same ε, and whether one is better in both."""
    lines = [markdown_row(("ε", f"minus `{BASE}`", "SSIM", "recall, points", "result")), markdown_row(["---"] * 5)]
    bases = {epsilon: text for epsilon, name, text in list_rows() if name == BASE}
    verdicts = []
    for epsilon, name, text in list_rows():
        base = bases.get(epsilon)
        if base is None or base == text:
            continue
        ssim = interval(select_strongest(attacked, text, alone) - select_strongest(attacked, base, alone))
        recall = interval(100 * (list_recall(served, text) - list_recall(served, base)))
        verdicts.append((f"`{name}` at {epsilon}", describe_verdict(ssim, recall)))
        lines.append(
            markdown_row((epsilon, f"`{name}`", format_interval(ssim, 3, "+"), format_interval(recall, 1, "+"), verdicts[-1][1]))
        )
    return [*lines, "", write_summary(verdicts)]


def write_reasons() -> list[str]:
    """Write properties of the mechanisms at these ε."""
    cosines = ", ".join(f"{expected_cosine(paper - SHIFT, 127):.2f}" for paper in PAPER_EPSILONS)
    return [
        "Properties of the mechanisms:",
        "",
        "- `plateau` releases a near word as often as the true one; with more near words, each is released less often. A near "
        "word helps a server only if the map's point has it; it always helps an attacker.",
        "- `privunit` spreads ε over 127 dimensions: a released vector has a mean cosine with the (centred) descriptor of "
        f"{cosines} at these ε. No choice of |K| changes this, and each vector is information for a network.",
        "- `exponential` spends half of ε on normalisers that hardly differ, and the rest on utilities that few words have.",
    ]


def write_summary(verdicts: Sequence[tuple[str, str]]) -> str:
    """Write whether one of the rows dominates the paper's defense."""
    dominating = [name for name, verdict in verdicts if verdict == DOMINATES]
    gaining = [name for name, verdict in verdicts if "higher recall" in verdict]
    if dominating:
        return f"These dominate `{BASE}`, with higher recall and lower SSIM at the same ε: {', '.join(dominating)}."
    more = f"Recall is significantly higher for {', '.join(gaining)}." if gaining else "No recall is significantly higher."
    return f"**None is shown to dominate `{BASE}`**, by higher recall and lower SSIM at the same ε. {more}"


def describe_verdict(ssim: Interval, recall: Interval) -> str:
    """Describe the two differences: the attacker gains by a higher SSIM, the server by a higher recall."""
    attacker = "higher SSIM" if ssim.low > 0 else "lower SSIM" if ssim.high < 0 else ""
    server = "higher recall" if recall.low > 0 else "lower recall" if recall.high < 0 else ""
    if server == "higher recall" and attacker != "higher SSIM":
        return DOMINATES if attacker else "higher recall, SSIM inconclusive"
    if server == "lower recall" and attacker != "lower SSIM":
        return "is dominated" if attacker else "lower recall, SSIM inconclusive"
    return ", ".join(filter(None, (attacker, server))) or "inconclusive"


if __name__ == "__main__":
    main()
