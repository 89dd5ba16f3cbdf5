"""Measures defenses that hide positions, alone and with a descriptor defense, and writes docs/results/geometry.md and a plot.

    python tools/measure_geometry.py --work work/geometry --scene fox/

1. Attacks on positions, on the built-in photographs: the error of positions, and the image that follows.
2. The attack of the server, on queries of a small gallery.
3. Localization from lines and from points in the small gallery and in a photographed scene, with the same keypoints and the same
   limit of trials.

Records in WORK are reused, so an interrupted run resumes.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from result_page import RECALLS, SMALL_GALLERY, format_interval, list_values, save_figure, write_page

import bench
from bench.core.table import markdown_row
from bench.registry import discovery, spec
from bench.runner.records import Record
from leaderboard.intervals import interval
from leaderboard.plot_style import choose_styles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = """# Defenses that hide positions

Releases of the seven built-in photographs, 256 by 256 pixels, upright SIFT, seed 0. [Hidden positions](../geometry.md) describes
the defenses and attacks. In brackets: 95% intervals of Student's t over photographs, which can exceed the range of a metric.

The settings of `neighbourhood` were chosen on other photographs. `dia` reconstructs the image from the recovered positions. Its
network was trained on true positions and not on their errors, so the scores of images are lower bounds of the leakage.
"""
ON_PHOTOGRAPHS = """## Attacks on positions

