"""`bench run`: defenses against attacks, or judged for what a server can do with them."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.terminal import DONE, FAILED, add_engine, add_extractor, add_seed, say
from bench.core.errors import UserError

if TYPE_CHECKING:
    from bench.api import Defense, Metric, Task
    from bench.runner.plan import Plan
    from bench.runner.records import Record

SUMMARY = "run defenses against attacks on photographs, and report what was recovered"
EPILOG = """A plugin is written name:field=value,field=value; `bench list` shows names and fields.
Repeated options make a grid.

examples:
  bench run --defense ldp --attack dia
  bench run --defense none --defense ldp:epsilon=inf --attack dia --extractor sift:upright=false --images DIR --json
"""
REQUIRED = ("defense",)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--defense", action="append", metavar="SPEC", help="what protects the features; may be repeated")
    parser.add_argument("--attack", action="append", metavar="SPEC", help="who tries to undo it; may be repeated")
    parser.add_argument(
        "--task", metavar="SPEC", default="reconstruction", help="what a release is judged by (default: %(default)s)"
    )
    parser.add_argument(
        "--metric",
        action="append",
        default=[],
        metavar="SPEC",
        help="one that must be told a file; all others are measured anyway",
    )
    add_extractor(parser)
    parser.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs (default: seven built-in ones)")
    parser.add_argument(
        "--dataset", metavar="SPEC", help="the place that a task is about (default: the task's; bench list datasets)"
    )
    add_engine(parser)
    add_seed(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results; resumed if it exists (default: in runs/)"
    )
    parser.add_argument("--json", action="store_true", help="print the records instead of the table")


def execute(args: argparse.Namespace) -> int:
    from bench.cli import watch
    from bench.registry import discovery, spec
    from bench.runner import engines
    from bench.runner import plan as runner
    from bench.runner.plan import RunConfiguration
    from leaderboard import localization_results, run_report

    engine = engines.choose_engine(args.workers, args.engine, args.scheduler)
    task = spec.read(args.task, discovery.TASK)
    _check_attacks(task, args.attack)
    defenses = [_defense(text, task) for text in args.defense]
    attacks = [spec.read(text, discovery.ATTACK) for text in args.attack or []]
    asked = RunConfiguration(
        pairs=runner.cross(task, defenses, attacks),
        images=args.images,
        task=task,
        extractor=spec.read(args.extractor, discovery.EXTRACTOR),
        dataset=None if args.dataset is None else spec.read(args.dataset, discovery.DATASET),
        seed=args.seed,
        metrics=tuple(_metric(text) for text in args.metric),
    )
    plan = runner.prepared(asked, engine.describe)
    out = args.out or Path("runs") / _run_name(plan)
    records = watch.execute_with_progress(
        [plan], out, engine, f"{task.name()}: {len(plan.samples)} units, {len(plan.experiments)} pairs"
    )
    run_report.write(records, plan.samples, out)
    _print_records(records) if args.json else watch.print_tables(records)
    for line in localization_results.write(records, out):
        say(DONE, line)
    say(DONE, f"written to {out}")
    return FAILED if any(record["status"] == "failed" for record in records) else DONE


def _defense(text: str, task: Task) -> Defense:
    """A defense as it is written. Its words are those of the place, if there is one and no others are named."""
    from bench.api import Asset
    from bench.codebook.public import REFERENCES
    from bench.registry import discovery, spec

    plugin, given = spec.parse(text, discovery.DEFENSE)
    if task.needs_scene and plugin.dictionary_field is not None:
        given.setdefault(plugin.dictionary_field, Asset(REFERENCES))
    return spec.build(plugin, given)


def _metric(text: str) -> Metric:
    from bench.registry import discovery, fields, spec

    metric = spec.read(text, discovery.METRIC)
    if not fields.without_default(type(metric)):
        raise UserError(f"--metric {metric.name()}: it needs not be asked for; all metrics that need no file are measured")
    return metric


def _check_attacks(task: Task, attacks: list[str] | None) -> None:
    if task.judges_attacks and not attacks:
        raise UserError(f"--attack is missing: the task {task.name()} judges what an attack recovers (bench list attacks)")
    if attacks and not task.judges_attacks:
        raise UserError(f"--attack: the task {task.name()} judges the release itself and takes none")


def _run_name(plan: Plan) -> str:
    """The defenses' and attacks' names, and eight digits that tell configurations apart."""
    defenses = dict.fromkeys(cell.defense.name() for cell in plan.experiments)
    attacks = dict.fromkeys(cell.attack.name() if cell.attack else plan.task.name() for cell in plan.experiments)
    return f"{'+'.join(defenses)[:60]}-{'+'.join(attacks)[:60]}-{plan.hash[:8]}"


def _print_records(records: list[Record]) -> None:
    for record in records:
        print(json.dumps(record, allow_nan=False))
