"""Measures the effect of released attributes and of the input encoding: compares reconstructions of equally trained networks.

1. Released attributes of a keypoint: its position alone, its scale, its scale and orientation; upright and oriented SIFT, raw
   descriptors. From random weights.
2. Input encoding: the release as it is (the paper's stacking), or without its random order and basis; affine subspaces and word
   sets. From the network of 1. for upright descriptors with positions alone.

    python tools/measure_encodings.py --data ../shared/data --work work/encodings

All are trained on the third of the photographs of `train/` that the shipped dictionary was not built from (`make_assets.py`), and
evaluated on those of `test.txt` and on the built-in ones. Finished trainings and measurements are reused. Writes
docs/results/input-encodings.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from make_assets import run_command, split_photographs
from result_page import format_interval, write_page

import bench
from attacks.dia import DIA
from bench.core.table import markdown_row
from bench.registry import discovery, spec
from bench.runner.records import Record
from bench.settings import Asset
from leaderboard.intervals import Interval, interval

WIDTHS = "32,64,112,112"  # of the shipped networks
STEPS, FURTHER = 800, 600
SENT = ("positions", "scale", "scale-and-orientation")
SUBSPACES = tuple(f"affine:dim={dim}" for dim in (2, 4, 8, 16))
WORD_SETS = tuple(f"ldp:epsilon={epsilon},subset_size={size}" for epsilon, size in ((16, 2), (12, 2), (12, 4), (10, 2)))


Label = tuple[str, str]
Scores = dict[str, dict[str, np.ndarray]]  # where -> metric -> (photographs,)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="folder of networks and records, reused between runs")
    args = parser.parse_args()
    study = Study(args.data, args.work)
    text = "\n".join([write_heading(study), compare_attributes(study), compare_encodings(study)])
    write_page("input-encodings.md", text, study.records)


class Study:
    """Networks trained on the same photographs, and their reconstructions of the same releases."""

    def __init__(self, data: Path, work: Path) -> None:
        folders = split_photographs(data, work / "photographs")
        self.work = work
        self.given = ["--images", folders["2"], "--validation", folders["tune"], "--widths", WIDTHS]
        tests = [data / "train" / name for name in (data / "test.txt").read_text().split()]
        self.photographs: dict[str, list[Path] | None] = {"test": tests, "built-in": None}
        self.trained_on = len(list(folders["2"].iterdir()))
        self.records: list[Record] = []  # of all reconstructions

    def train_network(self, name: str, *words: object) -> Path:
        """Train a network by these arguments of `bench train`, unless it exists."""
        file = self.work / f"{name}.safetensors"
        if not file.is_file():
            run_command("train", *self.given, *words, "--out", file)
        return file

    def measure_scores(self, network: Path, defenses: Sequence[str], extractor: str = "sift") -> list[Scores]:
        """Measure the reconstructions of a network from the releases of each defense."""
        results: list[Scores] = [{} for _ in defenses]
        for where, images in self.photographs.items():
            print(network.name, where, flush=True)
            records = bench.run(
                [spec.read(defense, discovery.DEFENSE) for defense in defenses],
                [DIA(weights=Asset(network))],
                images,
                extractor=spec.read(extractor, discovery.EXTRACTOR),
                out=self.work / "records",
            )
            self.records += records
            for index, scores in enumerate(results):
                own = records[index :: len(defenses)]  # all defenses of a photograph come before the next one
                scores[where] = {metric: np.array([record["metrics"][metric] for record in own]) for metric in ("ssim", "psnr")}
        return results


def write_heading(study: Study) -> str:
    return (
        "# Effect of released attributes and of the input encoding\n\n"
        f"All networks have the channels of the shipped ones ({WIDTHS}). They are trained on the same {study.trained_on} "
        "photographs, in batches of 8 samples. **That is a small budget**: compare networks that were trained equally long, "
        "and do not rely on their absolute quality. A difference may grow or vanish with longer training. In brackets: 95% "
        "intervals of Student's t over photographs, the 100 of `test.txt` and the 7 built-in ones, which no "
        "network was trained or chosen on. Differences are paired by photograph; a network is *better* if the interval "
        "on `test.txt` lies above 0. Each was trained once; intervals do not include the variation between seeds. Additional "
        "input does not reduce leakage: a network with more input and a worse result has not learned to use it.\n"
    )


def compare_attributes(study: Study) -> str:
    """Compare raw descriptors with different attributes of a keypoint."""
    results: dict[Label, Scores] = {}
    for kind, upright in (("upright", "true"), ("oriented", "false")):
        for sent in SENT[: 2 if kind == "upright" else 3]:  # an upright keypoint has no orientation to send
            defense, extractor = f"none:sends={sent}", f"sift:upright={upright}"
            words = ["--defense", defense, "--extractor", extractor, "--steps", STEPS]
            network = study.train_network(f"attributes-{upright}-{sent}", *words)
            results[kind, sent] = study.measure_scores(network, [defense], extractor)[0]
    pairs = [((kind, sent), (kind, "positions")) for kind, sent in results if sent != "positions"]
    pairs += [
        (("oriented", "scale-and-orientation"), ("oriented", "scale")),
        (("upright", "positions"), ("oriented", "positions")),
    ]
    return "\n".join(
        [
            "## Released attributes of a keypoint",
            "",
            f"Raw descriptors; each network was trained from random weights for {STEPS} steps.",
            "",
            *write_table(("SIFT", "released"), results),
            "",
            *compare_pairs(results, pairs),
            "",
        ]
    )


def compare_encodings(study: Study) -> str:
    """Compare the paper's stacking with an invariant one."""
    initial = study.work / "attributes-true-positions.safetensors"
    results: dict[Label, Scores] = {}
    for name, defense, defenses in (("affine", "affine", SUBSPACES), ("ldp", "ldp:words=0", WORD_SETS)):
        for encoding in ("released", "invariant"):
            network = study.train_network(
                f"{name}-{encoding}",
                *("--defense", defense, "--encoding", encoding, "--initial-checkpoint", initial),
                *("--steps", FURTHER, "--rate", 1e-3),
            )
            results |= {
                (defense, encoding): one for defense, one in zip(defenses, study.measure_scores(network, defenses), strict=True)
            }
    pairs = [((defense, "invariant"), (defense, "released")) for defense, encoding in results if encoding == "invariant"]
    return "\n".join(
        [
            "## Input encoding",
            "",
            "Each network started from the one above for upright SIFT with positions alone, and was trained for "
            f"{FURTHER} further steps; one for all settings of a defense. `released`: the random origin and basis, or the words "
            "in order, stacked (the paper's). `invariant`: projections of fixed directions onto the subspace, or each "
            "word through the same embedding, summed.",
            "",
            *write_table(("defense", "encoding"), results),
            "",
            *compare_pairs(results, pairs),
            "",
        ]
    )


