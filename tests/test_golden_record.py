"""Releases and scores are those of the golden record, on the machine that wrote it."""

import copy
from pathlib import Path

import golden_record
import pytest

RECORD = Path(__file__).parent / "data" / "golden.jsonl"
CASES = list(golden_record.cases())
QUICK = 4  # image pairs, three defenses


@pytest.fixture(scope="module")
def same_machine() -> None:
    machine = golden_record.read(RECORD)[0]
    if machine != golden_record.describe_machine():
        pytest.skip(f"the golden record was written on another machine: {machine}")


def find_differences(*numbers: int) -> list[str]:
    with golden_record.constant_sources():
        lines = list(golden_record.measure_all([CASES[number] for number in numbers]))
    return list(golden_record.find_differences(golden_record.read(RECORD)[1], lines))


@pytest.mark.slow
@pytest.mark.usefixtures("same_machine")
def test_releases_and_scores_of_image_pairs() -> None:
    assert find_differences(QUICK) == []


@pytest.mark.exhaustive
@pytest.mark.usefixtures("same_machine")
@pytest.mark.parametrize("number", [number for number in range(len(CASES)) if number != QUICK])
def test_releases_and_scores(number: int) -> None:
    assert find_differences(number) == []


@pytest.mark.parametrize("part", ["releases", "metrics"])
def test_a_difference_is_found(part: str) -> None:
    """Negative control."""
    before = golden_record.read(RECORD)[1]
    after = copy.deepcopy(before)
    changed = next(line for line in after if line.get("metrics"))
    if part == "releases":
        changed["releases"][0] = changed["releases"][0][::-1]
    else:
        name = next(name for name, value in changed["metrics"].items() if isinstance(value, float) and value)
        changed["metrics"][name] *= 1 + 1e-5
    assert list(golden_record.find_differences(before, before)) == []
    (message,) = golden_record.find_differences(before, after)
    assert part in message


def test_a_new_attack_or_metric_is_no_difference() -> None:
    before = golden_record.read(RECORD)[1]
    after = copy.deepcopy(before)
    changed = next(line for line in after if line.get("metrics") and line["attack"])
    changed["metrics"]["another"] = 0.5
    after.append(changed | {"attack": {"name": "another"}})
    assert list(golden_record.find_differences(before, after)) == []
    trained = copy.deepcopy(before)
    next(line for line in trained if line.get("applies") is False)["applies"] = True
    assert list(golden_record.find_differences(before, trained)) == []
    (message,) = golden_record.find_differences(trained, before)  # the control: it does not apply any more
    assert "applies was True, is False" in message


def test_what_is_gone_is_a_difference() -> None:
    """An attack, a metric, a value of a metric. Cases that are not measured are not compared."""
    before = golden_record.read(RECORD)[1]
    number, line = next((number, line) for number, line in enumerate(before) if line.get("metrics"))
    without_line = before[:number] + before[number + 1 :]
    (message,) = golden_record.find_differences(before, without_line)
    assert message == f"{golden_record.label(line)}: is gone"
    without_metric = copy.deepcopy(before)
    del without_metric[number]["metrics"][next(iter(line["metrics"]))]
    (message,) = golden_record.find_differences(before, without_metric)
    assert "metrics was" in message
    without_value = copy.deepcopy(before)
    without_value[number]["metrics"] = dict.fromkeys(line["metrics"])
    assert len(list(golden_record.find_differences(before, without_value))) == 1
    other_cases = [other for other in before if other["case"] != line["case"]]
    assert list(golden_record.find_differences(before, other_cases)) == []


def test_cases_differ_in_what_lines_name() -> None:
    keys = [(case.task, case.extractor, case.dataset) for case in CASES]
    assert len(set(keys)) == len(keys)
