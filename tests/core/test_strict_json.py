"""JSON of other people: what is refused, and the limits that are still accepted."""

import sys

import pytest

from bench.core import strict_json


def nest(depth: int) -> str:
    return "[" * depth + "]" * depth


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "not valid JSON"),
        ("[NaN]", "NaN is not a number"),
        ('{"a": [1e999]}', r"a\[0\]: not finite"),
        ('{"a": {"b": ' + str(10**400) + "}}", r"a\.b: too large for a double"),
        (f"[{-(10**400)}]", r"\[0\]: too large for a double"),
        (nest(strict_json.DEEPEST + 2), "nested more than 32 deep"),
        (nest(100_000), "nested more than 32 deep"),
    ],
    ids=["syntax", "NaN", "infinite", "huge", "huge and negative", "deep", "deeper than the parser reads"],
)
def test_what_no_reader_can_use_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        strict_json.parse(text)


@pytest.mark.parametrize("text", [nest(strict_json.DEEPEST + 1), str(int(sys.float_info.max)), '{"a": [true, null, 1e308, "b"]}'])
def test_the_limits_are_accepted(text: str) -> None:
    strict_json.parse(text)
