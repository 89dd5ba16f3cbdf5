"""`bench check`: results against a baseline."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, REGRESSION, print_rich

SUMMARY = "compare results with a baseline, cell by cell, and tell what got better and what got worse"
EPILOG = """Cells are matched by configuration and inputs, whatever the seed. The tolerance comes from the spread from seed to
seed, or from the bootstrap over units where there is one seed; docs/formats.md states the rule.

exit status: 0 nothing got worse, 1 something of the baseline is missing, 2 a mistake in what was asked,
3 privacy or utility got worse than tolerated, or an attack weaker

examples:
  bench check --baseline baseline.jsonl --results runs/x
  bench check --baseline baseline.jsonl --results runs/x --format github
  bench check --baseline tests/speed.json --results runs/speed.json
"""
REQUIRED = ("baseline", "results")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--baseline", type=Path, metavar="FILE", help="records that were found good; or ratios of speed, .json")
    parser.add_argument("--results", type=Path, metavar="DIR", help="of bench run; or what pytest-benchmark wrote, .json")
    parser.add_argument(
        "--format", choices=("text", "github"), default="text", help="a table, or annotations of GitHub's (default: %(default)s)"
    )
    parser.add_argument("--all", action="store_true", help="show what is the same, too")


def execute(args: argparse.Namespace) -> int:
    from bench.runner import records
    from leaderboard import regression, regression_report, speed

    if args.baseline.suffix == ".json":
        found = speed.compare(speed.read(args.baseline), speed.ratios(args.results))
    else:
        both = [records.read(records.find(path)).records for path in (args.baseline, args.results)]
        found = regression.compare(*both)
    shown = found if args.all else [finding for finding in found if finding.verdict != "same"]
    if args.format == "github":
        print(*map(regression_report.to_github, shown), sep="\n", end="\n" if shown else "")
    elif shown:
        print_rich(regression_report.to_rich(shown))
    print(regression_report.summary(found))
    verdicts = {finding.verdict for finding in found}
    if verdicts & {"worse", "weaker"}:
        return REGRESSION
    return FAILED if "missing" in verdicts else DONE
