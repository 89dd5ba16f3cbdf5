"""Rebuilds what `bench/assets` ships from a folder with `train/`, `tune.txt` and `test.txt`. Takes hours, resumes.

The photographs of `train/` that are in neither list are parted by name into three thirds. The dictionary is made from the first
two thirds, the attacker's public database from the last. Two more dictionaries, each made from another two thirds, quantise the
photographs that the shipped dictionary was made from while networks are trained; they are not shipped. All networks start from
one that was trained on raw descriptors, and are then trained equally long for their own releases.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from bench.cli import main as bench
from bench.public import ASSETS

WORDS, PUBLIC_WORDS = 256_000, 128_000
# As the shipped networks were trained. The one for LDP-Feat knows the whole dictionary and reads sets in their order.
DEFENSES = {"none": ["none"], "affine": ["affine"], "ldp": ["ldp:words=0", "--encoding", "released"]}
NARROW = "32,64,128,192,192"  # channels of the network for positions, so that all files together stay small


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="kept between runs; what is done is not done again")
    parser.add_argument(
        "--steps", type=int, default=1000, help="of each network's own training; the common start has four times as many"
    )
    args = parser.parse_args()
    folders = part(args.data, args.work / "photographs")
    dictionaries = {name: args.work / f"{name}.safetensors" for name in ("01", "02", "12", "2")}
    for name, file in dictionaries.items():
        if not file.is_file():
            run("dictionary", "build", "--images", folders[name], "--size", PUBLIC_WORDS if name == "2" else WORDS, "--out", file)
    shutil.copyfile(dictionaries["01"], ASSETS / "dictionary.safetensors")
    shutil.copyfile(dictionaries["2"], ASSETS / "public-database.safetensors")
    given = ["--images", folders["012"], "--validation", folders["tune"]]
    start = args.work / "start.safetensors"
    if not start.is_file():
        run("train", "--defense", "none", *given, "--steps", 4 * args.steps, "--out", start)
    for name, defense in DEFENSES.items():
        network = args.work / f"inversion-{name}.safetensors"
        if not network.is_file():
            crossfit = ["--crossfit", dictionaries["02"], "--crossfit", dictionaries["12"]]
            further = ["--start", start, "--steps", args.steps, "--rate", 1e-3]
            run("train", "--defense", *defense, *given, *crossfit, *further, "--out", network)
        shutil.copyfile(network, ASSETS / network.name)
    positions = args.work / "positions.safetensors"
    if not positions.is_file():
        shape = ["--encoding", "positions", "--widths", NARROW]
        run("train", "--defense", "none", *given, *shape, "--steps", 4 * args.steps // 5, "--out", positions)
    shutil.copyfile(positions, ASSETS / positions.name)


def part(data: Path, work: Path) -> dict[str, Path]:
    """Folders of links to the photographs of each set: unions of thirds named by their digits, and `tune`."""
    tune, test = (set((data / f"{name}.txt").read_text().split()) for name in ("tune", "test"))
    names = sorted(path.name for path in (data / "train").iterdir() if path.name not in tune | test)
    sets = {
        digits: [name for number, name in enumerate(names) if str(number % 3) in digits]
        for digits in ("01", "02", "12", "2", "012")
    }
    folders = {}
    for name, members in {**sets, "tune": sorted(tune)}.items():
        folders[name] = work / name
        folders[name].mkdir(parents=True, exist_ok=True)
        for member in members:
            link = folders[name] / member
            link.unlink(missing_ok=True)
            link.symlink_to((data / "train" / member).resolve())
    return folders


def run(*words: object) -> None:
    command = [str(word) for word in words]
    print("bench", *command, flush=True)
    if bench(command) != 0:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
