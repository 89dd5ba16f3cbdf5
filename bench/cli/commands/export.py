"""`bench export`: write features, releases or recovered descriptors for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final, get_args

from bench.cli.terminal import DONE, FAILED, add_extractor, add_images, add_seed, print_status
from bench.core.errors import UserError

SUMMARY = "write features, releases or recovered descriptors for hloc or COLMAP"
EPILOG = """Without --defense, the features are exported; with --attack, the descriptors that it recovers from the release.
Releases are seeded, as in `bench run`: they are for measurements, not private.

Of photographs, the central square at 256 x 256 pixels is read, as in `bench run`, and keypoints are in pixels of the stored
photograph. With --full-images the stored photograph is read. The images of a dataset are always read whole. Its references are
exported without the defense, as a server holds them, and --model writes their cameras and poses.

examples:
  bench export --images photos/ --layout hloc --out features.h5 --pairs pairs.txt
  bench export --images photos/ --defense ldp:epsilon=12 --layout colmap --out database.db
  bench export --images photos/ --defense affine --attack nearest --layout hloc --out recovered.h5
  bench export --images photos/ --full-images --layout colmap --camera-mode single --out database.db
  bench export --dataset colmap:path=gallery/ --layout hloc --out features.h5 --model model/
"""
REQUIRED = ("layout", "out")
CAMERA_MODE: Final = "per_image"


def add_options(parser: argparse.ArgumentParser) -> None:
    add_images(parser)
    parser.add_argument("--full-images", action="store_true", help="read the whole photographs, not only their central squares")
    parser.add_argument("--dataset", metavar="SPEC", help="a scene in place of --images: its references and its queries")
    parser.add_argument("--layout", metavar="hloc|colmap", help="an HDF5 file for hloc, or a database for COLMAP")
    parser.add_argument("--out", type=Path, metavar="FILE", help="a new file")
    parser.add_argument(
        "--defense", metavar="SPEC", default="none", help="the defense whose release is exported (default: %(default)s)"
    )
    parser.add_argument("--attack", metavar="SPEC", help="the attack whose recovered descriptors are exported")
    parser.add_argument(
        "--camera-mode",
        metavar="MODE",
        help="images that share a camera in COLMAP's database: auto, single, per_folder or per_image, as COLMAP's options "
        f"(default: {CAMERA_MODE})",
    )
    parser.add_argument(
        "--model", type=Path, metavar="DIR", help="with --dataset, also write a binary COLMAP model of the references"
    )
    parser.add_argument("--pairs", type=Path, metavar="FILE", help="also write all pairs of photographs, as a list for hloc")
    add_extractor(parser)
    add_seed(parser)


def execute(args: argparse.Namespace) -> int:
    from bench.core.errors import SampleError
    from bench.core.progress import Progress
    from bench.formats import lists, pairs, scene_export
    from bench.registry import discovery, spec
    from bench.runner import feature_export
    from bench.runner.plan import RunConfiguration, build_plan
    from bench.runner.trial import TrialRunner
    from bench.tasks.reconstruction import Reconstruction

    _check_options(args)
    attack = None if args.attack is None else spec.read(args.attack, discovery.ATTACK)
    configuration = RunConfiguration(
        pairs=((spec.read(args.defense, discovery.DEFENSE), attack),),
        images=args.images,
        task=Reconstruction(),
        extractor=spec.read(args.extractor, discovery.EXTRACTOR),
        dataset=None if args.dataset is None else spec.read(args.dataset, discovery.DATASET),
        seed=args.seed,
    )
    plan = build_plan(configuration)
    index = plan.public.scene_index
    references = () if index is None else index.scene.references
    if args.pairs is not None:
        names = [*(image.name for image in references), *(sample.name for sample in plan.samples)]
        pairs.check_names(name for name in names if lists.is_utf8(name))  # others fail below
    (experiment,) = plan.experiments
    if attack is not None and experiment.reason is not None:
        raise UserError(experiment.reason)
    trials = TrialRunner(plan)
    try:
        images = [] if index is None else list(feature_export.collect_references(index))
    except SampleError as error:
        raise UserError(f"a reference cannot be exported: {error}") from error
    failed = 0
    with Progress(f"exporting for {args.layout}", len(plan.samples)) as progress:
        for sample in plan.samples:
            try:
                opened = feature_export.open_whole(sample) if args.full_images else sample
                images.append(feature_export.collect_features(trials.build_trial(experiment, opened), attack))
            except SampleError as error:
                failed += 1
                progress.log(f"bench: failed: {sample.name}: {error}")
            progress.advance(note=sample.name)
    if not images:
        raise UserError("nothing to write: every photograph failed")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    if args.layout == "colmap":
        mode: feature_export.CameraMode = args.camera_mode or CAMERA_MODE
        feature_export.write_colmap(images, args.out, mode)
    else:
        feature_export.write_hloc(images, args.out)
    print(f"{args.out}: {sum(len(image.keypoints) for image in images)} keypoints of {len(images)} photographs")
    if args.model is not None:
        scene_export.write_binary_model(references, args.model)
        print(f"{args.model}: cameras and poses of {len(references)} references")
    if args.pairs is not None:
        print(f"{args.pairs}: {pairs.write(args.pairs, pairs.pair_all([image.name for image in images]))} pairs")
    return print_status(FAILED, f"{failed} photographs failed") if failed else DONE


def _check_options(args: argparse.Namespace) -> None:
    """Raise UserError for options that are invalid or exclude each other."""
    from bench.runner import feature_export

    layouts, modes = get_args(feature_export.Layout), get_args(feature_export.CameraMode)
    if args.layout not in layouts:
        raise UserError(f"--layout {args.layout}: unknown layout; available: {', '.join(layouts)}")
    if (args.images is None) == (args.dataset is None):
        raise UserError("give --images with a folder of photographs, or --dataset with a scene (see bench export --help)")
    if args.full_images and args.dataset is not None:
        raise UserError("--full-images: the images of a dataset are always read whole; remove it")
    if args.camera_mode is not None and args.layout != "colmap":
        raise UserError(f"--camera-mode: --layout {args.layout} has no cameras; remove it, or give --layout colmap")
    if args.camera_mode not in (None, *modes):
        raise UserError(f"--camera-mode {args.camera_mode}: unknown mode; available: {', '.join(modes)}")
    if args.model is not None and args.dataset is None:
        raise UserError("--model: photographs have no poses; give --dataset")
    if args.out.exists():
        raise UserError(f"--out {args.out}: exists already; give a new file")
    if args.model is not None and args.model.exists():
        raise UserError(f"--model {args.model}: exists already; give a new folder")
    for option, path in (("--pairs", args.pairs), ("--model", args.model)):
        if path is not None and path.absolute() == args.out.absolute():
            raise UserError(f"{option} {path}: the same file as --out; give another")
