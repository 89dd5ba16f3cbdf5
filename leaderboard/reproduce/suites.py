"""The paper's tables as suites, for `bench sweep`."""

from __future__ import annotations

from bench.datasets import photographs
from bench.features.sift import Sift
from bench.runner import Asked
from bench.suite import Suite
from leaderboard.reproduce import tables
from leaderboard.reproduce.profiles import CPU, Materials, Setting


def of_table(name: str) -> Suite:
    """The rows of a table, and those of others that its claims compare with, with what is shipped: photographs or a place.

    Records are those of `bench reproduce`, which finds them if it is given the folder.
    """
    table, extractor = tables.everything()[name], Sift()
    setting = Setting(profile=CPU, materials=Materials(), extractor=extractor, photographs=len(photographs.builtin()))
    rows = (*table.rows(setting), *table.borrowed(setting))
    parts = [
        Asked(
            pairs=tuple((row.defense, row.attack) for row in rows if row.task == task),
            images=None,
            task=task,
            extractor=extractor,
            dataset=CPU.place if table.place else None,
            seed=0,
        )
        for task in dict.fromkeys(row.task for row in rows)
    ]
    return Suite(summary=table.title, parts=tuple(parts))
