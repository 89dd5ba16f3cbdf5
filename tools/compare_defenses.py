"""Compares defenses that promise the same ε: what an attacker sees who was trained for each, and what a server can do with it.

    python tools/compare_defenses.py --data ../shared/data --work work/better

|K| is 8,000 in place of the paper's 256,000, and its ε of 10 and 12 are less by ln 32, which leaves the chance that `ldp` tells
the true word as it is. Each network starts from one for raw descriptors and is trained equally long, for all settings of its
defense, on photographs that the shipped dictionary was not made from. Nothing was chosen by what is reported: on `test.txt`, the
built-in photographs, and the gallery. What is trained or measured already is not done again. Writes docs/better.md.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from make_assets import part

import bench
from attacks.dia import DIA
from attacks.keypoints import Keypoints
from attacks.repeat import Repeat
from bench.api import Attack, Dataset, Defense
from bench.codebook.public import ASSETS
from bench.datasets.gallery import Gallery
from bench.extractors.sift import Sift
from bench.images.photographs import list_photographs
from bench.images.scene import Scene
from bench.inversion import weights
from bench.inversion.plan import Plan, Training
from bench.inversion.train import train
from bench.registry import discovery, spec
from bench.runner.records import Record
from bench.settings import Asset, Between, OneOf
from bench.tasks.localization import Localization
from defenses.none import Undefended
from defenses.privunit import expected_cosine
from leaderboard.intervals import Interval, interval, proportion
from bench.core.table import markdown_row

PAGE = Path(__file__).parents[1] / "docs" / "better.md"
WORDS, SHIFT = 8000, math.log(32)  # 256,000 words over these
PAPERS = (10, 12)  # ε of the paper's size
BATCH, RATE = 8, 1e-3
PHOTOGRAPHS, VALIDATION = 48, 6
REPEATS = 8  # releases that `repeat` sees

EPSILON = Between(5.0, 12.0)
SERVED: dict[str, Mapping[str, Between | OneOf]] = {
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
Served = Mapping[str, Sequence[Record]]
BASE = "ldp:subset_size=2"  # the paper's, which the others are compared with


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="kept between runs")
    parser.add_argument(
        "--start",
        type=Path,
        default=ASSETS / "inversion-none.safetensors",
        help="a network for raw descriptors, such as tools/measure_encodings.py trains (default: shipped)",
    )
    parser.add_argument("--steps", type=int, default=300, help="of each network's training (default: %(default)s)")
    parser.add_argument("--tested", type=int, default=100, help="photographs of test.txt (default: %(default)s)")
    parser.add_argument("--queries", type=int, default=120, help="of the gallery (default: %(default)s)")
    parser.add_argument(
        "--networks", nargs="+", choices=SERVED, default=list(SERVED), help="train and attack these (default: all)"
    )
    parser.add_argument("--only", choices=("networks", "attacks", "server"), help="do that part, and write nothing")
    args = parser.parse_args()
    study = Study(args.data, args.work, args.initial_checkpoint, args.steps, args.tested, args.queries)
    if args.only in (None, "server"):
        study.served()
    if args.only in (None, "networks", "attacks"):
        networks = {name: study.network(name) for name in args.networks}
    if args.only in (None, "attacks"):
        study.attacked(networks)
    if args.only is None:
        PAGE.write_text("\n".join(page(study, networks)), encoding="utf-8")


def rows() -> list[tuple[str, str, str]]:
    """Of each row: whom it is compared with, its name, and the defense's configuration but for its dictionary."""
    found = []
    for paper in PAPERS:
        for name, settings in SETTINGS.items():
            for setting in settings:
                given = [f"epsilon={paper - SHIFT:.3f}", *([setting] if setting else [])]
                if name != "privunit":
                    given.append(f"words={WORDS}")
                found.append((f"{paper - SHIFT:.3f}", f"{name}:{setting}".rstrip(":"), f"{name}:{','.join(given)}"))
    by_distance = [(f"{each} per distance", "metric-ldp", f"metric-ldp:epsilon={each},words={WORDS}") for each in DISTANCES]
    return found + by_distance


@dataclass(frozen=True, kw_only=True)
class FirstQueries(Dataset):
    """The gallery with its first queries, which are by day; the references are those of the whole, and so are map and words."""

    first: int

    def scene(self) -> Scene:
        whole = Gallery().scene()
        return replace(whole, queries=whole.queries[: self.first])


