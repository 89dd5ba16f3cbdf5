"""Evaluates the attack `generative` beside `dia`, and writes docs/results/generative.md.

    python tools/measure_generative.py --data DATA --weights W.safetensors --defense none --defense ldp:epsilon=10

DATA is the folder of `train/`, `tune.txt` and `test.txt`. The photographs of `test.txt` are reconstructed. The network has to be
trained on photographs of `train/` that neither list names. Results are cached for each photograph, so an interrupted run resumes.

1. Of `--samples` samples of each photograph: their mean score, the best score, and the score of their mean.
2. The spread between the samples, and the fraction of the prior's variance that the release determines.
3. The same for samples of the prior, which do not read the release.
4. The similarity of samples of the prior to the nearest training photograph.

The best of several samples is chosen with the photograph itself, so it is a reference and not an attack.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measure_identity import build_table
from result_page import cache_arrays, format_interval, write_page

from attacks.dia import DIA
from attacks.generative import Generative
from bench.api import Attack, Defense, Metric
from bench.core.progress import Progress
from bench.extractors.sift import Sift
from bench.formats.tensor_file import Arrays
from bench.identification.distractors import DUPLICATE
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

TEXT = """# Samples of the generative attack

{count} photographs of `test.txt`, upright SIFT features, seed 0. `generative` draws {samples} samples of each photograph with
{steps} steps and guidance {guidance:g}. `prior` draws them with guidance 0, which does not read the release.

- *a sample*: the mean score of the samples.
- *best*: the best score among the samples. It is chosen with the photograph, so it is a reference and no attack. The best of the
  prior is its value by chance.
- *mean image*: the score of the mean of the samples.
- *bits*: information about which of 256 photographs it is. All samples of a photograph count as one.

In brackets: 95% intervals over photographs.

## Scores

{scores}

## Diversity

*spread*: standard deviation between the samples, the mean over pixels and channels of range 1. *determined*: fraction of the
variance between samples of the prior that samples of one release lack. The release determines it. *layout determined*: the same
for thumbnails of 16 x 16 pixels.

{diversity}

## Memorisation

Similarity of thumbnails to the nearest of {thumbnails:,} crops of {training:,} training photographs, in all eight symmetries.
Copies of training photographs are nearer than photographs that the network has never seen. The control has random crops of
training photographs, which the check has to find.

{memorisation}
"""
CROPS = (0, 16, 32, 48, 64)  # pixels: offsets of crops of 256 pixels in a view of 320
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
    """Return the greatest similarity of each thumbnail to a training thumbnail, over all symmetries. (n, 16, 16) -> (n,)"""
    known = normalize_thumbnails(training)
    symmetric = [np.rot90(each, turns, (1, 2)) for each in (thumbnails, thumbnails[:, :, ::-1]) for turns in range(4)]
    return np.max([(normalize_thumbnails(each) @ known.T).max(axis=1) for each in symmetric], axis=0)


def list_memorisation(sets: Mapping[str, Doubles], training: Doubles) -> Iterator[list[str]]:
    """Yield a row for each set of thumbnails: their number, quantiles of the similarity, and the number of copies."""
    for label, thumbnails in sets.items():
        nearest = find_nearest(thumbnails.reshape(-1, SIDE, SIDE), training)
        quantiles = (f"{value:.3f}" for value in np.quantile(nearest, (0.5, 0.95, 1.0)))
        yield [label, str(len(nearest)), *quantiles, str(int((nearest >= DUPLICATE).sum()))]


# ---- the page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of train/, tune.txt and test.txt")
    parser.add_argument("--weights", required=True, help="the network of `bench train --model flow`")
    parser.add_argument("--defense", action="append", required=True, help="may be repeated; the network serves the first")
    parser.add_argument("--photographs", type=int, default=100, help="of test.txt (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=8, help="of each photograph (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=Generative.steps, help="of the solver (default: %(default)s)")
    parser.add_argument("--guidance", type=float, default=Generative.guidance, help="(default: %(default)s)")
    args = parser.parse_args()
    if args.samples < 2:
        parser.error("--samples must be at least 2")
    listed = {name: (args.data / f"{name}.txt").read_text().split() for name in ("tune", "test")}
    named = {source.name: source for source in photographs.list_photographs(args.data / "train")}
    tested = [named[name] for name in listed["test"][: args.photographs]]
    training = [source for name, source in named.items() if name not in {*listed["tune"], *listed["test"]}]
    attack = Generative(weights=Asset(args.weights), samples=args.samples, steps=args.steps, guidance=args.guidance)
    defenses = {spec.read(each, discovery.DEFENSE): each for each in args.defense}
    text, configurations = evaluate(defenses, attack, tested, training)
    write_page("generative.md", text, configurations)


def evaluate(
    defenses: Mapping[Defense, str], attack: Generative, tested: Sequence[Source], training: Sequence[Source]
) -> tuple[str, list[Any]]:
    """Return the page without its provenance, and the configurations of the plugins. `defenses` have their labels."""
    task, prior, metrics = Reconstruction(), dataclasses.replace(attack, guidance=0.0), list_metrics()
    attacks: list[Attack] = [attack, DIA()]
    pairs = ((next(iter(defenses)), prior), *cross(task, list(defenses), attacks))
    plan = build_plan(RunConfiguration(pairs=pairs, images=list(tested), task=task, extractor=Sift(), dataset=None, seed=0))
    scores, diversity, first = [], [], None
    with Progress("samples", len(plan.experiments) * len(plan.samples)) as progress:
        for experiment in plan.experiments:
            name = "dia" if isinstance(experiment.attack, DIA) else attack.name()
            label = "prior" if experiment.attack == prior else f"`{name}` on `{defenses[experiment.defense]}`"
            if experiment.reason is not None:
                scores.append([label, experiment.reason, *([""] * len(metrics))])
                continue
            arrays = measure(plan, experiment, metrics, progress)
            scores += list_scores(label, arrays, metrics)
            if experiment.attack == prior:
                first = arrays
            if first is not None and isinstance(experiment.attack, Generative):
                diversity.append(list_diversity(label, arrays, first))
    if first is None:
        reason = next(experiment.reason for experiment in plan.experiments if experiment.attack == prior)
        raise SystemExit(f"generative: {reason}")
    known, rng = collect_thumbnails(training), np.random.default_rng(0)
    drawn = [training[int(rng.integers(len(training)))] for _ in range(first["thumbnails"][:, 0].shape[0])]
    sets = {
        "samples of the prior": first["thumbnails"],
        "other photographs": compute_thumbnails(photographs.read(source).pixels for source in tested)["thumbnails"],
        "control: crops of training photographs": compute_thumbnails(draw_crop(source, rng) for source in drawn)["thumbnails"],
    }
    names = [f"{metric.name()}, bits" if metric.name() == Identified.name() else metric.name() for metric in metrics]
    text = TEXT.format(
        count=len(tested),
        samples=attack.samples,
        steps=attack.steps,
        guidance=attack.guidance,
        scores=build_table(["attack", "estimate", *names], scores),
        diversity=build_table(["attack", "spread", "determined", "layout determined"], diversity),
        training=len(training),
        thumbnails=len(known),
        memorisation=build_table(
            ["thumbnails", "number", "median", "95%", "greatest", f"at least {DUPLICATE}"], list_memorisation(sets, known)
        ),
    )
    return text, [experiment.metadata[part] for experiment in plan.experiments for part in ("defense", "attack")]


if __name__ == "__main__":
    main()
