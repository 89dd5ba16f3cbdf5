"""`bench train`: the attacker's inversion network for a defense's releases."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from bench.cli.terminal import DONE, add_extractor, add_seed, whole, wholes

SUMMARY = "train, or resume, the attacker's inversion network for a defense's releases"
REQUIRED = ("defense", "images", "out")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--defense", metavar="SPEC", help="fields given are fixed; of the others the network serves all settings")
    parser.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the network's weights, a safetensors file")
    parser.add_argument(
        "--validation",
        type=Path,
        metavar="DIR|LIST",
        help="a folder, or a file of names in --images to hold out (default: every 20th)",
    )
    parser.add_argument(
        "--crossfit",
        action="append",
        default=[],
        metavar="FILE",
        help="a dictionary that quantises photographs which the defense's own was made from; may be repeated",
    )
    parser.add_argument(
        "--encoding",
        choices=("invariant", "released", "positions"),
        default="invariant",
        help="what the network is told: the release without random order or basis, as it is, or positions alone",
    )
    parser.add_argument("--profile", choices=("cpu", "paper"), default="cpu", help="sizes, where no other option gives them")
    parser.add_argument("--devices", type=whole, default=1, metavar="N", help="GPUs, or CPU processes, that share each batch")
    parser.add_argument("--widths", type=wholes, metavar="N,N,...", help="channels of the network's levels")
    parser.add_argument(
        "--start", type=Path, metavar="FILE", help="weights to start from, of a network for such releases or for raw descriptors"
    )
    parser.add_argument("--rate", type=float, metavar="R", help="the learning rate at its peak")
    parser.add_argument("--steps", type=whole, metavar="N", help="steps of training")
    parser.add_argument("--batch", type=whole, metavar="N", help="photographs a step")
    parser.add_argument("--log", type=Path, metavar="DIR", help="writes loss, rate and speed for TensorBoard")
    add_seed(parser, "the training")
    add_extractor(parser)


def execute(args: argparse.Namespace) -> int:
    from bench.api import Asset
    from bench.images.photographs import folder, held_out
    from bench.inversion import network_cache
    from bench.inversion.plan import PROFILES, Plan
    from bench.inversion.train import train
    from bench.registry import discovery, spec

    plugin, given = spec.parse(args.defense, discovery.DEFENSE)
    defense = spec.build(plugin, given)
    served = {name: settings for name, settings in plugin.supported_settings.items() if name not in given}
    photographs, validation = held_out(folder(args.images), args.validation)
    profile = PROFILES[args.profile]
    chosen = {name: value for name in ("steps", "batch", "rate", "seed") if (value := getattr(args, name)) is not None}
    plan = Plan(
        defense=defense,
        served=served,
        photographs=photographs,
        validation=validation,
        extractor=spec.read(args.extractor, discovery.EXTRACTOR),
        crossfit=[Asset(file) for file in args.crossfit],
        start=args.start,
        encoding=args.encoding,
        widths=args.widths or profile.widths,
        training=dataclasses.replace(profile.training, **chosen),
    )
    key = network_cache.key(plan)
    meta = network_cache.fetch(key, args.out)
    if meta is None:
        meta = train(plan, args.out, args.log, args.devices)
        network_cache.keep(key, args.out)
    scores = ", ".join(f"{name} {value:.4g}" for name, value in meta["validation"].items())
    print(f"{args.out}: {meta['crops']} crops of {meta['photographs']} photographs; validation: {scores}")
    return DONE
