"""Measures leakage curves: scores of `dia` against its training samples and its training photographs.

    python tools/measure_curves.py --data DATA --work work/curves [--release none ...] [--axis samples ...]

Each point is a network that is trained from random weights with a whole schedule of its own. The photographs of a smaller set
are part of a larger one. Networks are scored on the photographs of `tune.txt`, by which nothing is chosen here. Finished
trainings and records in WORK are reused, and an interrupted training resumes. Writes docs/results/curves.md and
docs/images/curves.png for the curves that are finished, so the curves can be measured one by one.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from make_assets import build_crossfit_dictionaries, split_photographs
from numpy.typing import NDArray
from result_page import format_interval, save_figure, write_page

import bench
from attacks.blank import Blank
from attacks.dia import DIA
from attacks.keypoints import Keypoints
from bench.api import Defense, Extractor
from bench.core.table import markdown_row
from bench.images.photographs import Source, list_photographs
from bench.inversion.data import Target
from bench.inversion.plan import Plan, Training
from bench.inversion.train import train
from bench.registry import discovery, spec
from bench.runner.records import Record
from bench.settings import Asset
from leaderboard.chance import IDENTIFIED, LOG_RECIPROCAL_RANK
from leaderboard.intervals import MIN_SAMPLES, Estimate, estimate_mean
from leaderboard.plot_style import choose_styles
from leaderboard.signal import SIGNIFICANCE, collect_values, judge_signal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Doubles = NDArray[np.float64]
Values = Mapping[str, Mapping[str, float]]  # metric -> photograph -> value
Key = tuple[str, str]  # release, axis

TITLE = """# Leakage curves

Scores of `dia` against the effort of the attacker: {samples} training samples from {most} photographs, and {fixed}
training samples from {photographs} photographs. Each network was trained once, from random weights, without the context
model of the shipped network for `ldp`. So its scores on `ldp` are lower than those of the shipped attacker. Scored on
{scored} photographs, which no network was trained on. [Leakage curves](../curves.md) explains the fit.

