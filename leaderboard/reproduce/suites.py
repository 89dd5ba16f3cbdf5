"""The paper's tables as suites, for `bench sweep`."""

from __future__ import annotations

from bench.images import photographs
from bench.runner.plan import RunConfiguration
from bench.runner.suite import Suite
from leaderboard.reproduce import run, tables
from leaderboard.reproduce.profiles import CPU, Materials, Setting


def of_table(name: str) -> Suite:
    """The rows of a table, and those of others that its claims compare with, with what is shipped: photographs or a place.

    Records are those of `bench reproduce`, which finds them if it is given the folder.
    """
    table = tables.everything()[name]
    extractor = table.extractor(CPU)
    setting = Setting(profile=CPU, materials=Materials(), extractor=extractor, photographs=len(photographs.builtin()))
    rows = (*table.rows(setting), *table.borrowed(setting))
    parts = [
        RunConfiguration(
            pairs=tuple((row.defense, row.attack) for row in rows if row.task == task),
            images=None,
            task=task,
            extractor=extractor,
            dataset=None if table.place is None else table.place(CPU),
            seed=seed,
        )
        for seed in run.seeds(table, setting)
        for task in dict.fromkeys(row.task for row in rows)
    ]
    return Suite(summary=table.title, parts=tuple(parts))