def write_table(names: tuple[str, str], results: Mapping[Label, Scores]) -> list[str]:
    """Write SSIM and PSNR of each."""
    columns = [(where, metric) for where in ("test", "built-in") for metric in ("ssim", "psnr")]
    lines = [markdown_row((*names, *(f"{metric.upper()}, {where}" for where, metric in columns))), markdown_row(["---"] * 6)]
    for label, scores in results.items():
        shown = [format_interval(interval(scores[where][metric]), 4 if metric == "ssim" else 2) for where, metric in columns]
        lines.append(markdown_row((*(f"`{name}`" for name in label), *shown)))
    return lines


def compare_pairs(
    results: Mapping[tuple[str, str], Scores], pairs: Sequence[tuple[tuple[str, str], tuple[str, str]]]
) -> list[str]:
    """Write paired differences in SSIM, and their verdicts."""
    lines = [markdown_row(("SSIM of", "minus that of", "test", "built-in", "result")), markdown_row(["---"] * 5)]
    for one, other in pairs:
        a, b = results[one], results[other]
        gains = {where: interval(a[where]["ssim"] - b[where]["ssim"]) for where in ("test", "built-in")}
        names = (" ".join(f"`{name}`" for name in label) for label in (one, other))
        intervals = (format_interval(gain, 4, sign="+") for gain in gains.values())
        lines.append(markdown_row((*names, *intervals, describe_verdict(gains["test"]))))
    return lines


def describe_verdict(gain: Interval) -> str:
    """Describe the first of two networks relative to the second."""
    return "better" if gain.low > 0 else "worse" if gain.high < 0 else "inconclusive"


if __name__ == "__main__":
    main()
