"""Writes the distractors of the metric `identified`, and the table of their authors, from a folder with `train/` and its lists.

    python tools/make_distractors.py --data DATA

256 photographs of `train/` that are in neither `tune.txt` nor `test.txt` are drawn with seed 0 from the sorted names. The file's
digest is part of the metric: put the printed one into `bench/identification/distractors.py`.
"""

from __future__ import annotations

import argparse
import csv
import html
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.codebook.public import ASSETS
from bench.formats import tensor_file
from bench.identification.distractors import COUNT, FILE, KIND, MOST_SIMILAR
from bench.identification.thumbnails import compare_thumbnails, compute_thumbnail
from bench.images import photographs

SEED = 0
SOURCE = "development set of the NIPS 2017 adversarial competition, photographs by their authors, CC BY 2.0: distractors.csv"
CHANGES = "largest centred square at 256 x 256 pixels, its blurred luminance averaged to 16 x 16, its mean colour"
ATTRIBUTION = {"photograph": "ImageId", "author": "Author", "page": "OriginalLandingURL", "licence": "License"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=ASSETS, help="folder of both files")
    args = parser.parse_args()
    names = draw_names(args.data)
    print(write_distractors(args.data, names, args.out / FILE.name))
    write_attribution(args.data, names, (args.out / FILE.name).with_suffix(".csv"))


def draw_names(data: Path) -> list[str]:
    """Return the names of 256 training photographs, in random order: 255 distractors and a spare."""
    held_out = {name for split in ("tune", "test") for name in (data / f"{split}.txt").read_text().split()}
    names = sorted({path.name for path in (data / "train").iterdir()} - held_out)
    return [str(name) for name in np.random.default_rng(SEED).choice(names, COUNT + 1, replace=False)]


def write_distractors(data: Path, names: Sequence[str], out: Path) -> str:
    """Write thumbnails and mean colours, and return the digest of the file."""
    images = [photographs.read(data / "train" / name).pixels / 255.0 for name in names]
    thumbnails = np.rint([compute_thumbnail(image) * 255 for image in images]).astype(np.uint8)  # (256, 16, 16)
    similarities = compare_thumbnails(thumbnails[:, None] / 255.0, thumbnails[None] / 255.0)
    np.fill_diagonal(similarities, 0.0)
    if similarities.max() >= MOST_SIMILAR:
        raise SystemExit(f"two of the photographs are too similar ({similarities.max():.3f}); draw others")
    colours = np.array([image.mean(axis=(0, 1)) for image in images], np.float32)  # (256, 3)
    meta = {"photographs": list(names), "source": SOURCE, "changes": CHANGES, "seed": SEED}
    return tensor_file.save(out, KIND, {"thumbnails": thumbnails, "colours": colours}, meta)


def write_attribution(data: Path, names: Sequence[str], out: Path) -> None:
    """Write author, page and licence of each photograph."""
    with (data / "train_attribution.csv").open(encoding="utf-8", newline="") as file:
        rows = {row["ImageId"]: row for row in csv.DictReader(file)}
    with out.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(ATTRIBUTION)
        for name in names:
            writer.writerow([decode_escapes(rows[Path(name).stem][column]) for column in ATTRIBUTION.values()])


def decode_escapes(text: str) -> str:
    r"""Return a text with octal escapes of UTF-8 and entities of HTML.

    >>> decode_escapes(r"Adri\303\241n &amp; Co")
    'Adrián & Co'
    """
    plain = re.sub(r"(?:\\[0-7]{3})+", lambda match: bytes(int(byte, 8) for byte in match[0].split("\\")[1:]).decode(), text)
    return html.unescape(plain)


if __name__ == "__main__":
    main()
