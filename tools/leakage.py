"""Measures what a release leaks by how it is written: trains networks equally long and compares what they paint.

1. What else of a keypoint is sent: its position alone, its scale, its scale and orientation; upright and oriented SIFT, raw
   descriptors. From random weights.
2. How the network is told of a release: as it is released (the paper's stacking), or without its random order and basis; affine
   subspaces and word sets. From the shipped network for raw descriptors.

    python tools/leakage.py --data ../shared/data --work work/leakage --out docs/leakage.md

Trained on the photographs of `train/` that are in neither list, as `make_assets.py` parts them; reported on the built-in ones and
on those of `test.txt`. What is trained already is not trained again.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from make_assets import part, run

import bench
from attacks.dia import DIA
from bench import registry, spec
from bench.plugin import Asset
from bench.public import ASSETS
from bench.records import Record

FROM_NOTHING = ("--steps", 500)
FURTHER = ("--steps", 600, "--rate", 1e-3, "--start", ASSETS / "inversion-none.safetensors")
SENT = ("positions", "scale", "scale-and-orientation")
SUBSPACES = tuple(f"affine:dim={dim}" for dim in (2, 4, 8, 16))
WORD_SETS = tuple(f"ldp:epsilon={epsilon},subset_size={size}" for size in (2, 4) for epsilon in (16, 12, 10))
RESAMPLES = 2000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="kept between runs")
    parser.add_argument("--crossfit", type=Path, action="append", default=[], help="dictionaries, as `bench train` takes them")
    parser.add_argument("--out", type=Path, required=True, help="the Markdown file that is written")
    args = parser.parse_args()
    tests = [args.data / "train" / name for name in (args.data / "test.txt").read_text().split()]
    trainer = Trainer(args.data, args.work, args.crossfit)
    sections = [attributes(trainer, tests), encodings(trainer, tests)]
    args.out.write_text("# What a release leaks by how it is written\n\n" + "\n".join(sections), encoding="utf-8")


class Trainer:
    """Runs `bench train` on the training photographs."""

    def __init__(self, data: Path, work: Path, crossfit: Sequence[Path]) -> None:
        folders = part(data, work / "photographs")
        self.work = work
        self.given = ["--images", folders["012"], "--validation", folders["tune"]]
        self.crossfit = [word for file in crossfit for word in ("--crossfit", file)]

    def network(self, name: str, *words: object) -> DIA:
        """The attack with the network that these words make."""
        file = self.work / f"{name}.safetensors"
        if not file.is_file():
            run("train", *self.given, *words, "--out", file)
        return DIA(weights=Asset(file))


def attributes(trainer: Trainer, tests: list[Path]) -> str:
    """Raw descriptors with more and more of a keypoint."""
    rows = []
    for upright in ("true", "false"):
        # An upright keypoint has no orientation to send.
        for sent in SENT[: 2 if upright == "true" else 3]:
            defense, extractor = f"none:sends={sent}", f"sift:upright={upright}"
            attack = trainer.network(
                f"attributes-{upright}-{sent}", "--defense", defense, "--extractor", extractor, *FROM_NOTHING
            )
            rows.append(
                {"SIFT": "upright" if upright == "true" else "oriented", "sent": sent} | scores(defense, attack, extractor, tests)
            )
    return (
        "## What else of a keypoint is sent\n\n"
        f"Raw descriptors; each network trained from random weights for {FROM_NOTHING[1]} steps of 8 crops, all alike.\n\n"
        f"{markdown(rows)}\n"
    )


def encodings(trainer: Trainer, tests: list[Path]) -> str:
    """The paper's stacking against one that depends on what is released alone."""
    rows = []
    for name, defenses in (("affine", SUBSPACES), ("ldp", WORD_SETS)):
        for encoding in ("released", "invariant"):
            words = ["--defense", name, "--encoding", encoding, *FURTHER, *(trainer.crossfit if name == "ldp" else [])]
            attack = trainer.network(f"{name}-{encoding}", *words)
            rows += [{"defense": defense, "told": encoding} | scores(defense, attack, "sift", tests) for defense in defenses]
    return (
        "## How the network is told of a release\n\n"
        f"Each network started from the one for raw descriptors and trained for {FURTHER[1]} steps of 8 crops, all alike. "
        "`released`: the random origin and basis, or the words in order, stacked (the paper's). `invariant`: projections of "
        "fixed directions onto the subspace, or each word embedded alike and added up.\n\n"
        f"{markdown(rows)}\n"
    )


def markdown(rows: Sequence[dict[str, str]]) -> str:
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def scores(defense: str, attack: DIA, extractor: str, tests: list[Path]) -> dict[str, str]:
    """SSIM on the built-in photographs and on those of `test.txt`, and PSNR on the latter, with bootstrap 95% intervals."""
    columns = {}
    for where, images in (("built-in", None), ("test", tests)):
        records = bench.run(
            [spec.read(defense, registry.DEFENSE)], [attack], images, extractor=spec.read(extractor, registry.EXTRACTOR)
        )
        columns[f"SSIM, {where}"] = interval(records, "ssim", 4)
    return columns | {"PSNR, test": interval(records, "psnr", 2)}


def interval(records: Sequence[Record], metric: str, digits: int) -> str:
    values = np.array([record["metrics"][metric] for record in records])
    drawn = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.quantile(values[drawn].mean(axis=1), [0.025, 0.975])
    return f"{values.mean():.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


if __name__ == "__main__":
    main()
