"""Rebuilds the files of `bench/assets` from a folder with `train/`, `tune.txt` and `test.txt`. Takes hours; can be resumed.

The photographs of `train/` that are in neither list are split by name into three thirds. The dictionary is built from the first
two thirds, the attacker's public database from the last. All networks start from one that was trained on raw descriptors of all
photographs. They are then trained equally long for their own releases, on the last third, which is not part of the dictionary.
Two networks start from random weights: for positions alone, and for raw oriented descriptors. `train_word_attackers.py` trains
the attackers of word sets afterwards.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from bench.cli import main as bench
from bench.codebook.public import ASSETS

WORDS = 256_000
DICTIONARIES = (  # file, set of photographs, words, extractor
    ("dictionary", "01", WORDS, "sift"),
    ("public-database", "2", 128_000, "sift"),
    ("dictionary-xfeat", "01", 16_000, "xfeat"),
    ("dictionary-aliked", "01", 16_000, "aliked"),
)
DEFENSES = ("none", "affine")
SETS = ("01", "02", "12", "2", "012")  # of thirds of the photographs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="folder of finished files, reused between runs")
    parser.add_argument("--steps", type=int, default=17_800, help="of the common first stage, each of 8 training samples")
    parser.add_argument("--own-steps", type=int, default=4500, help="of each second stage, and of the network for positions")
    parser.add_argument("--oriented-steps", type=int, default=20_800, help="of the network for oriented descriptors")
    parser.add_argument("--xfeat-steps", type=int, default=2600, help="of the network for XFeat")
    args = parser.parse_args()
    folders = split_photographs(args.data, args.work / "photographs")
    for file, photographs, words, extractor in DICTIONARIES:
        build = "dictionary", "build", "--images", folders[photographs], "--size", words, "--extractor", extractor
        ship(run_once(args.work / f"{file}.safetensors", *build))
    unseen = ["--validation", folders["tune"]]
    given = ["--images", folders["012"], *unseen]
    initial = run_once(args.work / "start.safetensors", "train", "--defense", "none", *given, "--steps", args.steps)
    for name in DEFENSES:
        own = ["--images", folders["2"], *unseen, "--initial-checkpoint", initial, "--steps", args.own_steps, "--rate", 2e-3]
        ship(run_once(args.work / f"inversion-{name}.safetensors", "train", "--defense", name, *own))
    alone = {
        "positions": ["--encoding", "positions", "--steps", args.own_steps],
        "inversion-oriented": ["--extractor", "sift:upright=false", "--steps", args.oriented_steps],
    }
    for name, options in alone.items():
        ship(run_once(args.work / f"{name}.safetensors", "train", "--defense", "none", *given, *options))
    crossfit = args.work / "crossfit-xfeat.safetensors"
    run_once(crossfit, "dictionary", "build", "--images", folders["2"], "--size", 16_000, "--extractor", "xfeat")
    both = [
        "--defense",
        "none",
        "--defense",
        "ldp:dictionary=shipped-xfeat,words=0",
        "--extractor",
        "xfeat",
        "--crossfit",
        crossfit,
    ]
    schedule = ["--keypoints", "250,1000", "--initial-checkpoint", initial, "--steps", args.xfeat_steps, "--rate", 3e-3]
    ship(run_once(args.work / "inversion-xfeat.safetensors", "train", *both, *given, *schedule))


def split_photographs(data: Path, work: Path) -> dict[str, Path]:
    """Create folders of links to the photographs of each set: unions of thirds named by their digits, and `tune`."""
    tune, test = (set((data / f"{name}.txt").read_text().split()) for name in ("tune", "test"))
    names = sorted(path.name for path in (data / "train").iterdir() if path.name not in tune | test)
    sets = {digits: [name for number, name in enumerate(names) if str(number % 3) in digits] for digits in SETS}
    folders = {}
    for name, members in {**sets, "tune": sorted(tune)}.items():
        folders[name] = work / name
        folders[name].mkdir(parents=True, exist_ok=True)
        for member in members:
            link = folders[name] / member
            link.unlink(missing_ok=True)
            link.symlink_to((data / "train" / member).resolve())
    return folders


def run_once(out: Path, *words: object) -> Path:
    """Run a command of `bench` that writes `out`, unless that exists."""
    if not out.is_file():
        run_command(*words, "--out", out)
    return out


def run_command(*words: object) -> None:
    command = [str(word) for word in words]
    print("bench", *command, flush=True)
    if bench(command) != 0:
        raise SystemExit(1)


def ship(file: Path) -> None:
    shutil.copyfile(file, ASSETS / file.name)


if __name__ == "__main__":
    main()
