"""`bench export`: features, releases and recovered descriptors for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_extractor, add_seed, say
from bench.core.errors import UserError

SUMMARY = "write features, what a defense releases, or what an attack recovers, for hloc or COLMAP"
EPILOG = """Without --defense the features themselves are written; with --attack what it recovers of the release. Releases are
seeded, as those of `bench run`: for measuring, and not private.

examples:
  bench export --images photos/ --layout hloc --out features.h5 --pairs pairs.txt
  bench export --images photos/ --defense ldp:epsilon=12 --layout colmap --out database.db
  bench export --images photos/ --defense affine --attack nearest --layout hloc --out recovered.h5
"""
REQUIRED = ("images", "layout", "out")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs")
    parser.add_argument("--layout", metavar="hloc|colmap", help="an HDF5 file of hloc's, or a database of COLMAP's")
    parser.add_argument("--out", type=Path, metavar="FILE", help="a new file")
    parser.add_argument("--defense", metavar="SPEC", default="none", help="whose release is written (default: %(default)s)")
    parser.add_argument("--attack", metavar="SPEC", help="whose recovered descriptors are written")
    parser.add_argument("--pairs", type=Path, metavar="FILE", help="also writes every pair of the photographs, as hloc's lists")
    add_extractor(parser)
    add_seed(parser)


def execute(args: argparse.Namespace) -> int:
    from bench.core.errors import SampleError
    from bench.core.progress import Progress
    from bench.registry import discovery, spec
    from bench.runner import feature_export
    from bench.runner import plan as runner
    from bench.runner.trial import Trials
    from bench.tasks.reconstruction import Reconstruction

    if args.layout not in feature_export.LAYOUTS:
        raise UserError(f"--layout {args.layout}: there is {' and '.join(feature_export.LAYOUTS)}")
    if args.out.exists():
        raise UserError(f"--out {args.out}: exists already; name a new file")
    attack = None if args.attack is None else spec.read(args.attack, discovery.ATTACK)
    asked = runner.RunConfiguration(
        pairs=((spec.read(args.defense, discovery.DEFENSE), attack),),
        images=args.images,
        task=Reconstruction(),
        extractor=spec.read(args.extractor, discovery.EXTRACTOR),
        dataset=None,
        seed=args.seed,
    )
    plan = runner.planned(asked)
    (cell,) = plan.experiments
    if attack is not None and cell.reason is not None:
        raise UserError(cell.reason)
    trials = Trials(plan)
    found, failed = [], 0
    with Progress(f"exporting for {args.layout}", len(plan.samples)) as progress:
        for unit in plan.samples:
            try:
                path = args.images / unit.name
                found.append(feature_export.described(trials.trial(cell, unit), path, attack))
            except SampleError as error:
                failed += 1
                progress.say(f"bench: failed: {unit.name}: {error}")
            progress.advance(note=unit.name)
    if not found:
        raise UserError("nothing to write: every photograph failed")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    feature_export.LAYOUTS[args.layout](found, args.out)
    print(f"{args.out}: {sum(len(one.keypoints) for one in found)} keypoints of {len(found)} photographs")
    if args.pairs is not None:
        print(f"{args.pairs}: {feature_export.write_pairs(args.pairs, [one.name for one in found])} pairs")
    return say(FAILED, f"{failed} photographs failed") if failed else DONE
