"""Measures what a release leaks by how it is written: trains networks equally long and compares what they paint.

1. What else of a keypoint is sent: its position alone, its scale, its scale and orientation; upright and oriented SIFT, raw
   descriptors. From random weights.
2. How the network is told of a release: as it is released (the paper's stacking), or without its random order and basis; affine
   subspaces and word sets. From the network of 1. for upright descriptors with positions alone.

    python tools/measure_encodings.py --data ../shared/data --work work/leakage

All are trained on the third of the photographs of `train/` that the shipped dictionary was not made from (`make_assets.py` parts
them), so that none is quantised by a dictionary that knows it; and reported on those of `test.txt` and on the built-in ones. What
is trained or measured already is not done again. Writes docs/leakage.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from make_assets import part, run

import bench
from attacks.dia import DIA
from bench.registry import discovery, spec
from bench.settings import Asset
from leaderboard.intervals import Interval, interval
from bench.core.table import markdown_row

PAGE = Path(__file__).parents[1] / "docs" / "leakage.md"
WIDTHS = "32,64,112,112"  # half of the shipped networks': a quarter of the time, so that nine of them can be trained
STEPS, FURTHER = 400, 300
SENT = ("positions", "scale", "scale-and-orientation")
SUBSPACES = tuple(f"affine:dim={dim}" for dim in (2, 4, 8, 16))
WORD_SETS = tuple(f"ldp:epsilon={epsilon},subset_size={size}" for epsilon, size in ((16, 2), (12, 2), (12, 4), (10, 2)))


Scores = dict[str, dict[str, np.ndarray]]  # where -> metric -> (photographs,)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="kept between runs")
    args = parser.parse_args()
    study = Study(args.data, args.work)
    text = "\n".join([heading(study), attributes(study), encodings(study)])
    PAGE.write_text(text, encoding="utf-8")


class Study:
    """Networks, all trained on the same photographs, and what they paint of the same releases."""

    def __init__(self, data: Path, work: Path) -> None:
        folders = part(data, work / "photographs")
        self.work = work
        self.given = ["--images", folders["2"], "--validation", folders["tune"], "--widths", WIDTHS]
        tests = [data / "train" / name for name in (data / "test.txt").read_text().split()]
        self.photographs: dict[str, list[Path] | None] = {"test": tests, "built-in": None}
        self.trained_on = len(list(folders["2"].iterdir()))

    def network(self, name: str, *words: object) -> Path:
        """The network that these words of `bench train` make."""
        file = self.work / f"{name}.safetensors"
        if not file.is_file():
            run("train", *self.given, *words, "--out", file)
        return file

    def scores(self, network: Path, defenses: Sequence[str], extractor: str = "sift") -> list[Scores]:
        """What a network paints of the releases of each defense."""
        found: list[Scores] = [{} for _ in defenses]
        for where, images in self.photographs.items():
            print(network.name, where, flush=True)
            records = bench.run(
                [spec.read(defense, discovery.DEFENSE) for defense in defenses],
                [DIA(weights=Asset(network))],
                images,
                extractor=spec.read(extractor, discovery.EXTRACTOR),
                out=self.work / "records",
            )
            for place, scores in enumerate(found):
                own = records[place :: len(defenses)]  # all defenses of a photograph come before the next one
                scores[where] = {metric: np.array([record["metrics"][metric] for record in own]) for metric in ("ssim", "psnr")}
        return found


def heading(study: Study) -> str:
    return (
        "# What a release leaks by how it is written\n\n"
        f"Written by `tools/measure_encodings.py`. All networks have half the channels of the shipped ones ({WIDTHS}) and are trained on "
        f"the same {study.trained_on} photographs, in batches of 8 crops. **That is a small budget**: read differences between "
        "networks that were trained equally long, not how well any of them paints; a difference may grow, or vanish, with "
        "longer training. In brackets: 95% bootstrap over photographs, the 100 of `test.txt` and the 7 built-in ones, which no "
        "network was trained or chosen on. Differences are of the same photographs; a network *paints better* where the interval "
        "on `test.txt` lies above 0. Each was trained once, and how much another seed would differ is in no interval. What is "
        "told more leaks no less: a network that is told more and paints worse has not learned to use it.\n"
    )


def attributes(study: Study) -> str:
    """Raw descriptors with more and more of a keypoint."""
    found: dict[tuple[str, str], Scores] = {}
    for kind, upright in (("upright", "true"), ("oriented", "false")):
        for sent in SENT[: 2 if kind == "upright" else 3]:  # an upright keypoint has no orientation to send
            defense, extractor = f"none:sends={sent}", f"sift:upright={upright}"
            words = ["--defense", defense, "--extractor", extractor, "--steps", STEPS]
            network = study.network(f"attributes-{upright}-{sent}", *words)
            found[kind, sent] = study.scores(network, [defense], extractor)[0]
    pairs = [((kind, sent), (kind, "positions")) for kind, sent in found if sent != "positions"]
    pairs += [
        (("oriented", "scale-and-orientation"), ("oriented", "scale")),
        (("upright", "positions"), ("oriented", "positions")),
    ]
    return "\n".join(
        [
            "## What else of a keypoint is sent",
            "",
            f"Raw descriptors; each network trained from random weights for {STEPS} steps, all alike.",
            "",
            *table(("SIFT", "sent"), found),
            "",
            *comparisons(found, pairs),
            "",
        ]
    )


def encodings(study: Study) -> str:
    """The paper's stacking against one that depends on what is released alone."""
    start = study.work / "attributes-true-positions.safetensors"
    found: dict[tuple[str, str], Scores] = {}
    for name, written, defenses in (("affine", "affine", SUBSPACES), ("ldp", "ldp:words=0", WORD_SETS)):
        for encoding in ("released", "invariant"):
            words = ["--defense", written, "--encoding", encoding, "--steps", FURTHER, "--rate", 1e-3, "--start", start]
            network = study.network(f"{name}-{encoding}", *words)
            found |= {(defense, encoding): one for defense, one in zip(defenses, study.scores(network, defenses), strict=True)}
    pairs = [((defense, "invariant"), (defense, "released")) for defense, encoding in found if encoding == "invariant"]
    return "\n".join(
        [
            "## How the network is told of a release",
            "",
            "Each network started from the one above for upright SIFT with positions alone, and was trained for "
            f"{FURTHER} further steps, all alike; one for all settings of a defense. `released`: the random origin and basis, or "
            "the words in order, stacked (the paper's). `invariant`: projections of fixed directions onto the subspace, or each "
            "word embedded alike and added up.",
            "",
            *table(("defense", "told"), found),
            "",
            *comparisons(found, pairs),
            "",
        ]
    )