*position error*: median distance of a photograph's keypoints to their recovered positions, in pixels.
*identified*: [reciprocal rank](../method.md#identification) of the photograph among 256. Both: means over photographs.
A random order has 0.024. The constant image of `blank` has rank 128.5, and so 0.008.
"""
BY_SERVER = f"""## Attack of the server

Releases of the queries of the dataset `{SMALL_GALLERY}`, by the server that localizes them.
"""
LOCALIZATION = """## Localization

A difference of one or two queries is no evidence. A query is *localized* if a pose was found. Columns with thresholds: fractions
of all queries. Errors: medians over the localized ones. *matches* and *trials* (of RANSAC; 0 without a pose) are medians over all
queries. The limit of trials is the same for all defenses.
"""
PLAIN = {"none": ("dia", "keypoints"), "ldp:epsilon=16": ("dia",), "ldp:epsilon=10": ("dia",)}
HIDDEN = ("lines", "permutation")
ON_HIDDEN = ("neighbourhood-oracle", "neighbourhood", "dia-lines", "density", "blank")
COMPOSED = ("lines+ldp:epsilon=16", "lines+ldp:epsilon=10")
ON_COMPOSED = ("neighbourhood-oracle", "neighbourhood")
SHOWN = {"position-error": 1, "ssim": 3, "psnr": 2, "identified": 3}  # metric -> digits
REFERENCES = ("neighbourhood-oracle", "blank", "keypoints")  # no attacks, or baselines
FAMILIES = {"none": "nothing", "ldp": "descriptors", "lines": "positions", "permutation": "positions", "lines+ldp": "both"}
RECALL = "recall_0.5m_5deg"  # of the plot
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "geometry.png"
SERVED = ("snap", "neighbourhood")
LOCALIZED = ("none", "lines", "permutation", "ldp:epsilon=16", "lines+ldp:epsilon=16", "ldp:epsilon=10", "lines+ldp:epsilon=10")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder of records, reused between runs")
    parser.add_argument(
        "--scene", type=Path, help="the photographs of the fox, the example scene of instant-ngp (default: leave this scene out)"
    )
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    pairs = [
        *((defense, attack) for defense, attacks in PLAIN.items() for attack in attacks),
        *((defense, attack) for defense in HIDDEN for attack in ON_HIDDEN),
        *((defense, attack) for defense in COMPOSED for attack in ON_COMPOSED),
    ]
    in_gallery = {defense: localize(defense, SMALL_GALLERY, args.work / "localization") for defense in LOCALIZED}
    served = {("lines", attack): attack_positions("lines", attack, args.work / "server", SMALL_GALLERY) for attack in SERVED}
    photographed, defenses = f"captured:path={args.scene}", LOCALIZED if args.scene else ()
    in_scene = {defense: localize(defense, photographed, args.work / "scene") for defense in defenses}
    attacked = {pair: attack_positions(*pair, args.work / "attacks") for pair in pairs}
    results = (attacked, served, in_gallery, in_scene)
    records = [record for some in results for each in some.values() for record in each]
    save_figure(draw_tradeoff(attacked, in_gallery), PICTURE, records)
    parts = [
        TITLE,
        write_attacks(attacked, ON_PHOTOGRAPHS),
        write_attacks(served, BY_SERVER),
        LOCALIZATION,
        write_localization(in_gallery, f"Dataset `{SMALL_GALLERY}`, a rendered building"),
    ]
    if args.scene:
        caption = "Dataset `captured:path=fox/`, a photographed scene; every fifth photograph is a query"
        parts.append(write_localization(in_scene, caption))
    write_page("geometry.md", "\n".join(parts), records)


def attack_positions(defense: str, attack: str, work: Path, dataset: str | None = None) -> list[Record]:
    """Return the records of one attack on one defense."""
    print(defense, attack, flush=True)
    return bench.run(
        [spec.read(defense, discovery.DEFENSE)],
        [spec.read(attack, discovery.ATTACK)],
        dataset=None if dataset is None else spec.read(dataset, discovery.DATASET),
        out=work,
    )


def localize(defense: str, dataset: str, work: Path) -> list[Record]:
    """Return the records of the localization of one defense's releases."""
    print("localization", defense, flush=True)
    return bench.run(
        [spec.read(defense, discovery.DEFENSE)],
        task=spec.read("localization", discovery.TASK),
        dataset=spec.read(dataset, discovery.DATASET),
        out=work,
    )


def draw_tradeoff(attacked: Mapping[tuple[str, str], Sequence[Record]], localized: Mapping[str, Sequence[Record]]) -> Figure:
    """Draw the score of the strongest attack on each defense over the recall of localization, for two scores."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    styles = choose_styles(FAMILIES.values())
    for axes, (metric, label) in zip(figure.subplots(1, 2), {"ssim": "SSIM", "identified": "identified"}.items(), strict=True):
        labels: dict[tuple[float, float], list[str]] = {}
        for defense, records in localized.items():
            attacks = {attack: each for (one, attack), each in attacked.items() if one == defense and attack not in REFERENCES}
            score = max(values.mean() for each in attacks.values() if len(values := list_values(each, metric)))
            recall = list_values(records, RECALL).mean()
            style = styles[FAMILIES[defense.partition(":")[0]]]
            axes.plot(recall, score, style.marker, color=style.colour, ms=7, clip_on=False)
            labels.setdefault((round(recall, 2), round(score, 2)), []).append(defense.replace(":epsilon=", " ε "))
        for point, names in labels.items():
            axes.annotate(
                ", ".join(names), point, (3, 5), textcoords="offset points", fontsize=7, rotation=30, rotation_mode="anchor"
            )
        blank = list_values(attacked["lines", "blank"], metric).mean()
        axes.axhline(blank, color="0.35", lw=1, label="baseline blank")
        axes.set_xlabel("localization within 0.5 m, 5°: fraction of queries →", fontsize=9)
        axes.set_ylabel(f"{label} of the strongest attack →", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.margins(x=0.25, y=0.15)
    for family, style in styles.items():
        axes.plot([], [], style.marker, color=style.colour, label=f"hides {family}")
    figure.legend(*axes.get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside lower center", ncols=5)
    return figure


def write_attacks(results: Mapping[tuple[str, str], Sequence[Record]], heading: str) -> str:
    """Write a table of attacks."""
    lines = [
        heading,
        markdown_row(("defense", "attack", "position error", "SSIM", "PSNR", "identified")),
        markdown_row(["---"] * 6),
    ]
    for (defense, attack), records in results.items():
        values = {metric: list_values(records, metric) for metric in SHOWN}
        columns = [
            format_interval(interval(values[metric]), digits) if len(values[metric]) else "n/a"
            for metric, digits in SHOWN.items()
        ]
        lines.append(markdown_row((f"`{defense}`", f"`{attack}`", *columns)))
    return "\n".join([*lines, ""])


def write_localization(results: Mapping[str, Sequence[Record]], caption: str) -> str:
    """Write the table of localization in one dataset."""
    lines = [
        f"{caption}:",
        "",
        markdown_row(
            ("defense", "queries", "localized", *RECALLS.values(), "error in m", "error in degrees", "matches", "trials")
        ),
        markdown_row(["---"] * 10),
    ]
    for defense, records in results.items():
        errors = [list_values(records, metric) for metric in ("translation_error", "rotation_error")]
        recalls = [f"{list_values(records, metric).mean():.2f}" for metric in RECALLS]
        medians = [f"{np.median(each):.3f}" if len(each) else "n/a" for each in errors]
        counts = [f"{np.median(list_values(records, metric)):.0f}" for metric in ("matches", "trials")]
        lines.append(markdown_row((f"`{defense}`", len(records), len(errors[0]), *recalls, *medians, *counts)))
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    main()
