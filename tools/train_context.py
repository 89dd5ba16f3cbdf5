"""Trains a small context model, about 20 minutes on one idle core. The shipped one has more training (the model card has both).

The training photographs are the third of `train/` that the shipped dictionary was not built from
(`make_assets.split_photographs`), since photographs of a dictionary quantise to nearly themselves.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from make_assets import split_photographs

from bench.codebook.public import Public
from bench.context.network import Shape
from bench.context.train import Example, Stage, build_sampler, compute_loss, compute_pair_loss, fit, validate
from bench.context.weights import save
from bench.extractors.sift import Sift
from bench.images.photographs import SIDE, list_photographs
from bench.images.views import PhotographView, collect_views
from bench.inversion.data import SupportedSettings, assign_dictionaries, measure_quantisation_error, quantise
from bench.inversion.plan import Training
from bench.inversion.train import check_quantisation
from bench.inversion.weights import describe
from bench.settings import OneOf
from defenses.ldp import LDP

SUPPORTED = {field: LDP.supported_settings[field] for field in ("epsilon", "subset_size")}
VALIDATED = [LDP(epsilon=epsilon, subset_size=size) for epsilon, size in ((8, 2), (10, 1), (10, 2), (10, 4), (12, 2), (16, 2))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pair-steps", type=int, default=4000, help="of the first stage, each of two training samples")
    parser.add_argument("--steps", type=int, default=4000, help="of the second stage, each of two training samples")
    args = parser.parse_args()
    folders = split_photographs(args.data, args.work / "photographs")
    views, unseen = (
        collect_views(list_photographs(folders[name]), Sift())[::2] for name in ("2", "tune")
    )  # without mirrored ones
    train(
        views,
        [view for view in unseen if len(view.pixels) == SIDE],
        args.out,
        Training(steps=args.steps, batch=2),
        args.pair_steps,
    )


def train(views: list[PhotographView], unseen: list[PhotographView], out: Path, training: Training, pair_steps: int) -> None:
    defense, shape, public = LDP(), Shape(), Public()
    all_views = [*views, *unseen]
    dictionaries = assign_dictionaries({view.photograph for view in all_views}, [defense.dictionary], public)
    public = Public(quantise(all_views, dictionaries, [0], public))
    errors = {
        "training": measure_quantisation_error(views, dictionaries, public),
        "validation": measure_quantisation_error(unseen, dictionaries, public),
    }
    check_quantisation(**errors)
    pairs = {"epsilon": OneOf((math.inf,)), "subset_size": OneOf((2,))}

    def build_stage_sampler(supported: SupportedSettings) -> Callable[[np.random.Generator], Example]:
        return build_sampler(views, defense, supported, "subset_size", public, shape.neighbours, training.batch)

    stages = [
        Stage(draw=build_stage_sampler(pairs), loss=compute_pair_loss, steps=pair_steps),
        Stage(draw=build_stage_sampler(SUPPORTED), loss=compute_loss, steps=training.steps),
    ]
    module, secrets = fit(shape, stages, training), [view.features for view in unseen]
    meta = {
        **describe(defense, dict(SUPPORTED), Sift(), Public()),
        "photographs": sorted({view.photograph for view in views}),
        "crops": (pair_steps + training.steps) * training.batch,
        "batch": training.batch,
        "rate": training.rate,
        "seed": training.seed,
        "quantisation_error": errors,
        "validation": [
            {"epsilon": tried.epsilon, "subset_size": tried.subset_size, **validate(module, secrets, tried, public)}
            for tried in VALIDATED
        ],
    }
    save(out, module, meta)
    for row in meta["validation"]:
        print({name: round(value, 4) for name, value in row.items()})


if __name__ == "__main__":
    main()
