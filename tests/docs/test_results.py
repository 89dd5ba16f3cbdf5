"""Every page and picture with results names a valid command and the files that it used, and these are the shipped ones.

Other documents hold no tables of scores, and tables of measurements only for the reasons in MEASUREMENTS.
"""

import re
import shlex
from pathlib import Path

import pytest
from PIL import Image

from bench.cli import build_parser
from leaderboard.provenance import CHUNK, HEADING, list_stale
from leaderboard.reproduce import command, tables

ROOT = Path(__file__).resolve().parents[2]
SCORES = {"MAE", "SSIM", "PSNR", "identified", "recovered", "angle", "mean reciprocal rank", "rank 1", "recall", "precision"}
MEASUREMENTS = {  # documents with tables of times, memory or trials: why no digest of a network or dictionary can outdate them
    "reliability.md": "seconds, memory and trials depend on the sizes of dictionaries and networks, and not on their content",
    "service-cost.md": "operations, bytes and seconds depend on the sizes of dictionaries and networks, and not on their content",
}
RESULTS = [*sorted((ROOT / "docs" / "results").glob("*.md")), *sorted((ROOT / "docs" / "images").glob("*.png"))]


def read_text(path: Path) -> str:
    """Return a page, or the provenance of a picture."""
    return path.read_text(encoding="utf-8") if path.suffix == ".md" else Image.open(path).info.get(CHUNK, "")


def explain_invalid(text: str) -> str | None:
    """Return why the provenance of a text names no valid command; None if it does."""
    named = re.search(r"```\n(.+)\n```", text.rpartition(HEADING)[2])
    program, *words = shlex.split(named[1]) if named else [""]
    if program == "bench":
        args, extra = build_parser().parse_known_args(words)
        if extra or not all(getattr(args, option) for option in args.required):
            return f"bench does not accept {words}"
        known = {*tables.load_tables(), *command.group_drawings()}
        return None if words[0] != "reproduce" or args.what in known else f"no table {args.what}"
    if program != "python" or not (ROOT / words[0]).is_file():
        return "no such program"
    options, source = {word for word in words if word.startswith("--")}, (ROOT / words[0]).read_text(encoding="utf-8")
    return next((f"{words[0]} has no {option}" for option in options if f'"{option}"' not in source), None)


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_results_are_of_the_shipped_files(path: Path) -> None:
    assert list_stale(read_text(path)) == []
    assert explain_invalid(read_text(path)) is None


PAGE = (ROOT / "docs" / "results" / "table1.md").read_text(encoding="utf-8")


def test_stale_pages_are_found() -> None:
    digest = re.search(r"`inversion-none.safetensors` \| `([0-9a-f]{16})`", PAGE)
    assert digest is not None
    assert list_stale(PAGE.replace(digest[1], "0123456789abcdef")) == [
        f"inversion-none.safetensors: used 0123456789abcdef, shipped is {digest[1]}"
    ]
    assert list_stale(PAGE.replace("inversion-none", "inversion-other")) == [
        f"inversion-other.safetensors: used {digest[1]}, shipped is None"
    ]


def test_pages_without_provenance_are_found() -> None:
    body = PAGE.partition(HEADING)[0]
    for text in ("", body, f"{body}{HEADING}\n\n```\nbench reproduce table1\n```\n", f"{PAGE}\n{HEADING}\n"):
        assert list_stale(text) == ["no provenance"]


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("bench reproduce table9", "no table table9"),
        ("bench reproduce table1 --image photos/", "bench does not accept"),
        ("bench run --attack dia", "bench does not accept"),
        ("python tools/gone.py", "no such program"),
        ("python tools/tune_attacks.py --attack dia", "tools/tune_attacks.py has no --attack"),
        ("make demo", "no such program"),
    ],
)
def test_invalid_commands_are_found(line: str, complaint: str) -> None:
    assert explain_invalid(PAGE) is None
    assert complaint in str(explain_invalid(PAGE.replace("bench reproduce table1\n", f"{line}\n")))


# ---- other documents


def list_columns(text: str) -> set[str]:
    """Return the columns of all tables of a document, without what stands in parentheses."""
    headers = re.findall(r"^\|(.+)\|\n\|(?: *:?-+:? *\|)+$", text, re.MULTILINE)
    return {re.sub(r" \(.*\)", "", column).strip() for header in headers for column in header.split("|")}


def is_measured(columns: set[str]) -> bool:
    return any(re.search(r"\b(seconds|MB|trials)\b", column) for column in columns)


OTHERS = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md")}


def test_scores_are_on_pages_with_provenance() -> None:
    assert {name for name, text in OTHERS.items() if list_columns(text) & SCORES} == set()


def test_documents_with_measurements_are_listed() -> None:
    assert {name for name, text in OTHERS.items() if is_measured(list_columns(text))} == MEASUREMENTS.keys()


def test_commands_of_measurements_are_valid() -> None:
    for line in re.findall(r"`python (tools/\S+ [^`]+)`", OTHERS["reliability.md"]):
        assert explain_invalid(f"{HEADING}\n```\npython {line}\n```") is None


def test_scores_and_measurements_are_found() -> None:
    assert list_columns(PAGE) & SCORES
    assert list_columns("| attack | SSIM (mean) |\n| --- | ---: |\n| `dia` | 0.6 |\n") == {"attack", "SSIM"}
    assert is_measured({"work", "core seconds"})
    assert not is_measured({"verdict", "condition"})
