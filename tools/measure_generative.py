"""Evaluates the attack `generative` beside `dia`, and writes docs/results/generative.md.

    python tools/measure_generative.py --data DATA --training TRAINING --defense none --defense ldp:epsilon=10

DATA is the folder of `train/`, `tune.txt` and `test.txt`. The photographs of one of the lists are reconstructed. Choose settings
with `--list tune`. TRAINING is the folder of the network's training photographs. Results are cached for each photograph, so an
interrupted run resumes.

1. Of `--samples` samples of each photograph: their mean score, the best score, and the score of their mean.
2. The differences of these scores between the mean image and a sample, and between a sample and `dia`.
3. The spread between the samples, and the fraction of the prior's variance that the release determines.
4. The same for samples of the prior, which do not read the release.
5. The similarity of samples of the prior to the nearest training photograph.
6. A picture of samples of built-in photographs.

The best of several samples is chosen with the photograph itself, so it is a reference and not an attack.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from measure_identity import build_table
from result_page import cache_arrays, format_interval, save_figure, write_page

from attacks.dia import DIA
from attacks.generative import Generative
from bench.api import Defense, Metric
from bench.core.progress import Progress
from bench.extractors.sift import Sift
from bench.formats.tensor_file import Arrays
from bench.identification.thumbnails import SIDE, Doubles, compute_thumbnail, normalize_thumbnails
from bench.images import photographs
from bench.images.photographs import Source, crop_square, decode
from bench.registry import discovery, spec
from bench.runner.plan import Experiment, Plan, RunConfiguration, build_plan, cross, list_extra_metrics
from bench.runner.trial import TrialRunner
from bench.settings import Asset
from bench.tasks.reconstruction import Reconstruction, build_view
from bench.types import Bytes, Floats
from leaderboard.identification import measure_bits
from leaderboard.intervals import interval
from metrics.identified import Identified
from metrics.psnr import PSNR
from metrics.ssim import SSIM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEXT = """# Samples of the generative attack

{count} photographs of `{list}.txt`, upright SIFT features, seed 0. `generative` draws {samples} samples of each photograph with
{steps} steps and guidance {guidance:g}. `prior` draws them with guidance 0, which reads neither the release nor its draft.

- *a sample*: the mean score of the samples.
- *best*: the best score among the samples. It is chosen with the photograph, so it is a reference and no attack. The best of the
  prior is its value by chance.
- *mean image*: the score of the mean of the samples.
- *bits*: information about which of 256 photographs it is. All samples of a photograph count as one.

In brackets: 95% intervals over photographs.

## Scores

{scores}

## Differences

Means of differences, paired by photograph. Positive: the first has the higher number, which is not always the better one.

{differences}

## Diversity

*spread*: standard deviation between the samples, the mean over pixels and channels of range 1. *determined*: fraction of the
variance between samples of the prior that samples of one release lack. The release determines it. *layout determined*: the same
for thumbnails of 16 x 16 pixels.

{diversity}

## Memorisation

Similarity of thumbnails to the nearest of {thumbnails:,} crops of the {training:,} training photographs, in all eight symmetries.
The control has random crops of training photographs, and 95% of them are at least as similar as {threshold:.3f}. The other
photographs, which the network has never seen, show how often that happens without copying.

{memorisation}

## Pictures

From left to right: the photograph, `dia`, two samples, the mean of {samples} samples, and two samples of the prior. Each row has
another defense: {labels}.

