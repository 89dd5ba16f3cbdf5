"""The command line. Heavy libraries are imported by the command that needs them, so that `bench --help` is quick."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from bench.errors import UserError, unknown

if TYPE_CHECKING:
    from bench.plugin import Task
    from bench.records import Record
    from bench.runner import Plan

DONE, FAILED, MISTAKE, INTERRUPTED = 0, 1, 2, 130
BROKEN_PIPE = 141  # as a shell reports a program that SIGPIPE ended
GO_ON = "what was written is kept; run the same command again to go on"
PIPED_WIDTH = 400  # columns of a table that goes to a file: its cells are not folded, so that they can be searched

COMMANDS = ("run", "list", "reproduce", "dictionary", "train", "dataset", "audit", "budget")

EXAMPLES = """examples:
  bench run --defense ldp --attack dia
  bench run --defense ldp:epsilon=12,subset_size=4 --defense affine:dim=4 --attack nearest --attack dia --images DIR --out runs/x
  bench list
  bench dictionary build --images DIR --size 256000 --out K.safetensors
  bench train --defense ldp --images DIR --out W.safetensors
  bench dataset gallery --layout colmap --out DIR
  bench reproduce table1
  bench audit --defense ldp:epsilon=2,subset_size=2 --words 64 --trials 1000000
  bench budget --image-epsilon 10

exit status: 0 done, 1 some photograph failed (all else is done and written) or an audit found a violation,
2 a mistake in what was asked (nothing is written)
"""
RUN_EXAMPLES = """A plugin is written name:field=value,field=value; `bench list` shows names and fields.
Repeated options make a grid.

examples:
  bench run --defense ldp --attack dia
  bench run --defense none --defense ldp:epsilon=inf --attack dia --extractor sift:upright=false --images DIR --json
"""
REPRODUCE_EXAMPLES = """Tables come with intervals over the photographs, and with a verdict on each claim of the paper.

