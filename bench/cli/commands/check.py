"""`bench check`: compare results with a baseline."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, REGRESSION, print_rich, print_status

SUMMARY = "compare results with a baseline, experiment by experiment: better, worse, or unchanged"
EPILOG = """Experiments are matched by configuration and inputs; seeds may differ. The tolerance comes from the spread between
seeds, or with one seed from Student's interval over samples; see docs/formats.md.

exit status: 0 nothing is worse; 1 a part of the baseline is missing; 2 invalid arguments;
3 privacy or utility is worse than tolerated, or an attack is weaker

examples:
  bench check --baseline baseline.jsonl --results runs/x
  bench check --baseline baseline.jsonl --results runs/x --format github
  bench check --baseline tests/speed.json --results runs/speed.json
"""
REQUIRED = ("baseline", "results")


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--baseline", type=Path, metavar="FILE", help="records of a reference run, or speed ratios (.json)")
    parser.add_argument(
        "--results", type=Path, metavar="DIR", help="a folder of bench run, or a file of pytest-benchmark (.json)"
    )
    parser.add_argument(
        "--format", choices=("text", "github"), default="text", help="output: table, or GitHub annotations (default: %(default)s)"
    )
    parser.add_argument("--all", action="store_true", help="also show unchanged experiments")


def execute(args: argparse.Namespace) -> int:
    from bench.runner import records
    from leaderboard import regression, regression_report, speed

    if args.baseline.suffix == ".json":
        baselines, instructions = speed.load_ratios(args.baseline), speed.read_instruction_set(args.results)
        found = speed.compare(baselines.get(instructions, {}), speed.compute_ratios(args.results))
        if instructions not in baselines:
            known = ", ".join(baselines) or "none"
            print_status(DONE, f"{args.baseline}: no ratios for the instruction set {instructions}, only for: {known}")
    else:
        both = [records.read(records.find_file(path)).records for path in (args.baseline, args.results)]
        found = regression.compare(*both)
    shown = found if args.all else [finding for finding in found if finding.verdict != "same"]
    if args.format == "github":
        print(*map(regression_report.to_github, shown), sep="\n", end="\n" if shown else "")
    elif shown:
        print_rich(regression_report.build_results_table(shown))
    print(regression_report.summarize(found))
    verdicts = {finding.verdict for finding in found}
    if verdicts & {"worse", "weaker"}:
        return REGRESSION
    return FAILED if "missing" in verdicts else DONE
