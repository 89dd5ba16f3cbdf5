"""`bench run`: evaluate defenses by attacks on them, or by a task of the server."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.terminal import DONE, FAILED, add_engine, add_extractor, add_images, add_seed, print_status
from bench.core.errors import UserError

if TYPE_CHECKING:
    from bench.api import Defense, Metric
    from bench.runner.plan import Plan
    from bench.runner.records import Record
    from bench.task_api import Task

SUMMARY = "run attacks on the releases of defenses, or a task of the server, and report the metrics"
EPILOG = """Write a plugin as name:field=value,field=value; `bench list` shows names and fields.
Every given defense is combined with every given attack.

examples:
  bench run --defense ldp --attack dia
  bench run --defense ldp --attack standard-2026.3
  bench run --defense none --defense ldp:epsilon=inf --attack dia --extractor sift:upright=false --images DIR --json
"""
REQUIRED = ("defense",)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--defense", action="append", metavar="SPEC", help="a defense; may be repeated")
    parser.add_argument(
        "--attack",
        action="append",
        metavar="SPEC",
        help="an attack, or a suite of attacks such as standard-2026.3; may be repeated",
    )
    parser.add_argument(
        "--task", metavar="SPEC", default="reconstruction", help="the task that evaluates the releases (default: %(default)s)"
    )
    parser.add_argument(
        "--metric",
        action="append",
        default=[],
        metavar="SPEC",
        help="a metric that needs a file or an extra; all others are computed, and those of installed extras",
    )
    add_extractor(parser)
    add_images(parser, "seven built-in ones")
    parser.add_argument(
        "--dataset", metavar="SPEC", help="the scene of the task (default: that of the task; see bench list datasets)"
    )
    add_engine(parser)
    add_seed(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results; resumed if it exists (default: a folder in runs/)"
    )
    parser.add_argument("--json", action="store_true", help="print the records instead of the table")


def execute(args: argparse.Namespace) -> int:
    from bench.cli import watch
    from bench.registry import discovery, spec
    from bench.runner import attack_suite, engines
    from bench.runner.plan import RunConfiguration, build_plan, cross, list_extra_metrics
    from bench.runner.trial import dry_run
    from leaderboard import localization_results, run_report

    engine = engines.choose_engine(args.workers, args.engine, args.scheduler)
    task = spec.read(args.task, discovery.TASK)
    _check_attacks(task, args.attack)
    defenses = [_read_defense(text, task) for text in args.defense]
    attacks = attack_suite.read_attacks(args.attack or [])
    metrics = [_read_metric(text) for text in args.metric]
    given = {metric.name() for metric in metrics}
    configuration = RunConfiguration(
        pairs=cross(task, defenses, attacks),
        images=args.images,
        task=task,
        extractor=spec.read(args.extractor, discovery.EXTRACTOR),
        dataset=None if args.dataset is None else spec.read(args.dataset, discovery.DATASET),
        seed=args.seed,
        metrics=(*metrics, *(metric for metric in list_extra_metrics() if metric.name() not in given)),
    )
    plan = build_plan(configuration, engine.describe)
    dry_run(plan)
    out = args.out or Path("runs") / _run_name(plan)
    records = watch.execute_with_progress(
        [plan], out, engine, f"{task.name()}: {len(plan.samples)} samples, {len(plan.experiments)} pairs"
    )
    run_report.write(records, out, args.command)
    _print_records(records) if args.json else watch.print_tables(records)
    for line in localization_results.write(records, out):
        print_status(DONE, line)
    for line in localization_results.find_lost_baselines(records):
        print_status(DONE, line)
    print_status(DONE, f"written to {out}")
    return FAILED if any(record["status"] == "failed" for record in records) else DONE


def _read_defense(text: str, task: Task) -> Defense:
    """Build a defense from text. Its default dictionary is that of the scene, if the task has one."""
    from bench.codebook.public import REFERENCES
    from bench.registry import discovery, spec
    from bench.settings import Asset

    def choose_dictionary(plugin: type[Defense]) -> dict[str, Asset]:
        field = plugin.dictionary_field
        return {field: Asset(REFERENCES)} if task.needs_scene and field is not None else {}

    return spec.read(text, discovery.DEFENSE, choose_dictionary)


def _read_metric(text: str) -> Metric:
    from bench.registry import discovery, fields, spec

    metric = spec.read(text, discovery.METRIC)
    if not fields.is_optional(type(metric)):
        raise UserError(f"--metric {metric.name()}: remove it; metrics that need no file are always computed")
    return metric


def _check_attacks(task: Task, attacks: list[str] | None) -> None:
    if task.judges_attacks and not attacks:
        raise UserError(f"--attack is missing: the task {task.name()} evaluates an attack (see bench list attacks)")
    if attacks and not task.judges_attacks:
        raise UserError(f"--attack: the task {task.name()} evaluates the release itself and takes no attack")


def _run_name(plan: Plan) -> str:
    """Return the names of defenses and attacks, and eight digits of the configuration's hash."""
    defenses = dict.fromkeys(experiment.defense.name() for experiment in plan.experiments)
    attacks = dict.fromkeys(
        experiment.attack.name() if experiment.attack else plan.task.name() for experiment in plan.experiments
    )
    return f"{'+'.join(defenses)[:60]}-{'+'.join(attacks)[:60]}-{plan.hash[:8]}"


def _print_records(records: list[Record]) -> None:
    for record in records:
        print(json.dumps(record, allow_nan=False))