![Scores against training samples and photographs](../images/curves.png)
"""
RELEASES = {  # name -> defense, extractor
    "none": ("none", "sift"),
    "affine": ("affine:dim=4", "sift"),
    "ldp-12": ("ldp:epsilon=12", "sift"),
    "ldp-10": ("ldp:epsilon=10", "sift"),
    "xfeat": ("none", "xfeat"),
}
SAMPLES = (600, 2_000, 6_000, 20_000)
PHOTOGRAPHS = (100, 200, 400, 800)
FIXED = 6_000  # training samples of the curve of photographs
AXES = {"samples": "training samples", "photographs": "training photographs"}
LABELS = {"ssim": ("SSIM", 3), IDENTIFIED: ("identification, doublings of the rank above chance", 2)}  # metric -> label, digits
ZEROS = {"ssim": 0.0, IDENTIFIED: LOG_RECIPROCAL_RANK}  # metric -> value that counts as zero: the mean of a random order
BATCH, RATE = 8, 4e-3
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "curves.png"
TENFOLD = math.log2(10)  # doublings


@dataclass(frozen=True, kw_only=True)
class Point:
    """The effort of one attacker."""

    samples: int
    photographs: int

    def get_effort(self, axis: str) -> int:
        return self.samples if axis == "samples" else self.photographs


@dataclass(frozen=True, kw_only=True)
class Curve:
    """The scores of attackers of growing effort."""

    efforts: tuple[int, ...]
    values: tuple[Values, ...]  # of each attacker
    baselines: Mapping[str, Values]  # name -> values

    def select(self, metric: str) -> Doubles:
        """Return the values of the photographs that all attackers have. -> (attackers, photographs)"""
        samples = [name for name in self.values[0][metric] if all(name in each[metric] for each in self.values)]
        return np.array([[each[metric][name] - ZEROS[metric] for name in samples] for each in self.values])

    @property
    def has_signal(self) -> bool:
        """Whether the attacker of the greatest effort beats the baselines."""
        signal = judge_signal(self.values[-1], list(self.baselines.items()), tuple(self.baselines))
        return signal.word == "yes"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of train/, tune.txt and test.txt")
    parser.add_argument("--work", type=Path, required=True, help="folder of networks and records, reused between runs")
    parser.add_argument("--release", nargs="+", choices=RELEASES, default=list(RELEASES), help="measure these (default: all)")
    parser.add_argument("--axis", nargs="+", choices=AXES, default=list(AXES), help="against this (default: both)")
    parser.add_argument("--fraction", type=float, default=1.0, help="of all training samples, for a test")
    args = parser.parse_args()
    write_results(Study(args.data, args.work, args.fraction), args.release, args.axis)


def write_results(study: Study, releases: Sequence[str], axes: Sequence[str]) -> None:
    """Measure the given curves, and write the page and the picture of all curves whose networks exist."""
    for name, axis in itertools.product(releases, axes):
        for point in study.list_points(axis):
            study.train(name, point)
    curves = {key: study.measure(*key) for key in itertools.product(RELEASES, AXES) if study.is_trained(*key)}
    save_figure(draw_curves(curves), PICTURE, study.records)
    write_page("curves.md", format_page(curves, study), study.records)


class Study:
    """Trainings and their scores; each is done once."""

    def __init__(self, data: Path, work: Path, fraction: float = 1.0) -> None:
        self.work, self.fraction = work, fraction
        self.folders = split_photographs(data, work / "photographs")
        self.photographs = order_photographs(list_photographs(self.folders["012"]))
        self.unseen = list_photographs(self.folders["tune"])
        self.records: list[Record] = []

    def list_points(self, axis: str) -> list[Point]:
        """Return the points of a curve, in ascending order of the effort."""
        if axis == "samples":
            return [Point(samples=self.scale(samples), photographs=len(self.photographs)) for samples in SAMPLES]
        available = min(1.0, len(self.photographs) / PHOTOGRAPHS[-1])
        return [Point(samples=self.scale(FIXED), photographs=max(1, round(available * count))) for count in PHOTOGRAPHS]

    def scale(self, samples: int) -> int:
        """Return that fraction of a number of samples, in whole batches."""
        return BATCH * max(1, round(self.fraction * samples / BATCH))

    def name_network(self, name: str, point: Point) -> Path:
        return self.work / f"{name}-{point.samples}-{point.photographs}.safetensors"

    def is_trained(self, name: str, axis: str) -> bool:
        return all(self.name_network(name, point).is_file() for point in self.list_points(axis))

    def measure(self, name: str, axis: str) -> Curve:
        """Score the networks of a curve."""
        points = self.list_points(axis)
        scored = [self.attack(name, self.name_network(name, point)) for point in points]
        return Curve(
            efforts=tuple(point.get_effort(axis) for point in points),
            values=tuple(collect_values(records["dia"]) for records in scored),
            baselines={one: collect_values(scored[0][one]) for one in ("blank", "keypoints") if has_scores(scored[0][one])},
        )

    def train(self, name: str, point: Point) -> None:
        """Train one network, unless it exists. Each photograph is quantised by a dictionary that was not built from it."""
        out = self.name_network(name, point)
        if not out.is_file():
            print(f"{name}: {point.samples} training samples from {point.photographs} photographs", flush=True)
            defense, extractor = read_release(name)
            plan = Plan(
                targets=[Target(defense=defense, supported_settings={})],
                photographs=self.photographs[: point.photographs],
                validation=self.unseen,
                extractor=extractor,
                crossfit=build_crossfit_dictionaries(self.folders, self.work) if defense.dictionary_field else (),
                training=build_schedule(point.samples),
            )
            train(plan, out)

    def attack(self, name: str, network: Path) -> dict[str, list[Record]]:
        """Return the records of the attacker and of the baselines, by attack."""
        attacks = [DIA(weights=Asset(network)), Keypoints(), Blank()]
        defense, extractor = read_release(name)
        records = bench.run([defense], attacks, self.unseen, extractor=extractor, out=self.work / "records" / name)
        self.records += records
        return {one.name(): [record for record in records if record["attack"]["name"] == one.name()] for one in attacks}


def read_release(name: str) -> tuple[Defense, Extractor]:
    """Return the defense and the extractor of a release."""
    defense, extractor = RELEASES[name]
    return spec.read(defense, discovery.DEFENSE), spec.read(extractor, discovery.EXTRACTOR)


def order_photographs(sources: Sequence[Source]) -> list[Source]:
    """Return photographs in the order of their content hashes, so that any first part is a random sample."""
    return sorted(sources, key=lambda source: source.content_hash())


def build_schedule(samples: int) -> Training:
    """Return a whole schedule for a number of training samples."""
    steps = samples // BATCH
    return Training(steps=steps, batch=BATCH, rate=RATE, warmup=min(Training.warmup, steps // 10))


def has_scores(records: Sequence[Record]) -> bool:
    return any(record["status"] == "ok" for record in records)


# ---- fit


@dataclass(frozen=True, kw_only=True)
class Fit:
    """The line  mean score = level + slope · log2(effort / greatest effort)."""

    level: float  # at the greatest effort
    slope: Estimate  # per doubling
    last: Estimate  # per doubling, between the two greatest efforts


def fit_line(efforts: Sequence[int], values: Doubles) -> Fit:
    """Fit a line to the mean scores of k ≥ 3 attackers on n photographs, by least squares.

    The slope is linear in the scores, so it is the mean of the photographs' slopes. Its variance is the sum of two parts: that of
    this mean over photographs, and that of the line's residuals. The latter covers what all photographs of a network have in
    common, such as the chance of its training, and any curvature. It has only k − 2 degrees of freedom, and so has the sum:
    by those of Welch and Satterthwaite, about 10% of the curves of random trainings would rise or fall, and not 5%.

    Parameters
    ----------
    efforts : (k,)
    values : (k, n)
    """
    x = np.log2(np.asarray(efforts, dtype=np.float64) / efforts[-1])
    centred = x - x.mean()
    weights = centred / (centred @ centred)  # slope = weights · scores
    own = estimate_mean(weights @ values)
    means = values.mean(axis=1)
    level = float(means.mean() - own.mean * x.mean())
    residuals = means - level - own.mean * x
    freedom = len(x) - 2
    common = float(residuals @ residuals) / freedom / float(centred @ centred)  # variance of the slope
    slope = Estimate(mean=own.mean, error=math.hypot(own.error, math.sqrt(common)), freedom=freedom, count=own.count)
    return Fit(level=level, slope=slope, last=estimate_mean((values[-1] - values[-2]) / (x[-1] - x[-2])))


def describe_trend(curve: Curve, metric: str) -> str:
    """Return what a reader can conclude from a curve: whether the lower bound of the leakage still rises."""
    values = curve.select(metric)
    if not curve.has_signal:
        return "nothing: the attacker of the greatest effort is at the baselines"
    if values.shape[1] < MIN_SAMPLES:
        return f"nothing: fewer than {MIN_SAMPLES} photographs"
    return judge_fit(fit_line(curve.efforts, values))


def judge_fit(fit: Fit) -> str:
    """Return whether the slope and the last step are above zero."""
    if fit.slope.p_below(0.0) < SIGNIFICANCE:
        return "scores fall: the trainings failed"
    if fit.slope.p_above(0.0) >= SIGNIFICANCE:
        return "nothing: the slope may be zero"
    if fit.last.p_above(0.0) >= SIGNIFICANCE:
        return "rises, but not shown to rise at the end"
    return "still rises"


# ---- page


def format_page(curves: Mapping[Key, Curve], study: Study) -> str:
    """Return the page: the fit of each curve, then all scores."""
    title = TITLE.format(
        samples=join(point.samples for point in study.list_points("samples")),
        photographs=join(point.photographs for point in study.list_points("photographs")),
        fixed=f"{study.scale(FIXED):,}",
        most=f"{len(study.photographs):,}",
        scored=len(study.unseen),
    )
    lines = [*title.splitlines(), "", *format_fits(curves), *format_scores(curves)]
    missing = [f"`{name}` against {AXES[axis]}" for name, axis in itertools.product(RELEASES, AXES) if (name, axis) not in curves]
    return "\n".join([*lines, *(["", f"Not measured: {', '.join(missing)}."] if missing else [])])


def join(numbers: Iterable[int]) -> str:
    *first, last = (f"{number:,}" for number in numbers)
    return f"{', '.join(first)} and {last}" if first else last


def format_fits(curves: Mapping[Key, Curve]) -> Iterator[str]:
    yield "## Fits"
    yield ""
    yield "*Gain of ten times the effort*: the slope, extrapolated. It is a prediction and no measurement."
    yield ""
    yield markdown_row(
        ("release", "effort", "measure", "greatest effort", "score", "slope per doubling", "last step", "tenfold", "conclusion")
    )
    yield markdown_row(["---"] * 9)
    for (name, axis), curve in curves.items():
        for metric, (label, digits) in LABELS.items():
            values = curve.select(metric)
            if values.shape[1] == 0:
                continue
            fit = fit_line(curve.efforts, values)
            slope = fit.slope.interval()
            yield markdown_row(
                (
                    describe_release(name),
                    AXES[axis],
                    label,
                    f"{curve.efforts[-1]:,}",
                    format_interval(estimate_mean(values[-1]).interval(), digits),
                    format_interval(slope, digits + 1, "+"),
                    format_interval(fit.last.interval(), digits + 1, "+"),
                    f"{TENFOLD * slope.mean:+.{digits}f} [{TENFOLD * slope.low:+.{digits}f}, {TENFOLD * slope.high:+.{digits}f}]",
                    describe_trend(curve, metric),
                )
            )


def format_scores(curves: Mapping[Key, Curve]) -> Iterator[str]:
    yield from ("", "## Scores", "")
    yield markdown_row(("release", "effort", *(label for label, _ in LABELS.values())))
    yield markdown_row(["---"] * (2 + len(LABELS)))
    for (name, axis), curve in curves.items():
        rows = [(f"{effort:,} {AXES[axis]}", values) for effort, values in zip(curve.efforts, curve.values, strict=True)]
        rows += [(f"`{baseline}`", values) for baseline, values in curve.baselines.items()] if axis == "samples" else []
        for effort, values in rows:
            scores = [
                format_interval(estimate_mean(list_scores(values, metric)).interval(), digits) if values[metric] else "n/a"
                for metric, (_, digits) in LABELS.items()
            ]
            yield markdown_row((describe_release(name), effort, *scores))


def list_scores(values: Values, metric: str) -> Doubles:
    return np.array(list(values[metric].values())) - ZEROS[metric]


def describe_release(name: str) -> str:
    defense, extractor = RELEASES[name]
    return f"`{defense}`" if extractor == "sift" else f"`{defense}`, `{extractor}`"


def draw_curves(curves: Mapping[Key, Curve]) -> Figure:
    """Draw the scores with intervals, the fits, and the greatest baseline of each release as a thin line."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 7.0), layout="constrained")
    grid = figure.subplots(len(LABELS), len(AXES), sharey="row", squeeze=False)
    styles = choose_styles(RELEASES)
    for (row, (metric, (label, _))), (column, axis) in itertools.product(enumerate(LABELS.items()), enumerate(AXES)):
        axes = grid[row][column]
        axes.set_xscale("log")
        efforts = sorted({effort for (_, other), curve in curves.items() if other == axis for effort in curve.efforts})
        axes.set_xticks(efforts, [f"{effort:,}" for effort in efforts])
        axes.minorticks_off()
        axes.set_xlabel(AXES[axis])
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        for (name, other), curve in curves.items():
            values = curve.select(metric)
            if other != axis or values.shape[1] == 0:
                continue
            style, fit, x = styles[name], fit_line(curve.efforts, values), np.array(curve.efforts)
            intervals = [estimate_mean(each).interval() for each in values]
            errors = [[one.mean - one.low for one in intervals], [one.high - one.mean for one in intervals]]
            means = [one.mean for one in intervals]
            axes.errorbar(
                x, means, yerr=errors, fmt=style.marker, color=style.colour, capsize=2, ms=5, label=describe_release(name)
            )
            axes.plot(x, fit.level + fit.slope.mean * np.log2(x / x[-1]), ls=style.line, color=style.colour, lw=1)
            levels = [list_scores(each, metric).mean() for each in curve.baselines.values() if each[metric]]
            if levels:
                axes.axhline(max(levels), color=style.colour, lw=0.6, alpha=0.5)
    handles, labels = grid[0][0].get_legend_handles_labels()
    handles, labels = (handles, labels) if labels else grid[0][1].get_legend_handles_labels()
    texts = [label.replace("`", "") for label in labels]
    figure.legend(handles, texts, fontsize=8, frameon=False, loc="outside lower center", ncols=5)
    return figure


if __name__ == "__main__":
    main()
