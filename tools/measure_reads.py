"""Calibration of the metric `reads` on pairs with known answers, and the words that it reads in reconstructions.

The photographs are a printed page from the wheel of scikit-image, and signs with rendered words. The program Tesseract has to be
installed. The page is docs/results/reads.md.

    python tools/measure_reads.py
"""

from __future__ import annotations

import argparse
import resource
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import skimage.data
from measure_identity import blur, build_table, draw_noises, read, reconstruct
from PIL import Image, ImageDraw, ImageFont
from result_page import write_page

from bench.identification import words
from bench.images import photographs
from bench.images.photographs import Source
from bench.types import Floats
from metrics.reads import Reads

TEXT = """# Text: calibration

[Metrics of optional extras](../method.md#metrics-of-optional-extras) describes the metric `reads`. The photographs are a printed
page from scikit-image (`page`), and signs with six rendered words of {sizes} pixels in height. A blur is Gaussian, with its
standard deviation. In brackets: number of words that are read again.

## Pairs with known answers

{pairs}

## Images without text

*words*: number of words that Tesseract reads there, of at least 3 characters and with a confidence of at least 60. The last row
has the reconstructions of the next section from positions alone.

{others}

## Reconstructions

The shipped networks reconstruct the four photographs from upright SIFT features, with seed 0.

{reconstructions}

## Cost

Reading one image takes {seconds:.2f} seconds of one core: CPU time of the program with its start, the mean over {count} images.
It is noisy, since other processes shared the machine. All attacks on a photograph share the words of the photograph.
"""
SIZES = (12, 20, 32)  # pixels, of the font
WORDS = "station", "market", "harbour", "library", "museum", "garden"
OTHER_WORDS = "hospital", "bridge", "theatre", "school", "airport", "castle"


def draw_sign(lines: Sequence[str], size: int) -> Floats:
    """Return words in black on grey, one in each line. -> (256, 256, 3) float32 in [0, 1]"""
    picture = Image.new("RGB", (256, 256), "lightgrey")
    for number, line in enumerate(lines):
        ImageDraw.Draw(picture).text((20, 12 + 40 * number), line.upper(), "black", ImageFont.load_default(size))
    return (np.asarray(picture) / 255).astype(np.float32)


def list_texts(folder: Path) -> list[Source]:
    """Return the page, and a sign of each size, which is written to a folder."""
    page = Path(skimage.data.__file__).parent / "page.png"
    sources = [Source("page", page)]
    for size in SIZES:
        path = folder / f"sign-{size}.png"
        Image.fromarray(np.rint(draw_sign(WORDS, size) * 255).astype(np.uint8)).save(path)
        sources.append(Source(path.stem, path))
    return sources


def list_known_pairs(photograph: Floats, others: Floats) -> dict[str, Floats]:
    """Return estimates of a photograph with known answers."""
    return {
        "itself": photograph,
        **{f"blur of {sigma} pixels": blur(photograph, sigma) for sigma in (0.5, 1, 2, 4)},
        "shifted by 2 pixels": np.roll(photograph, 2, axis=1),
        "mirrored": photograph[:, ::-1],
        "other words": others,
        "grey": np.full_like(photograph, 0.5),
        "white noise": next(draw_noises()),
    }


def count_words(image: Floats) -> int:
    return len(words.select_legible(words.read_words(image.astype(np.float64), Reads().model)))


def compare(truths: Sequence[Floats], estimates: Sequence[Floats]) -> Iterator[str]:
    """Yield the fraction and the number of words that are read again, for each photograph."""
    for truth, estimate in zip(truths, estimates, strict=True):
        value = Reads()(truth, estimate)
        yield "n/a" if value is None else f"{value:.2f} [{value * count_words(truth):.0f}]"


def count_in_others(reconstructions: Mapping[str, Sequence[Floats]]) -> Iterator[tuple[str, str, str]]:
    """Yield a set of images without text, their number, and the number of words that are read in them."""
    sets = {
        "built-in photographs": [read(source) for source in photographs.list_builtin()],
        "white and smooth noise": list(draw_noises()),
        "reconstructions from positions": next(images for name, images in reconstructions.items() if "keypoints" in name),
    }
    for name, images in sets.items():
        yield name, str(len(images)), str(sum(map(count_words, images)))


def measure_seconds(images: Sequence[Floats]) -> float:
    """Return the mean CPU time of Tesseract for an image."""
    started = resource.getrusage(resource.RUSAGE_CHILDREN)
    for image in images:
        words._read_words.cache_clear()
        count_words(image)
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (ended.ru_utime + ended.ru_stime - started.ru_utime - started.ru_stime) / len(images)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sources = list_texts(Path(folder))
        truths = [read(source) for source in sources]
        reconstructions, configurations = reconstruct(sources)
    unlike = [draw_sign(OTHER_WORDS, size) for size in (SIZES[1], *SIZES)]
    known = [list_known_pairs(truth, other) for truth, other in zip(truths, unlike, strict=True)]
    headings = [f"{source.name}: {count_words(truth)} words" for source, truth in zip(sources, truths, strict=True)]
    text = TEXT.format(
        sizes=", ".join(map(str, SIZES)),
        pairs=build_table(
            ["estimate", *headings], [(name, *compare(truths, [pair[name] for pair in known])) for name in known[0]]
        ),
        others=build_table(["images", "number", "words"], count_in_others(reconstructions)),
        reconstructions=build_table(
            ["reconstruction", *headings], [(name, *compare(truths, images)) for name, images in reconstructions.items()]
        ),
        count=len(truths) + len(photographs.list_builtin()),
        seconds=measure_seconds([*truths, *map(read, photographs.list_builtin())]),
    )
    write_page("reads.md", text, configurations)


if __name__ == "__main__":
    main()
