"""`bench train`: train an attacker's inversion network for the releases of a defense."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from bench.cli.terminal import DONE, add_extractor, add_images, add_seed, parse_whole, parse_wholes

SUMMARY = "train, or resume, an attacker's inversion network for the releases of a defense"
REQUIRED = ("defense", "images", "out")


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--defense",
        action="append",
        metavar="SPEC",
        help="the defense; fields not given are trained over their supported range. May be repeated: one network for all of them",
    )
    add_images(parser)
    parser.add_argument("--out", type=Path, metavar="FILE", help="the network's weights, a safetensors file")
    parser.add_argument(
        "--validation",
        type=Path,
        metavar="DIR|LIST",
        help="other photographs as for --images, or a text file with names of photographs in --images (default: every 20th)",
    )
    parser.add_argument(
        "--crossfit",
        action="append",
        default=[],
        metavar="FILE",
        help="a dictionary for training photographs that are part of the defense's own dictionary; may be repeated",
    )
    parser.add_argument(
        "--encoding",
        choices=("invariant", "released", "positions"),
        default="invariant",
        help="network input: release without random order or basis, unchanged release, or positions (default: %(default)s)",
    )
    parser.add_argument(
        "--model",
        choices=("inversion", "flow"),
        default="inversion",
        help="a network that reconstructs the photograph, or one that samples photographs for the attack generative "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--drafts",
        metavar="FILE",
        help="with --model flow: the network also reads the reconstructions of this network, trained for the same releases; "
        "shipped: of those that dia uses (default: none)",
    )
    parser.add_argument(
        "--profile",
        choices=("cpu", "paper"),
        default="cpu",
        help="network size and schedule, unless other options set them; paper takes days on a GPU (default: %(default)s)",
    )
    parser.add_argument(
        "--devices", type=parse_whole, default=1, metavar="N", help="GPUs or CPU processes that divide each batch"
    )
    parser.add_argument("--widths", type=parse_wholes, metavar="N,N,...", help="channels of the network's levels")
    parser.add_argument(
        "--initial-checkpoint",
        type=Path,
        metavar="FILE",
        help="initial weights: those of a network for the same kind of releases, or for raw descriptors, also of other features",
    )
    parser.add_argument(
        "--keypoints",
        type=parse_wholes,
        metavar="LOW,HIGH",
        help="train for every max_keypoints of the extractor within these limits (default: its own alone)",
    )
    parser.add_argument("--rate", type=float, metavar="R", help="peak learning rate")
    parser.add_argument("--steps", type=parse_whole, metavar="N", help="training steps")
    parser.add_argument("--batch", type=parse_whole, metavar="N", help="training samples per step")
    parser.add_argument("--log", type=Path, metavar="DIR", help="write loss, rate and speed for TensorBoard")
    add_seed(parser, "the training")
    add_extractor(parser)


def execute(args: argparse.Namespace) -> int:
    from bench.context.drafts import Drafter
    from bench.images.photographs import list_photographs, split_validation
    from bench.inversion import network_cache
    from bench.inversion.data import Target
    from bench.inversion.plan import PROFILES, Plan
    from bench.inversion.train import train
    from bench.registry import discovery, spec
    from bench.settings import Asset

    targets = []
    for text in args.defense:
        defense = spec.read(text, discovery.DEFENSE)
        given = {name for part in spec.split_parts(text) for name in spec.parse(part, discovery.DEFENSE)[1]}
        supported = {name: settings for name, settings in defense.supported_settings.items() if name not in given}
        targets.append(Target(defense=defense, supported_settings=supported))
    photographs, validation = split_validation(list_photographs(args.images), args.validation)
    profile = PROFILES[args.profile]
    overrides = {name: value for name in ("steps", "batch", "rate", "seed") if (value := getattr(args, name)) is not None}
    extractor = spec.read(args.extractor, discovery.EXTRACTOR)
    plan = Plan(
        targets=targets,
        photographs=photographs,
        validation=validation,
        extractor=extractor,
        crossfit=[Asset(file) for file in args.crossfit],
        initial_checkpoint=args.initial_checkpoint,
        encoding=args.encoding,
        model=args.model,
        drafts=None if args.drafts is None else Drafter(Asset(args.drafts), extractor),
        widths=args.widths or profile.widths,
        training=dataclasses.replace(profile.training, **overrides),
        keypoints=args.keypoints,
    )
    key = network_cache.build_key(plan)
    meta = network_cache.fetch(key, args.out)
    if meta is None:
        meta = train(plan, args.out, args.log, args.devices)
        network_cache.save(key, args.out)
    scores = ", ".join(f"{name} {value:.4g}" for name, value in meta["validation"].items())
    print(f"{args.out}: {meta['crops']} training samples from {meta['photographs']} photographs; validation: {scores}")
    return DONE