examples:
  bench reproduce table1
  bench reproduce table4 --images DIR --out runs/test
  bench reproduce figures --profile smoke
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    try:
        status = _command(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except UserError as error:
        return _say(MISTAKE, " ".join(str(error).split()))
    except KeyboardInterrupt:
        return _say(INTERRUPTED, f"interrupted; {GO_ON}")
    except MemoryError:
        return _say(FAILED, f"out of memory; {GO_ON}, perhaps with fewer defenses at once")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that Python's last flush does not fail again
        return BROKEN_PIPE
    except OSError as error:
        return _say(FAILED, f"{error.filename or 'writing'}: {error.strerror or error}; {GO_ON}")
    return status


class _Parser(argparse.ArgumentParser):
    """Reports mistakes as `UserError`s."""

    def error(self, message: str) -> NoReturn:
        raise UserError(message)


def _command(argv: list[str]) -> int:
    _check_commands(argv)
    args, extra = _parser().parse_known_args(argv)
    if "command" not in args:
        raise UserError(f"say what to do: {', '.join(COMMANDS)} (bench --help explains)")
    if extra:
        option = extra[0].partition("=")[0]
        if option.startswith("-"):
            raise unknown("option", option, set(re.findall(r"--[a-z][a-z-]*", args.options)))
        raise UserError(f"{extra[0]!r} is one argument too many")
    for option in args.required:
        if getattr(args, option) in (None, ""):
            raise UserError(f"--{option.replace('_', '-')} is missing (bench {' '.join(argv[:1])} --help explains)")
    return int(args.command(args))


def _check_commands(argv: list[str]) -> None:
    """Refuse misspelt commands, before argparse does so without a hint."""
    if argv and not argv[0].startswith("-") and argv[0] not in COMMANDS:
        raise unknown("command", argv[0], COMMANDS)
    if argv[:1] == ["dictionary"] and len(argv) > 1 and not argv[1].startswith("-") and argv[1] != "build":
        raise unknown("command", " ".join(argv[:2]), ["dictionary build"])


def _parser() -> argparse.ArgumentParser:
    text = argparse.RawDescriptionHelpFormatter
    parser = _Parser(
        prog="bench",
        description="The privacy benchmark for local image features: what an attacker still sees of a photograph.",
        epilog=EXAMPLES,
        formatter_class=text,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"feature-privacy-bench {version('feature-privacy-bench')}")
    commands = parser.add_subparsers(metavar="COMMAND", parser_class=_Parser)

    def add(to: argparse._SubParsersAction, name: str, summary: str, epilog: str = "") -> argparse.ArgumentParser:
        added = to.add_parser(name, help=summary, description=summary, epilog=epilog, formatter_class=text, allow_abbrev=False)
        assert isinstance(added, argparse.ArgumentParser)
        return added

    run = add(commands, "run", "run defenses against attacks on photographs, and report what was recovered", RUN_EXAMPLES)
    run.add_argument("--defense", action="append", metavar="SPEC", help="what protects the features; may be repeated")
    run.add_argument("--attack", action="append", metavar="SPEC", help="who tries to undo it; may be repeated")
    run.add_argument(
        "--task", metavar="SPEC", default="reconstruction", help="what a release is judged by (default: %(default)s)"
    )
    run.add_argument("--extractor", metavar="SPEC", default="sift", help="what makes the features (default: %(default)s)")
    run.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs (default: seven built-in ones)")
    run.add_argument("--seed", type=_whole, default=0, metavar="N", help="of everything random (default: %(default)s)")
    run.add_argument("--out", type=Path, metavar="DIR", help="folder for the results; resumed if it exists (default: in runs/)")
    run.add_argument("--json", action="store_true", help="print the records instead of the table")
    run.set_defaults(command=_run, required=("defense",), options=run.format_help())

    show = add(commands, "list", "list plugins with their fields, and which attack applies to which defense")
    show.add_argument("what", nargs="?", metavar="defenses|attacks|metrics|tasks|extractors")
    show.set_defaults(command=_list, required=(), options=show.format_help())

    dictionary = add(commands, "dictionary", "make dictionaries of descriptors")
    dictionary.set_defaults(required=(), options=dictionary.format_help(), command=_no_dictionary_command)
    build = add(
        dictionary.add_subparsers(metavar="COMMAND", parser_class=_Parser), "build", "cluster the descriptors of a folder"
    )
    build.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs")
    build.add_argument("--size", type=_whole, metavar="K", help="the number of words")
    build.add_argument("--out", type=Path, metavar="FILE", help="the dictionary, a safetensors file")
    build.add_argument("--seed", type=_whole, default=0, metavar="N", help="of the clustering (default: %(default)s)")
    build.add_argument("--extractor", metavar="SPEC", default="sift", help="what makes the features (default: %(default)s)")
    build.set_defaults(command=_build_dictionary, required=("images", "size", "out"), options=build.format_help())

    train = add(commands, "train", "train, or resume, the attacker's inversion network for a defense's releases")
    train.add_argument("--defense", metavar="SPEC", help="fields given are fixed; of the others the network serves all settings")
    train.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs")
    train.add_argument("--out", type=Path, metavar="FILE", help="the network's weights, a safetensors file")
    train.add_argument(
        "--validation",
        type=Path,
        metavar="DIR|LIST",
        help="a folder, or a file of names in --images to hold out (default: every 20th)",
    )
    train.add_argument(
        "--crossfit",
        action="append",
        default=[],
        metavar="FILE",
        help="a dictionary that quantises photographs which the defense's own was made from; may be repeated",
    )
    train.add_argument(
        "--encoding",
        choices=("invariant", "released", "positions"),
        default="invariant",
        help="what the network is told: the release without random order or basis, as it is, or positions alone",
    )
    train.add_argument("--widths", type=_wholes, metavar="N,N,...", help="channels of the network's levels")
    train.add_argument("--start", type=Path, metavar="FILE", help="weights of a network for raw descriptors to start from")
    train.add_argument("--rate", type=float, metavar="R", help="the learning rate at its peak")
    train.add_argument("--steps", type=_whole, metavar="N", help="steps of training")
    train.add_argument("--batch", type=_whole, metavar="N", help="photographs a step")
    train.add_argument("--seed", type=_whole, default=0, metavar="N", help="of the training (default: %(default)s)")
    train.add_argument("--extractor", metavar="SPEC", default="sift", help="what makes the features (default: %(default)s)")
    train.set_defaults(command=_train, required=("defense", "images", "out"), options=train.format_help())

    dataset = add(commands, "dataset", "write a dataset, such as the gallery, into a folder that other programs can read")
    dataset.add_argument("dataset", nargs="?", metavar="SPEC", help="name:field=value,... (bench list datasets)")
    dataset.add_argument("--layout", metavar="aachen|colmap", help="how the folder is laid out")
    dataset.add_argument("--out", type=Path, metavar="DIR", help="a new folder")
    dataset.add_argument("--views", type=_whole, metavar="N", help="reference images; short for the field of that name")
    dataset.add_argument("--queries", type=_whole, metavar="N", help="queries; likewise")
    dataset.add_argument("--seed", type=_whole, metavar="N", help="of everything random; likewise")
    dataset.set_defaults(command=_dataset, required=("dataset", "layout", "out"), options=dataset.format_help())
    reproduce = add(commands, "reproduce", "rebuild a table of the paper, or its figures, beside the paper's", REPRODUCE_EXAMPLES)
    reproduce.add_argument("what", nargs="?", metavar="NAME", help="table1, table4, tableS3, tableS4, figures, ...")
    reproduce.add_argument(
        "--profile", metavar="NAME", default="cpu", help="smoke, cpu or paper: the sizes (default: %(default)s)"
    )
    reproduce.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs (default: the built-in ones)")
    reproduce.add_argument("--extractor", metavar="SPEC", default="sift", help="what makes the features (default: %(default)s)")
    reproduce.add_argument("--seed", type=_whole, default=0, metavar="N", help="of everything random (default: %(default)s)")
    reproduce.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results; resumed if it exists (default: in runs/)"
    )
    reproduce.add_argument("--dictionary", metavar="FILE", help="K of LDP-Feat (default: the shipped one)")
    reproduce.add_argument("--database", metavar="FILE", help="W of affine lifting (default: the shipped one)")
    reproduce.add_argument("--public-database", metavar="FILE", help="Z, the attacker's own (default: the shipped one)")
    for network, defense in (("raw", "none"), ("affine", "affine"), ("ldp", "ldp")):
        reproduce.add_argument(
            f"--{network}-network", metavar="FILE", help=f"weights trained for `{defense}` (default: shipped ones)"
        )
    reproduce.set_defaults(command=_reproduce, required=("what",), options=reproduce.format_help())

    audit = add(commands, "audit", "bound a defense's epsilon from below by what it releases; exit status 1 if it is violated")
    audit.add_argument("--defense", metavar="SPEC", help="one that claims an epsilon")
    audit.add_argument("--words", type=_whole, metavar="K", help="of a made-up dictionary to report from (default: its own)")
    audit.add_argument(
        "--trials", type=_whole, default=100_000, metavar="N", help="releases of each of two descriptors (default: %(default)s)"
    )
    audit.add_argument("--seed", type=_whole, default=0, metavar="N", help="of everything random (default: %(default)s)")
    audit.set_defaults(command=_audit, required=("defense",), options=audit.format_help())

    budget = add(commands, "budget", "say what an epsilon for a whole photograph leaves for each descriptor, and what that buys")
    budget.add_argument("--image-epsilon", type=_number, metavar="E", help="of a photograph, in all")
    budget.add_argument("--keypoints", type=_whole, default=1000, metavar="N", help="of a photograph (default: %(default)s)")
    budget.add_argument("--releases", type=_whole, default=1, metavar="T", help="of the photograph (default: %(default)s)")
    budget.add_argument("--words", type=_whole, metavar="K", help="of the dictionary (default: those of the shipped one)")
    budget.add_argument(
        "--results", type=Path, metavar="DIR", help="of bench run: shows what was measured at the nearest epsilon"
    )
    budget.set_defaults(command=_budget, required=("image_epsilon",), options=budget.format_help())
    return parser


