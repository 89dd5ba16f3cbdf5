"""Records of other people: whatever a line holds, a reader uses it or names it, and never fails on it later."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from effort import EFFORT
from fabricated import DIA, baselines, ldp, localizations, reconstructions
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from bench.core import strict_json
from bench.core.errors import UserError
from bench.core.hashing import canonical_json
from bench.core.table import to_csv, to_latex, to_markdown
from bench.mechanisms import budget
from bench.runner import directory, records
from bench.runner.records import FILE, Record
from leaderboard import comparison, group_tables, recipe, regression, tables

Path_ = tuple[str | int, ...]

WHOLE = [
    *reconstructions(ldp(8.0), [0.3, 0.5], attack=DIA | {"inversion": {"name": "dia", "weights": "sha256:1"}}),
    *baselines(ldp(8.0), 2),
    *localizations(ldp(8.0), [1, 0], ["day", None]),
]
SCALARS = (
    st.none() | st.booleans() | st.integers(-(10**20), 10**400) | st.floats(allow_nan=False, allow_infinity=False) | st.text()
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2)
)


def list_paths(value: Any, before: Path_ = ()) -> list[Path_]:
    """Return the path of every entry of a record."""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for name, inner in parts for path in ((*before, name), *list_paths(inner, (*before, name)))]


def change(record: Record, path: Path_, value: Any) -> Record:
    """Return the record with another value at `path`, or without that entry for `...`."""
    changed = copy.deepcopy(record)
    *above, last = path
    inner: Any = changed
    for name in above:
        inner = inner[name]
    if value is ...:
        del inner[last]
    else:
        inner[last] = value
    return changed


def attempt(function: Callable[[Any], Any], argument: Any) -> tuple[Any, str]:
    """Return the result, or None and the message of an error that readers report."""
    try:
        return function(argument), ""
    except (UserError, ValueError) as error:
        return None, str(error)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.mark.slow
@settings(
    max_examples=100 * EFFORT, deadline=None, derandomize=EFFORT == 1, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_a_changed_record_is_refused_or_shown(folder: Path, data: st.DataObject) -> None:
    number = data.draw(st.integers(0, len(WHOLE) - 1))
    path = data.draw(st.sampled_from(list_paths(WHOLE[number])))
    changed = change(WHOLE[number], path, data.draw(st.just(...) | VALUES))
    lines = [*WHOLE[:number], records.seal(changed), *WHOLE[number + 1 :]]
    file = folder / FILE
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    located, complaint = attempt(comparison.load_records, file)
    if located is None:
        assert f"line {number + 1}: " in complaint
        assert "\n" not in complaint
    else:
        show(located)


def show(located: list[comparison.LocatedRecord]) -> None:
    """Pass records to all code that reads them: none of it raises."""
    found = [one.record for one in located]
    groups = comparison.build_groups(located)
    written = [*tables.build_tables(found), *map(group_tables.build_pairs_table, groups)]
    for writer in (to_markdown, to_csv, to_latex):
        assert all(map(writer, written))
    assert regression.compare(WHOLE, found)
    assert all(recipe.build_recipe(experiment).command for group in groups for experiment in group.experiments)
    assert budget.select_nearest_records(found, 1.0)
    for record in found:
        assert directory.reconstruction_path(Path("out"), record).parts[0] == "out"


def test_the_unchanged_records_are_shown(folder: Path) -> None:
    (folder / FILE).write_text("".join(json.dumps(line) + "\n" for line in WHOLE))
    show(comparison.load_records(folder / FILE))


@settings(max_examples=300 * EFFORT, deadline=None, derandomize=EFFORT == 1)
@given(st.binary(max_size=40) | st.text(alphabet='{}[]":,0123456789.eE-naIfty\\ud8', max_size=40).map(str.encode))
@example(b"[" * 100_000)
@example(b'{"a":' * 100_000 + b"1" + b"}" * 100_000)
@example(b"9" * 5000)
@example(b"1e999")
@example(b"[" * 33 + b"]" * 33)
def test_any_bytes_are_json_or_a_fault_of_one_line(text: bytes) -> None:
    value, complaint = attempt(strict_json.parse, text)
    assert "\n" not in complaint
    assert complaint or strict_json.parse(canonical_json(value)) == value