class Study:
    """Networks that were trained equally long, what they paint, and what a server does, each measured once."""

    def __init__(self, data: Path, work: Path, start: Path, steps: int, tested: int, queries: int) -> None:
        folders = part(data, work / "photographs")
        self.work, self.initial_checkpoint, self.steps, self.queries = work, start, steps, queries
        self.widths = tuple(weights.load(start).meta["shape"]["widths"])
        self.photographs = list_photographs(folders["2"])[:PHOTOGRAPHS]
        self.validation = list_photographs(folders["tune"])[:VALIDATION]
        self.tested = [data / "train" / name for name in (data / "test.txt").read_text().split()[:tested]]

    def network(self, name: str) -> Path:
        """That of a defense, for all its settings."""
        file = self.work / f"{name}-{self.steps}.safetensors"
        given = "" if name == "privunit" else f":words={WORDS}"
        print(f"network for {name}", flush=True)
        plan = Plan(
            defense=spec.read(name + given, discovery.DEFENSE),
            served=SERVED[name],
            photographs=self.photographs,
            validation=self.validation,
            extractor=Sift(),
            initial_checkpoint=self.initial_checkpoint,
            widths=self.widths,
            training=Training(steps=self.steps, batch=BATCH, rate=RATE, warmup=20),
        )
        train(plan, file)
        return file

    def attacked(self, networks: Mapping[str, Path]) -> dict[str, dict[str, list[Record]]]:
        """What attacks recover. -> defense -> attack -> records, those of test.txt before the built-in ones"""
        found: dict[str, dict[str, list[Record]]] = {}
        for name, network in networks.items():
            attacks: list[Attack] = [DIA(weights=Asset(network))]
            if name != "privunit":
                attacks.append(Repeat(releases=REPEATS))
            defenses = [_read(text) for _, _, text in rows() if text.partition(":")[0] == name]
            for images in (self.tested, None):
                print(f"attacks on {name}", flush=True)
                records = bench.run(defenses, attacks, images, out=self.work / "attacks")
                for place, record in enumerate(records):
                    pair = place % (len(defenses) * len(attacks))
                    defense = [text for _, _, text in rows() if text.partition(":")[0] == name][pair // len(attacks)]
                    attack = attacks[pair % len(attacks)].name()
                    found.setdefault(defense, {}).setdefault(attack, []).append(record)
        return found

    def positions(self) -> np.ndarray:
        """SSIM of what positions alone tell, which are released whatever the defense, of the same photographs."""
        both = [bench.run([Undefended()], [Keypoints()], images, out=self.work / "attacks") for images in (self.tested, None)]
        return np.array([record["metrics"]["ssim"] for records in both for record in records])

    def served(self) -> dict[str, list[Record]]:
        """How well queries are localized. -> defense -> records"""
        texts = [text for _, _, text in rows()]
        place = FirstQueries(first=self.queries)
        defenses = [_read(text, "" if text.startswith("privunit") else "references") for text in texts]
        records = bench.run(defenses, task=Localization(), dataset=place, out=self.work / "localization")
        return {text: records[number :: len(texts)] for number, text in enumerate(texts)}


def _read(text: str, dictionary: str = "") -> Defense:
    return spec.read(f"{text},dictionary={dictionary}" if dictionary else text, discovery.DEFENSE)


def page(study: Study, networks: Mapping[str, Path]) -> list[str]:
    attacked, served, alone = study.attacked(networks), study.served(), study.positions()
    return [
        heading(study, networks, alone),
        *table(attacked, served),
        "",
        *comparisons(attacked, served, alone),
        "",
        *reasons(),
        "",
    ]


def heading(study: Study, networks: Mapping[str, Path], alone: np.ndarray) -> str:
    widths = ", ".join(map(str, study.widths))
    return (
        "# Better defenses at the same ε?\n\n"
        "Written by `tools/compare_defenses.py`, which rebuilds the networks and all numbers here:\n\n"
        f"```\npython tools/compare_defenses.py --data ../shared/data --work work/better --start {study.initial_checkpoint.name} --steps {study.steps} "
        f"--tested {len(study.tested)} --queries {study.queries} --networks {' '.join(networks)}\n```\n\n"
        f"|K| is {WORDS:,}: ε = {PAPERS[0] - SHIFT:.3f} tells the true word as often as ε = {PAPERS[0]} with 256,000.\n\n"
        "- **SSIM**: what an attacker sees, of what `dia` paints with a network for that defense. Each network has "
        f"{widths} channels, started from `{study.initial_checkpoint.name}`, which paints raw descriptors, and was trained for {study.steps} "
        f"steps of {BATCH} crops of {len(study.photographs)} photographs, all alike. That is little: what they paint is a "
        "floor of what leaks, and differences may grow or vanish with longer training. Each was trained once; how much another "
        f"seed would differ is in no interval. Measured on {len(study.tested)} photographs of `test.txt` and the 7 built-in, "
        "which no network was trained or chosen on.\n"
        f"- Positions alone, which are released whatever the defense, tell {written(interval(alone), 3)} to the shipped network "
        "for them. What paints worse has not learned to use what it is told, and counts as that much where rows are compared.\n"
        f"- **recall**: what a server can do, the share of {study.queries} queries of the gallery, by day, that are localized "
        "within 0.25 m and 2°.\n"
        f"- **repeated**: the same of what `repeat` makes of {REPEATS} releases of a photograph, painted by the network for raw "
        "descriptors; **recovered**: the share of descriptors that it finds. It takes the word that recurs most, which is the "
        "likeliest for `ldp` alone.\n\n"
        "n/a: no network was trained for that defense, or it releases no words, which `repeat` needs. "
        "In brackets: 95% bootstrap over photographs, or Wilson's interval over queries.\n"
    )


def ssim(attacked: Attacked, text: str) -> np.ndarray:
    return np.array([record["metrics"]["ssim"] for record in attacked[text]["dia"]])


def recall(served: Served, text: str) -> np.ndarray:
    return np.array([record["metrics"][WITHIN] for record in served[text]])


def strongest(attacked: Attacked, text: str, alone: np.ndarray) -> np.ndarray:
    """Of what is painted from one release, and from positions alone, that which is better on average."""
    painted = ssim(attacked, text)
    return painted if painted.mean() > alone.mean() else alone


def table(attacked: Attacked, served: Served) -> list[str]:
    names = ("ε", "defense", "SSIM", "recall, %", "SSIM, repeated", "recovered, %")
    lines = [markdown_row(names), markdown_row(["---"] * len(names))]
    for epsilon, name, text in rows():
        repeated = [record["metrics"] for record in attacked.get(text, {}).get("repeat", ())]
        seen = written(interval(ssim(attacked, text)), 3) if text in attacked else "n/a"
        found = written(proportion(recall(served, text), 100), 1)
        told = written(interval([each["ssim"] for each in repeated]), 3) if repeated else "n/a"
        share = f"{100 * np.mean([each['recovered'] for each in repeated]):.1f}" if repeated else "n/a"
        lines.append(markdown_row((epsilon, f"`{name}`", seen, found, told, share)))
    return lines


def comparisons(attacked: Attacked, served: Served, alone: np.ndarray) -> list[str]:
    """Paired differences from the paper's defense at the same ε, and whether one is better in both."""
    lines = [markdown_row(("ε", f"less `{BASE}`", "SSIM", "recall, points", "says")), markdown_row(["---"] * 5)]
    bases = {epsilon: text for epsilon, name, text in rows() if name == BASE}
    told = []
    for epsilon, name, text in rows():
        base = bases.get(epsilon)
        if base is None or base == text:
            continue
        seen = interval(strongest(attacked, text, alone) - strongest(attacked, base, alone))
        gained = interval(100 * (recall(served, text) - recall(served, base)))
        told.append((f"`{name}` at {epsilon}", verdict(seen, gained)))
        lines.append(markdown_row((epsilon, f"`{name}`", written(seen, 3, "+"), written(gained, 1, "+"), told[-1][1])))
    return [*lines, "", summary(told)]


def reasons() -> list[str]:
    """What the mechanisms have to work with, at these ε."""
    cosines = ", ".join(f"{expected_cosine(paper - SHIFT, 127):.2f}" for paper in PAPERS)
    return [
        "What they have to work with:",
        "",
        "- `plateau` tells a near word as often as the true one, and the more there are, the less often each. A server has use "
        "for a near word where the map's point has that one; an attacker always has.",
        "- `privunit` spreads ε over 127 dimensions: what it releases has a mean cosine with the (centred) descriptor of "
        f"{cosines} at these ε. No choice of |K| helps it, and a network has use for each of its vectors.",
        "- `exponential` spends half of ε on normalisers that hardly differ, and the rest on utilities that few words have.",
    ]


def summary(told: Sequence[tuple[str, str]]) -> str:
    """Whether one of the rows dominates the paper's defense, in words."""
    dominating = [name for name, said in told if said == DOMINATES]
    gaining = [name for name, said in told if "server does more" in said]
    if dominating:
        return f"Dominating `{BASE}`, with higher recall and less to be seen, beyond chance: {', '.join(dominating)}."
    more = f"Recall is higher, beyond chance, for {', '.join(gaining)}." if gaining else "No recall is higher, beyond chance."
    return f"**None is shown to dominate `{BASE}`**, by a higher recall at the same ε with less to be seen. {more}"


def verdict(seen: Interval, gained: Interval) -> str:
    """What the two differences say: an attacker is better off where more is seen, a server where more is gained."""
    attacker = "sees more" if seen.low > 0 else "sees less" if seen.high < 0 else ""
    server = "does more" if gained.low > 0 else "does less" if gained.high < 0 else ""
    if server == "does more" and attacker != "sees more":
        return DOMINATES if attacker else "server does more, attacker cannot be told"
    if server == "does less" and attacker != "sees less":
        return "is dominated" if attacker else "server does less, attacker cannot be told"
    parts = [f"attacker {attacker}"] * bool(attacker) + [f"server {server}"] * bool(server)
    return ", ".join(parts) or "cannot be told"


def written(value: Interval, digits: int, sign: str = "") -> str:
    return f"{value.mean:{sign}.{digits}f} [{value.low:{sign}.{digits}f}, {value.high:{sign}.{digits}f}]"


if __name__ == "__main__":
    main()