def _run(args: argparse.Namespace) -> int:
    from bench import registry, runner, spec
    from bench.progress import Progress
    from leaderboard import report

    task = spec.read(args.task, registry.TASK)
    _check_attacks(task, args.attack)
    plan = runner.prepare(
        [spec.read(text, registry.DEFENSE) for text in args.defense],
        [spec.read(text, registry.ATTACK) for text in args.attack or []],
        args.images,
        extractor=spec.read(args.extractor, registry.EXTRACTOR),
        task=task,
        seed=args.seed,
    )
    out = args.out or Path("runs") / _run_name(plan)
    records: list[Record] = []
    noted: set[str] = set()
    with Progress(f"{len(plan.sources)} photographs, {len(plan.cells)} pairs", len(plan)) as progress:
        for record in runner.execute(plan, out):
            records.append(record)
            progress.advance(note=record["unit"])
            for note in record["notes"]:
                if note not in noted:
                    progress.say(f"bench: {note}")
            noted.update(record["notes"])
            if record["status"] == "failed":
                progress.say(f"bench: failed: {record['unit']}, {record['defense']['name']}: {record['reason']}")
    report.write(records, plan.sources, out)
    _print_records(records) if args.json else _print_tables(records)
    _say(DONE, f"written to {out}")
    return FAILED if any(record["status"] == "failed" for record in records) else DONE


