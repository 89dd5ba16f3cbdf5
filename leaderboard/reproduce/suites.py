"""Builds suites for `bench sweep` from the paper's tables."""

from __future__ import annotations

from bench.images import photographs
from bench.runner.plan import RunConfiguration
from bench.runner.suite import Suite
from leaderboard.reproduce import run, tables
from leaderboard.reproduce.profiles import CPU, Materials, Setting


def build_suite(name: str) -> Suite:
    """Return the suite of a table's rows and reference rows, with the shipped files and the profile `cpu`.

    `bench reproduce` reuses the records of the suite if `--out` names the same folder.
    """
    table = tables.load_tables()[name]
    extractor = table.extractor(CPU)
    setting = Setting(profile=CPU, materials=Materials(), extractor=extractor, photographs=len(photographs.list_builtin()))
    rows = (*table.build_rows(setting), *table.build_reference_rows(setting))
    parts = [
        RunConfiguration(
            pairs=tuple((row.defense, row.attack) for row in rows if row.task == task),
            images=None,
            task=task,
            extractor=extractor,
            dataset=None if table.dataset is None else table.dataset(CPU),
            seed=seed,
        )
        for seed in run.list_seeds(table, setting)
        for task in dict.fromkeys(row.task for row in rows)
    ]
    return Suite(summary=table.title, parts=tuple(parts))