![Samples of built-in photographs](../images/generative.png)
"""
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "generative.png"
PICTURED = 2  # built-in photographs
CROPS = range(0, 65, 8)  # pixels: offsets of crops of 256 pixels in a view of 320
CONTROL = "control: crops of training photographs"
FOUND = 0.95  # fraction of the control that the check for copies finds
VIEW = photographs.SIDE + CROPS[-1]


def list_metrics() -> list[Metric]:
    """Return metrics of images, also those of installed extras."""
    return [Identified(), SSIM(), PSNR(), *(metric for metric in list_extra_metrics() if metric.compares == "images")]


# ---- scores of samples


def measure_photograph(plan: Plan, experiment: Experiment, number: int, metrics: Sequence[Metric]) -> Arrays:
    """Return the scores and moments of the images that an attack reconstructs from the release of one photograph.

    For each metric the scores of the samples (k,) and of their mean (1,), NaN where it has none. Also the spread between samples
    (1,), the mean variance (1,) of pixels and of thumbnails, and the thumbnails (k, 16, 16).
    """
    sample = plan.samples[number]
    trial = TrialRunner(plan).build_trial(experiment, sample)
    truth = (trial.pixels() / 255).astype(np.float32)
    attack, view = experiment.attack, build_view(trial)
    if isinstance(attack, Generative):
        images = attack.sample(view, trial.rng)  # (k, H, W, 3)
    else:
        assert isinstance(attack, DIA)
        images = attack.reconstruct(view, trial.rng)[None]
    mean = images.mean(axis=0, dtype=np.float32)
    thumbnails = np.stack([compute_thumbnail(image) for image in images])
    arrays = {"thumbnails": thumbnails}
    for metric in metrics:
        arrays[metric.name()] = score(metric, truth, images)
        arrays[f"{metric.name()} of mean"] = score(metric, truth, mean[None])
    if len(images) > 1:
        arrays["spread"] = images.std(axis=0, ddof=1).mean(keepdims=True).ravel()
        arrays["variance"] = images.var(axis=0, ddof=1).mean(keepdims=True).ravel()
        arrays["layout"] = thumbnails.var(axis=0, ddof=1).mean(keepdims=True).ravel()
    return arrays


def score(metric: Metric, truth: Floats, images: Floats) -> Doubles:
    """Return the value for each image, NaN if there is none. (H, W, 3), (k, H, W, 3) -> (k,)"""
    values = (metric(truth, image) for image in images)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def measure(plan: Plan, experiment: Experiment, metrics: Sequence[Metric], progress: Progress) -> Arrays:
    """Return `measure_photograph` of all photographs, stacked. -> (n, ...)"""
    results = []
    for number, sample in enumerate(plan.samples):
        inputs = [
            experiment.metadata["experiment_id"],
            plan.hashes[sample.name],
            [[spec.to_json(metric), dict(metric.parameters)] for metric in metrics],
        ]
        compute = functools.partial(measure_photograph, plan, experiment, number, metrics)
        results.append(cache_arrays("measure_generative", inputs, compute))
        progress.advance(note=str(experiment.attack and experiment.attack.name()))
    return {name: np.stack([result[name] for result in results]) for name in results[0]}


def select_best(metric: Metric, values: Doubles) -> Doubles:
    """Return the best score for the attacker among the samples. (n, k) -> (n,)"""
    return values.max(axis=1) if metric.higher_is_better_for == "attacker" else values.min(axis=1)


def summarize(metric: Metric, values: Doubles) -> str:
    """Format the mean over photographs of (n, k) scores, or the bits of identification."""
    if metric.name() == Identified.name():
        return format_interval(measure_bits(values if values.shape[1] > 1 else values[:, 0]), 2)
    present = values[~np.isnan(values).any(axis=1)].mean(axis=1)
    return format_interval(interval(present), 3) if len(present) else "n/a"


def list_scores(label: str, arrays: Arrays, metrics: Sequence[Metric]) -> Iterator[list[str]]:
    """Yield the rows of one attack: of a sample, of the best, and of the mean image."""
    kinds: dict[str, Callable[[Metric], Doubles]] = {"a sample": lambda metric: arrays[metric.name()]}
    if len(arrays["thumbnails"][0]) > 1:
        kinds |= {
            "best": lambda metric: select_best(metric, arrays[metric.name()])[:, None],
            "mean image": lambda metric: arrays[f"{metric.name()} of mean"],
        }
    for kind, get in kinds.items():
        yield [label, kind if len(kinds) > 1 else "", *(summarize(metric, get(metric)) for metric in metrics)]


def list_differences(label: str, arrays: Arrays, dia: Arrays, metrics: Sequence[Metric]) -> Iterator[list[str]]:
    """Yield the rows of one attack: the mean image minus a sample, and a sample minus `dia`."""
    names = [metric.name() for metric in metrics]
    samples = {name: arrays[name].mean(axis=1) for name in names}  # (n,)
    differences = {
        "mean image - a sample": [arrays[f"{name} of mean"][:, 0] - samples[name] for name in names],
        "a sample - `dia`": [samples[name] - dia[name][:, 0] for name in names],
    }
    for kind, columns in differences.items():
        row = [label, kind]
        for difference in columns:
            present = difference[~np.isnan(difference)]
            row.append(format_interval(interval(present), 3) if len(present) else "n/a")
        yield row


def list_diversity(label: str, arrays: Arrays, prior: Arrays) -> list[str]:
    """Return the row of one attack: spread, and the determined fractions of pixels and of the layout."""
    determined = [1 - arrays[name].mean() / prior[name].mean() for name in ("variance", "layout")]
    return [label, format_interval(interval(arrays["spread"][:, 0]), 3), *(f"{value:.3f}" for value in determined)]


# ---- memorisation


def list_crops(source: Source) -> Iterator[Bytes]:
    """Yield the whole photograph at 256 pixels, and crops of it at 320 pixels, as the training has them."""
    image, _ = decode(source)
    yield crop_square(image, photographs.SIDE)
    view = crop_square(image, VIEW)
    for top in CROPS:
        for left in CROPS:
            yield view[top : top + photographs.SIDE, left : left + photographs.SIDE]


def draw_crop(source: Source, rng: np.random.Generator) -> Bytes:
    """Return a random crop of the photograph at 320 pixels."""
    top, left = rng.integers(CROPS[-1] + 1, size=2)
    return crop_square(decode(source)[0], VIEW)[top : top + photographs.SIDE, left : left + photographs.SIDE]


def compute_thumbnails(images: Iterator[Bytes]) -> Arrays:
    return {"thumbnails": np.stack([compute_thumbnail(image / 255.0) for image in images])}


def collect_thumbnails(sources: Sequence[Source]) -> Doubles:
    """Return the thumbnails of all crops. -> (26 n, 16, 16)"""
    parts = []
    with Progress("thumbnails", len(sources)) as progress:
        for source in sources:
            compute = functools.partial(lambda given: compute_thumbnails(list_crops(given)), source)
            parts.append(cache_arrays("measure_generative", ["crops", source.content_hash()], compute)["thumbnails"])
            progress.advance()
    return np.concatenate(parts)


def find_nearest(thumbnails: Doubles, training: Doubles) -> Doubles:
    """Return the greatest similarity of each thumbnail to a training thumbnail, over all symmetries. (..., 16, 16) -> (n,)"""
    known = normalize_thumbnails(training)
    thumbnails = thumbnails.reshape(-1, SIDE, SIDE)
    symmetric = [np.rot90(each, turns, (1, 2)) for each in (thumbnails, thumbnails[:, :, ::-1]) for turns in range(4)]
    return np.max([(normalize_thumbnails(each) @ known.T).max(axis=1) for each in symmetric], axis=0)


def list_memorisation(sets: Mapping[str, Doubles], threshold: float) -> Iterator[list[str]]:
    """Yield a row for each set of similarities: their number, quantiles, and the fraction that reaches the threshold."""
    for label, nearest in sets.items():
        quantiles = (f"{value:.3f}" for value in np.quantile(nearest, (0.5, 0.95)))
        yield [label, str(len(nearest)), *quantiles, f"{(nearest >= threshold).mean():.3f}"]


# ---- the page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of train/, tune.txt and test.txt")
    parser.add_argument("--training", type=Path, required=True, help="folder of the photographs that the network was trained on")
    parser.add_argument("--weights", default="shipped", help="a network of `bench train --model flow` (default: %(default)s)")
    parser.add_argument("--drafts", default="shipped", help="the network for drafts of its training (default: those of dia)")
    parser.add_argument("--list", choices=("tune", "test"), default="test", help="of photographs (default: %(default)s)")
    parser.add_argument("--defense", action="append", required=True, help="may be repeated; the network serves the first")
    parser.add_argument("--photographs", type=int, default=100, help="of the list (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=8, help="of each photograph (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=Generative.steps, help="of the solver (default: %(default)s)")
    parser.add_argument("--guidance", type=float, default=Generative.guidance, help="(default: %(default)s)")
    args = parser.parse_args()
    if args.samples < 2:
        parser.error("--samples must be at least 2")
    named = {source.name: source for source in photographs.list_photographs(args.data / "train")}
    tested = [named[name] for name in (args.data / f"{args.list}.txt").read_text().split()[: args.photographs]]
    training = photographs.list_photographs(args.training)
    networks = {"weights": Asset(args.weights), "drafts": Asset(args.drafts)}
    attack = Generative(**networks, samples=args.samples, steps=args.steps, guidance=args.guidance)
    defenses = {spec.read(each, discovery.DEFENSE): each for each in args.defense}
    text, configurations = evaluate(defenses, attack, tested, training, args.list)
    save_figure(draw_samples(list(defenses), attack, photographs.list_builtin()[:PICTURED]), PICTURE, configurations)
    write_page("generative.md", text, configurations)


def plan_attacks(defenses: Sequence[Defense], attack: Generative, images: Sequence[Source]) -> Plan:
    """Return the plan of the prior on the first defense, and of the attack and `dia` on each."""
    task, attacks = Reconstruction(), (DIA(), attack)
    pairs = ((defenses[0], dataclasses.replace(attack, guidance=0.0)), *cross(task, defenses, attacks))
    return build_plan(RunConfiguration(pairs=pairs, images=list(images), task=task, extractor=Sift(), dataset=None, seed=0))


def draw_samples(defenses: Sequence[Defense], attack: Generative, sources: Sequence[Source]) -> Figure:
    """Draw, for each defense and photograph: the photograph, `dia`, two samples, their mean, and two samples of the prior."""
    from matplotlib.figure import Figure

    plan = plan_attacks(defenses, attack, sources)
    rows: dict[tuple[Defense, int], list[Floats]] = {}
    for number, sample in enumerate(plan.samples):
        prior: list[Floats] = []
        for experiment in plan.experiments:
            if experiment.reason is not None:
                continue
            trial = TrialRunner(plan).build_trial(experiment, sample)
            row = rows.setdefault((experiment.defense, number), [(trial.pixels() / 255).astype(np.float32)])
            if isinstance(experiment.attack, DIA):
                row.append(experiment.attack.reconstruct(build_view(trial), trial.rng))
                continue
            assert isinstance(experiment.attack, Generative)
            images = experiment.attack.sample(build_view(trial), trial.rng)
            if experiment.attack.guidance == 0:
                prior = list(images[:2])
            else:
                row += [*images[:2], images.mean(axis=0), *prior]
    ordered = [rows[defense, number] for number in range(len(plan.samples)) for defense in defenses if (defense, number) in rows]
    figure = Figure(figsize=(1.1 * max(map(len, ordered)), 1.1 * len(ordered)), layout="constrained")
    for axes, row in zip(figure.subplots(len(ordered), max(map(len, ordered)), squeeze=False), ordered, strict=True):
        for axis in axes:
            axis.axis("off")
        for axis, image in zip(axes, row, strict=False):
            axis.imshow(image.clip(0, 1))
    return figure


def evaluate(
    defenses: Mapping[Defense, str], attack: Generative, tested: Sequence[Source], training: Sequence[Source], name: str
) -> tuple[str, list[Any]]:
    """Return the page without its provenance, and the configurations of the plugins. `defenses` have their labels.

    `name` is that of the list of photographs.
    """
    metrics, plan = list_metrics(), plan_attacks(list(defenses), attack, tested)
    scores, diversity, first, dia = [], [], None, None
    differences: list[list[str]] = []
    with Progress("samples", len(plan.experiments) * len(plan.samples)) as progress:
        for experiment in plan.experiments:
            assert isinstance(experiment.attack, DIA | Generative)
            is_prior = isinstance(experiment.attack, Generative) and experiment.attack.guidance == 0
            label = "prior" if is_prior else f"`{experiment.attack.name()}` on `{defenses[experiment.defense]}`"
            if experiment.reason is not None:
                scores.append([label, experiment.reason, *([""] * len(metrics))])
                continue
            arrays = measure(plan, experiment, metrics, progress)
            scores += list_scores(label, arrays, metrics)
            if isinstance(experiment.attack, DIA):
                dia = arrays
                continue
            first = arrays if is_prior else first
            assert first is not None  # the prior is the first experiment, and the network reads its defense
            diversity.append(list_diversity(label, arrays, first))
            if dia is not None and not is_prior:
                differences += list_differences(label, arrays, dia, metrics)
    if first is None:
        raise SystemExit(f"generative: {plan.experiments[0].reason}")
    known, rng = collect_thumbnails(training), np.random.default_rng(0)
    drawn = [training[int(rng.integers(len(training)))] for _ in tested]
    sets = {
        "samples of the prior": first["thumbnails"],
        "other photographs": compute_thumbnails(photographs.read(source).pixels for source in tested)["thumbnails"],
        CONTROL: compute_thumbnails(draw_crop(source, rng) for source in drawn)["thumbnails"],
    }
    nearest = {label: find_nearest(thumbnails, known) for label, thumbnails in sets.items()}
    threshold = float(np.quantile(nearest[CONTROL], 1 - FOUND))
    names = [f"{metric.name()}, bits" if metric.name() == Identified.name() else metric.name() for metric in metrics]
    text = TEXT.format(
        count=len(tested),
        list=name,
        samples=attack.samples,
        steps=attack.steps,
        guidance=attack.guidance,
        scores=build_table(["attack", "estimate", *names], scores),
        differences=build_table(["attack", "difference", *(metric.name() for metric in metrics)], differences),
        diversity=build_table(["attack", "spread", "determined", "layout determined"], diversity),
        training=len(training),
        thumbnails=len(known),
        threshold=threshold,
        memorisation=build_table(
            ["thumbnails", "number", "median", "95%", f"at least {threshold:.3f}"], list_memorisation(nearest, threshold)
        ),
        labels=", ".join(f"`{label}`" for label in defenses.values()),
    )
    return text, [experiment.metadata[part] for experiment in plan.experiments for part in ("defense", "attack")]


if __name__ == "__main__":
    main()