def _list(args: argparse.Namespace) -> int:
    from bench.listing import SECTIONS, listing

    if args.what is not None and args.what not in SECTIONS:
        raise unknown("list", args.what, SECTIONS)
    _print_rich(*listing(args.what))
    return DONE


def _no_dictionary_command(args: argparse.Namespace) -> int:
    raise UserError("say what to do with a dictionary: bench dictionary build")


def _build_dictionary(args: argparse.Namespace) -> int:
    from bench import registry, spec
    from bench.features.build import build

    built = build(args.images, args.size, args.out, spec.read(args.extractor, registry.EXTRACTOR), args.seed)
    print(f"{args.out}: {len(built)} words from {built.meta['descriptors']} descriptors of {len(built.photographs)} photographs,")
    print(f"mean cosine {built.meta['mean_cosine']:.4f}, {built.digest}")
    return DONE


def _train(args: argparse.Namespace) -> int:
    from attacks.inversion.network import Shape
    from attacks.inversion.train import Training, train
    from bench import registry, spec
    from bench.datasets.photographs import folder, held_out
    from bench.plugin import Asset

    plugin, given = spec.parse(args.defense, registry.DEFENSE)
    photographs, validation = held_out(folder(args.images), args.validation)
    chosen = {name: value for name in ("steps", "batch", "rate", "seed") if (value := getattr(args, name)) is not None}
    meta = train(
        spec.build(plugin, given),
        {name: settings for name, settings in plugin.serves.items() if name not in given},
        photographs=photographs,
        validation=validation,
        out=args.out,
        extractor=spec.read(args.extractor, registry.EXTRACTOR),
        crossfit=[Asset(file) for file in args.crossfit],
        start=args.start,
        encoding=args.encoding,
        widths=args.widths or Shape.widths,
        training=Training(**chosen),
    )
    scores = ", ".join(f"{name} {value:.4g}" for name, value in meta["validation"].items())
    print(f"{args.out}: {meta['crops']} crops of {meta['photographs']} photographs; validation: {scores}")
    return DONE