def table(names: tuple[str, str], found: Mapping[tuple[str, str], Scores]) -> list[str]:
    """SSIM and PSNR of each."""
    columns = [(where, metric) for where in ("test", "built-in") for metric in ("ssim", "psnr")]
    lines = [markdown_row((*names, *(f"{metric.upper()}, {where}" for where, metric in columns))), markdown_row(["---"] * 6)]
    for label, scores in found.items():
        shown = [written(interval(scores[where][metric]), 4 if metric == "ssim" else 2) for where, metric in columns]
        lines.append(markdown_row((*(f"`{part}`" for part in label), *shown)))
    return lines


def comparisons(found: Mapping[tuple[str, str], Scores], pairs: Sequence[tuple[tuple[str, str], tuple[str, str]]]) -> list[str]:
    """Paired differences in SSIM, and what they say."""
    lines = [markdown_row(("SSIM of", "less that of", "test", "built-in", "paints")), markdown_row(["---"] * 5)]
    for one, other in pairs:
        apart = {where: interval(found[one][where]["ssim"] - found[other][where]["ssim"]) for where in ("test", "built-in")}
        names = (" ".join(f"`{part}`" for part in label) for label in (one, other))
        lines.append(markdown_row((*names, *(written(value, 4, sign="+") for value in apart.values()), verdict(apart["test"]))))
    return lines


def verdict(apart: Interval) -> str:
    """How the first of two networks fares."""
    return "better" if apart.low > 0 else "worse" if apart.high < 0 else "cannot be told"


def written(value: Interval, digits: int, sign: str = "") -> str:
    return f"{value.mean:{sign}.{digits}f} [{value.low:{sign}.{digits}f}, {value.high:{sign}.{digits}f}]"


if __name__ == "__main__":
    main()
