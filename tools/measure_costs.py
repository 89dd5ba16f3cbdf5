"""Cost of each registered extractor and metric: core seconds, the least of some repetitions.

Networks and models are loaded before. The page is docs/results/costs.md.

    python tools/measure_costs.py
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from measure_identity import blur, build_table, read
from measure_reads import WORDS, draw_sign
from PIL import Image, ImageOps
from result_page import write_page

from bench.api import Extractor, Metric, Plugin
from bench.core.environment import list_extractor_library_versions
from bench.core.errors import UserError
from bench.core.threads import limit_threads
from bench.extractors.sift import Sift
from bench.identification import distractors, thumbnails
from bench.images import photographs
from bench.registry import discovery, spec
from bench.registry.discovery import Kind
from bench.types import Bytes, Floats
from leaderboard import speed

TEXT = """# Cost of extractors and metrics

Core seconds are CPU time of one thread, with that of programs that a metric executes. Each is the least of {repetitions}
repetitions, once networks and models are loaded. A busy machine gives higher numbers.

Measured with {machine}.

## Extractors

The photographs are built in: {photographs}. They are cropped and resized. Seconds are the mean over them. Settings are the
defaults, with at most 1,000 keypoints.

{extractors}

## Metrics

A pair is a photograph of 256 x 256 pixels with one face and one word, and its blur. Metrics of descriptors and positions compare
those of {keypoints} keypoints. Each repetition has another pair. So seconds include the work that all estimates of a photograph
share, such as the detection of its faces.

{metrics}

## Not measured

{reasons}
"""
REPETITIONS = 3
PHOTOGRAPHS = 3
VARIANTS = {
    "aliked": ("aliked:variant=t16", "aliked", "aliked:variant=n16rot", "aliked:variant=n32"),
    "sift": ("sift", "sift:upright=false"),
}  # extractor -> its rows, if they are several
P = TypeVar("P", bound=Plugin)
Rows = list[tuple[str, ...]]


def read_clock() -> float:
    """Return the CPU seconds of this process, and of the programs that it has executed."""
    programs = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + programs.ru_utime + programs.ru_stime


def measure_least(function: Callable[..., object], inputs: Iterable[tuple[Any, ...]]) -> float:
    """Return the least CPU seconds of some calls, with other arguments each."""
    seconds = []
    for arguments in inputs:
        started = read_clock()
        function(*arguments)
        seconds.append(read_clock() - started)
    return min(seconds)


def format_seconds(seconds: float) -> str:
    return "below 0.001" if seconds < 0.001 else f"{seconds:.2g}"


def resize(source: photographs.Source) -> Bytes:
    """Return a photograph, cropped and resized. -> (480, 640, 3) uint8"""
    return np.asarray(ImageOps.fit(photographs.decode(source)[0], (640, 480), Image.Resampling.BICUBIC))


def measure_extractor(extractor: Extractor, sizes: Sequence[Sequence[Bytes]]) -> Iterator[str]:
    """Yield the dimensions of descriptors; then, for the images (H, W, 3) of each size, numbers of keypoints and mean seconds."""
    for number, images in enumerate(sizes):
        features = [extractor.extract(image) for image in images]  # the first call loads the network
        if number == 0:
            yield str(features[0].descriptors.shape[1])
        counts = sorted(len(one) for one in features)
        yield " to ".join(f"{count:,}" for count in dict.fromkeys((counts[0], counts[-1])))
        yield format_seconds(float(np.mean([measure_least(extractor.extract, [(image,)] * REPETITIONS) for image in images])))


def draw_pair(compares: str, shift: int) -> tuple[Floats, Floats]:
    """Return a truth and an estimate for a metric that `compares` such pairs. Another shift, in pixels, gives another pair."""
    portrait = read(photographs.list_people()[0])
    portrait[-48:] = draw_sign(WORDS[:1], 20)[:48]
    truth = np.roll(portrait, shift, axis=1)
    estimate = blur(truth, 1)
    if compares == "images":
        return truth, estimate
    if compares == "views":
        others = distractors.load_distractors().thumbnails[: distractors.COUNT]
        return np.concatenate([thumbnails.compute_thumbnail(truth)[None], others]), estimate
    features = Sift().extract(np.rint(truth * 255).astype(np.uint8))
    rows = features.descriptors if compares == "descriptors" else features.keypoints
    return rows, rows[::-1].copy()


def measure_metric(metric: Metric) -> Iterator[str]:
    """Yield what a metric compares and requires, and the seconds of a pair.

    Raises
    ------
    UserError
        if the pair has no value.
    """
    first, *pairs = [draw_pair(metric.compares, shift) for shift in range(REPETITIONS + 1)]
    if metric(*first) is None:  # this call loads the models
        raise UserError(f"{metric.name()}: the pair has no value")
    yield from (metric.compares, ", ".join((*metric.packages, *metric.programs)) or "nothing")
    yield format_seconds(measure_least(metric, pairs))


def measure_each(texts: Iterable[str], kind: Kind[P], measure: Callable[[P], Iterable[str]]) -> tuple[Rows, Rows]:
    """Return a row for each plugin that can be built, and the reason why others cannot."""
    measured, reasons = Rows(), Rows()
    for text in texts:
        try:
            measured.append((f"`{text}`", *measure(spec.read(text, kind))))
        except UserError as error:
            reasons.append((f"`{text}`", str(error)))
    return measured, reasons


def describe_machine() -> Iterator[str]:
    """Yield the instruction set, and the versions of libraries."""
    yield f"one core ({speed.name_instruction_set()})"
    yield from (f"{library} {version}" for library, version in list_extractor_library_versions().items())


def write_results(extractors: Iterable[str], metrics: Sequence[str]) -> None:
    """Measure plugins by their names, and write the page."""
    sources = photographs.list_builtin()[:PHOTOGRAPHS]
    sizes = [[photographs.read(source.path).pixels for source in sources], [resize(source) for source in sources]]
    texts = [text for name in extractors for text in VARIANTS.get(name, (name,))]
    extractor_rows, reasons = measure_each(texts, discovery.EXTRACTOR, lambda extractor: measure_extractor(extractor, sizes))
    metric_rows, other_reasons = measure_each(metrics, discovery.METRIC, measure_metric)
    text = TEXT.format(
        repetitions=REPETITIONS,
        machine=", ".join(describe_machine()),
        photographs=", ".join(source.path.stem for source in sources),
        extractors=build_table(
            ("extractor", "dimensions", "keypoints, 256 x 256", "core seconds", "keypoints, 480 x 640", "core seconds"),
            extractor_rows,
        ),
        keypoints=len(draw_pair("positions", 0)[0]),
        metrics=build_table(("metric", "compares", "requires", "core seconds"), metric_rows),
        reasons=build_table(("plugin", "reason"), [*reasons, *other_reasons]),
    )
    write_page("costs.md", text, [dict(discovery.load_plugin(discovery.METRIC, name).parameters) for name in metrics])


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    limit_threads(1)
    write_results(discovery.discover(discovery.EXTRACTOR), [*discovery.discover(discovery.METRIC)])


if __name__ == "__main__":
    main()
