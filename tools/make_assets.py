"""Rebuilds the files of `bench/assets` from a folder with `train/`, `tune.txt` and `test.txt`. Takes hours; can be resumed.

The photographs of `train/` that are in neither list are split by name into three thirds. The dictionaries are built from the
first two thirds, the attacker's public database from the last. A network that reads releases is trained on photographs that its
dictionary was not built from: those of the last third, or all with a second dictionary that is built from the last third. Most
networks start from one that was trained on raw upright descriptors of all photographs. `train_word_attackers.py` trains the
attackers of word sets of upright SIFT afterwards. Then this program with `--samplers` trains the networks that sample
photographs, since they read the reconstructions of the others.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import dataclass
from pathlib import Path

from bench.cli import main as bench
from bench.codebook.public import ASSETS
from bench.settings import Asset

WORDS = 256_000
DICTIONARIES = (  # file, set of photographs, words, extractor
    ("dictionary", "01", WORDS, "sift"),
    ("public-database", "2", 128_000, "sift"),
    ("dictionary-xfeat", "01", 16_000, "xfeat"),
    ("dictionary-aliked", "01", 16_000, "aliked"),
)
# A dictionary for photographs that a shipped dictionary was built from; not shipped.
CROSSFIT = ("crossfit-xfeat", "2", 16_000, "xfeat")
SETS = ("01", "02", "12", "2", "012")  # of thirds of the photographs
NARROW, SLIM, SMALL = "32,64,112,56", "32,48,64,64", "24,32,48,48"  # widths


@dataclass(frozen=True, kw_only=True)
class Training:
    """A network. It starts from the network of `initial`, or from random weights."""

    file: str
    defenses: tuple[str, ...]
    steps: int
    rate: float = 3e-3
    photographs: str = "012"
    initial: str | None = "inversion-none"
    widths: str | None = None
    options: tuple[str, ...] = ()
    crossfit: str | None = None


FIRST = Training(file="start", defenses=("none",), steps=17_800, rate=4e-3, initial=None)  # the common stage, not shipped
LEARNED = ("--keypoints", "250,1000", "--extractor")
ORIENTED = ("--extractor", "sift:upright=false")
ALIKED = "aliked:detection_threshold=0"
TRAININGS = (
    Training(file="inversion-none", defenses=("none",), steps=4500, rate=2e-3, photographs="2", initial="start"),
    Training(file="inversion-affine", defenses=("affine",), steps=4500, rate=2e-3, photographs="2", initial="start"),
    Training(file="positions", defenses=("none",), steps=4500, rate=4e-3, initial=None, options=("--encoding", "positions")),
    Training(file="inversion-oriented", defenses=("none",), steps=20_800, rate=4e-3, initial=None, options=ORIENTED),
    *(
        Training(
            file=f"inversion-oriented-{defense}",
            defenses=(defense,),
            steps=steps,
            photographs="2",
            initial="inversion-oriented",
            widths=NARROW,
            options=ORIENTED,
        )
        for defense, steps in (("affine", 2000), ("ldp", 1600))
    ),
    Training(
        file="inversion-mechanisms",
        defenses=("plateau", "exponential", "privunit", "naive-ldp"),
        steps=2000,
        photographs="2",
        widths=SLIM,
    ),
    Training(
        file="inversion-liftings",
        defenses=("affine:lifting=random", "affine:lifting=adversarial"),
        steps=2600,
        photographs="2",
        initial="inversion-affine",
        widths=SLIM,
    ),
    Training(
        file="inversion-xfeat",
        defenses=("none", "ldp:dictionary=shipped-xfeat,words=0"),
        steps=2600,
        options=(*LEARNED, "xfeat"),
        crossfit=CROSSFIT[0],
    ),
    Training(
        file="inversion-xfeat-affine",
        defenses=("affine:database=shipped-xfeat",),
        steps=2600,
        widths=NARROW,
        options=(*LEARNED, "xfeat"),
        crossfit=CROSSFIT[0],
    ),
    Training(
        file="inversion-aliked",
        defenses=("none", "ldp:dictionary=shipped-aliked,words=0"),
        steps=2600,
        photographs="2",  # its extraction is slow
        widths=SLIM,
        options=(*LEARNED, ALIKED),
    ),
    *(
        Training(
            file=f"positions-{name}",
            defenses=("none",),
            steps=1000,
            rate=4e-3,
            photographs=photographs,
            initial=None,
            widths=SMALL,
            options=(*extractor, "--encoding", "positions"),
        )
        for name, photographs, extractor in (
            ("oriented", "012", ORIENTED),
            ("xfeat", "012", (*LEARNED, "xfeat")),
            ("aliked", "2", (*LEARNED, ALIKED)),
        )
    ),
    Training(file="line-inversion", defenses=("lines", "permutation"), steps=3000, widths=NARROW),
)
SAMPLERS = (
    Training(
        file="flow-sift",
        defenses=("none", "affine", "ldp"),
        steps=4000,
        photographs="2",
        widths=NARROW,
        options=("--model", "flow", "--drafts", "shipped", "--encoding", "positions"),
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="folder of finished files, reused between runs")
    parser.add_argument("--fraction", type=float, default=1.0, help="of the steps of each training, for a test")
    parser.add_argument("--samplers", action="store_true", help="train the networks that sample photographs, after all others")
    args = parser.parse_args()
    folders = split_photographs(args.data, args.work / "photographs")
    if not args.samplers:
        for file, photographs, words, extractor in (*DICTIONARIES, CROSSFIT):
            build = "dictionary", "build", "--images", folders[photographs], "--size", words, "--extractor", extractor
            run_once(args.work / f"{file}.safetensors", *build)
        for file, *_ in DICTIONARIES:
            ship(args.work / f"{file}.safetensors")
        train(FIRST, folders, args.work, args.fraction)
    for training in SAMPLERS if args.samplers else TRAININGS:
        ship(train(training, folders, args.work, args.fraction))


def train(training: Training, folders: dict[str, Path], work: Path, fraction: float) -> Path:
    """Train a network, unless its file exists."""
    words: list[object] = ["--images", folders[training.photographs], "--validation", folders["tune"], *training.options]
    for defense in training.defenses:
        words += ["--defense", defense]
    if training.initial:
        words += ["--initial-checkpoint", work / f"{training.initial}.safetensors"]
    if training.widths:
        words += ["--widths", training.widths]
    if training.crossfit:
        words += ["--crossfit", work / f"{training.crossfit}.safetensors"]
    steps = max(1, round(fraction * training.steps))
    return run_once(work / f"{training.file}.safetensors", "train", *words, "--steps", steps, "--rate", training.rate)


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


def build_crossfit_dictionaries(folders: dict[str, Path], work: Path) -> list[Asset]:
    """Build two dictionaries as large as the shipped one, each without the photographs of one of its thirds, once."""
    files = {digits: work / f"dictionary-{digits}.safetensors" for digits in ("12", "02")}
    return [
        Asset(run_once(file, "dictionary", "build", "--images", folders[digits], "--size", WORDS))
        for digits, file in files.items()
    ]


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
