"""`bench export`: write features, releases or recovered descriptors for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_extractor, add_seed, print_status
from bench.core.errors import UserError

SUMMARY = "write features, releases or recovered descriptors for hloc or COLMAP"
EPILOG = """Without --defense, the features are exported; with --attack, the descriptors that it recovers from the release.
Releases are seeded, as in `bench run`: they are for measurements, not private.

examples:
  bench export --images photos/ --layout hloc --out features.h5 --pairs pairs.txt
  bench export --images photos/ --defense ldp:epsilon=12 --layout colmap --out database.db
  bench export --images photos/ --defense affine --attack nearest --layout hloc --out recovered.h5
"""
REQUIRED = ("images", "layout", "out")


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs")
    parser.add_argument("--layout", metavar="hloc|colmap", help="an HDF5 file for hloc, or a database for COLMAP")
    parser.add_argument("--out", type=Path, metavar="FILE", help="a new file")
    parser.add_argument(
        "--defense", metavar="SPEC", default="none", help="the defense whose release is exported (default: %(default)s)"
    )
    parser.add_argument("--attack", metavar="SPEC", help="the attack whose recovered descriptors are exported")
    parser.add_argument("--pairs", type=Path, metavar="FILE", help="also write all pairs of photographs, as a list for hloc")
    add_extractor(parser)
    add_seed(parser)


def execute(args: argparse.Namespace) -> int:
    from bench.core.errors import SampleError
    from bench.core.progress import Progress
    from bench.formats import lists, pairs
    from bench.registry import discovery, spec
    from bench.runner import feature_export
    from bench.runner.plan import RunConfiguration, build_plan
    from bench.runner.trial import TrialRunner
    from bench.tasks.reconstruction import Reconstruction

    if args.layout not in feature_export.LAYOUTS:
        raise UserError(f"--layout {args.layout}: unknown layout; available: {', '.join(feature_export.LAYOUTS)}")
    if args.out.exists():
        raise UserError(f"--out {args.out}: exists already; give a new file")
    attack = None if args.attack is None else spec.read(args.attack, discovery.ATTACK)
    configuration = RunConfiguration(
        pairs=((spec.read(args.defense, discovery.DEFENSE), attack),),
        images=args.images,
        task=Reconstruction(),
        extractor=spec.read(args.extractor, discovery.EXTRACTOR),
        dataset=None,
        seed=args.seed,
    )
    plan = build_plan(configuration)
    if args.pairs is not None:
        if args.pairs.absolute() == args.out.absolute():
            raise UserError(f"--pairs {args.pairs}: the same file as --out; give another")
        pairs.check_names(sample.name for sample in plan.samples if lists.is_utf8(sample.name))  # others fail below
    (experiment,) = plan.experiments
    if attack is not None and experiment.reason is not None:
        raise UserError(experiment.reason)
    trials = TrialRunner(plan)
    images, failed = [], 0
    with Progress(f"exporting for {args.layout}", len(plan.samples)) as progress:
        for sample in plan.samples:
            try:
                path = args.images / sample.name
                images.append(feature_export.collect_features(trials.build_trial(experiment, sample), path, attack))
            except SampleError as error:
                failed += 1
                progress.log(f"bench: failed: {sample.name}: {error}")
            progress.advance(note=sample.name)
    if not images:
        raise UserError("nothing to write: every photograph failed")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    feature_export.LAYOUTS[args.layout](images, args.out)
    print(f"{args.out}: {sum(len(image.keypoints) for image in images)} keypoints of {len(images)} photographs")
    if args.pairs is not None:
        print(f"{args.pairs}: {pairs.write(args.pairs, pairs.pair_all([image.name for image in images]))} pairs")
    return print_status(FAILED, f"{failed} photographs failed") if failed else DONE