def _dataset(args: argparse.Namespace) -> int:
    from bench import registry, spec
    from bench.datasets import export

    plugin, given = spec.parse(args.dataset, registry.DATASET)
    for name in ("views", "queries", "seed"):
        value = getattr(args, name)
        if value is not None:
            given |= spec.parse(f"{plugin.name()}:{name}={value}", registry.DATASET)[1]
    scene = spec.build(plugin, given).scene()
    export.write(scene, args.layout, args.out)
    print(f"{args.out}: {len(scene.references)} references and {len(scene.queries)} queries of {scene.name}, as {args.layout}")
    return DONE


def _reproduce(args: argparse.Namespace) -> int:
    from bench import registry, spec
    from leaderboard import reproduce

    materials = {name: getattr(args, name) for name in reproduce.materials() if getattr(args, name)}
    done = reproduce.reproduce(
        args.what,
        args.profile,
        images=args.images,
        extractor=spec.read(args.extractor, registry.EXTRACTOR),
        seed=args.seed,
        out=args.out,
        materials=materials,
    )
    _print_rich(*done.shown)
    _say(DONE, f"written to {done.out}")
    return FAILED if done.failed else DONE


def _audit(args: argparse.Namespace) -> int:
    import tempfile

    from bench import registry, spec
    from bench.audit import report
    from bench.audit.auditor import audit

    with tempfile.TemporaryDirectory() as folder:
        found = audit(spec.read(args.defense, registry.DEFENSE), args.words, args.trials, args.seed, Path(folder))
    _print_rich(*report.report(found, args.defense))
    return FAILED if found.verdict == "violated" else DONE


def _budget(args: argparse.Namespace) -> int:
    from bench import budget, records
    from bench.public import Public
    from leaderboard import tables

    words = len(Public().dictionary("shipped")) if args.words is None else args.words
    plan = budget.budget(args.image_epsilon, args.keypoints, args.releases, words)
    _print_rich(*budget.report(plan))
    if args.results is not None:
        measured = budget.nearest(records.read(records.find(args.results)).records, plan.epsilon)
        print(f"The nearest that was measured: ε = {float(measured[0]['privacy']['epsilon_descriptor']):g} for a descriptor")
        _print_rich(*(tables.to_rich(table) for table in tables.tables(measured)))
    return DONE


def _check_attacks(task: Task, attacks: list[str] | None) -> None:
    if task.attacked and not attacks:
        raise UserError(f"--attack is missing: the task {task.name()} judges what an attack recovers (bench list attacks)")
    if attacks and not task.attacked:
        raise UserError(f"--attack: the task {task.name()} judges the release itself and takes none")


def _run_name(plan: Plan) -> str:
    """The defenses' and attacks' names, and eight digits that tell configurations apart."""
    defenses = dict.fromkeys(cell.defense.name() for cell in plan.cells)
    attacks = dict.fromkeys(cell.attack.name() if cell.attack else plan.task.name() for cell in plan.cells)
    return f"{'+'.join(defenses)[:60]}-{'+'.join(attacks)[:60]}-{plan.hash[:8]}"


def _print_records(records: list[Record]) -> None:
    for record in records:
        print(json.dumps(record, allow_nan=False))


def _print_tables(records: list[Record]) -> None:
    from leaderboard import tables

    _print_rich(*(tables.to_rich(table, foldable=sys.stdout.isatty()) for table in tables.tables(records)))


def _print_rich(*items: object) -> None:
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
    # Rich itself would answer a closed pipe with exit status 1, which is taken.
    with console.capture() as captured:
        for item in items:
            console.print(item)
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(captured.get().encode(encoding, "backslashreplace").decode(encoding))


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, not {text!r}") from None


def _number(text: str) -> float:
    from bench.exact import Exact

    try:
        return Exact(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number or a fraction, not {text!r}") from None


def _wholes(text: str) -> tuple[int, ...]:
    return tuple(_whole(part) for part in text.split(","))


def _say(status: int, line: str) -> int:
    print(f"bench: {line}", file=sys.stderr, flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main())
