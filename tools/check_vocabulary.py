"""Checks that code uses the project's vocabulary: prints each private word with its file and line, and exits with 1 if any.

    python tools/check_vocabulary.py [PATH ...]     # by default all Python files, templates and pages of the project

Identifiers are split into words (`split_validation`, `ScenePlace`). Text is strings, comments, and what templates show. ALLOWED
lists what stays, each for a reason.
"""

from __future__ import annotations

import argparse
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]

# Private word -> the term to use. In identifiers.
IDENTIFIERS = {
    r"paint(s|ed|ing|ings|er)?": "reconstruct, reconstruction, inference",
    r"told|tells?": "input, reported, description",
    r"place(s|d)?": "scene, index, path, coordinate",
    r"units?": "sample",
    r"cells?": "experiment",
    r"boards?": "comparison group",
    r"sheets?": "table",
    r"asked": "configuration, request",
    r"made": "result, or a verb",
    r"kept": "cache, stored",
    r"handed": "export",
    r"rehears(e|al)": "dry run",
    r"isolat(ed|ion)": "attack process",
    r"teams?": "process group",
    r"surroundings": "context model",
    r"meetings?": "subspace intersections",
    r"company|companies": "shared sub-database",
    r"rebuil(t|ding)": "database reconstruction",
    r"population": "other users' releases",
    r"strangers?": "other users' releases",
    r"misfits?": "incompatible",
    r"unsuited": "not applicable",
    r"serves": "supported settings",
    r"remembers": "memoized",
    r"dear": "expensive",
    r"spared": "saved",
    r"legs?": "training stage",
}
# In text, where many of those words are plain English.
TEXT = {
    r"paint(s|ed|ing|ings|er)?": "reconstruct, reconstruction, inference",
    r"told": "input, reported",
    r"whoever": "a noun",
    r"zero line": "baseline",
    r"handed out": "export",
    r"rehears(e|al)": "dry run",
    r"surroundings": "context model",
    r"misfits?": "incompatible",
    r"unsuited": "not applicable",
    r"dear": "expensive",
    r"spared": "saved",
    r"legs?": "training stage",
    r"carr(y|ies|ied) out": "execute",
    r"he|him|his": "the attacker: they, it",
}
# (pattern of the path, pattern of the identifier or of the text around the word): why it stays.
ALLOWED: dict[tuple[str, str], str] = {
    (r".*", r"unit_rows|unit_integer_points|unit_vertices|UNIT"): "vectors of unit norm",
    (
        r"bench/(api|audit/|datasets/|images/|positions/|registry/).*|(leaderboard|metrics|tests|tools)/.*",
        r"unit",
    ): "units of measure",
    (r"bench/inversion/(line_)?network\.py|tests/inversion/.*", r"paint|painted"): "names in shipped networks",
    (r"defenses/privunit\.py|tests/.*|docs/.*", r"PrivUnit"): "the name of a mechanism",
    (r"bench/formats/published\.py|tests/.*", r"(?i:places365)"): "the name of a dataset",
    (r"bench/rendering/.*", r"legs?|board"): "parts of people and furniture",
    (r"(bench/inversion|bench/rendering|tests|tools)/.*", r"cells?|CELL"): "grid cells",
    (r"bench/core/table\.py|tests/.*", r"cells?"): "cells of a table",
    (r"tools/check_vocabulary\.py|tests/tools/test_vocabulary\.py", r".*"): "the words themselves",
    (r"bench/runner/trial\.py|tests/runner/.*", r"population|rehearsal|unit"): "strings that enter random seeds and cache keys",
    (r"bench/runner/records\.py|bench/runner/directory\.py|tests/.*", r"cell_id|unit"): "keys of schema 1",
}


def find_words(path: Path) -> Iterator[tuple[int, str, str, str]]:
    """Yield line, word, the identifier or text that it stands in, and the term to use instead."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        for number, line in enumerate(text.splitlines(), start=1):
            yield from ((number, word, line.strip(), term) for word, term in _find_in_text(line))
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME:
            for word in split_identifier(token.string):
                for pattern, term in IDENTIFIERS.items():
                    if re.fullmatch(pattern, word):
                        yield token.start[0], word, token.string, term
        elif token.type in (tokenize.STRING, tokenize.COMMENT):
            for offset, line in enumerate(token.string.splitlines()):
                yield from ((token.start[0] + offset, word, line.strip(), term) for word, term in _find_in_text(line))


def split_identifier(name: str) -> list[str]:
    """Return the lower-case words of a name in snake case or camel case.

    >>> split_identifier("_read_ScenePlace2")
    ['read', 'scene', 'place']
    """
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def _find_in_text(line: str) -> Iterator[tuple[str, str]]:
    for pattern, term in TEXT.items():
        for match in re.finditer(rf"(?<![\w-])({pattern})(?![\w-])", line, re.IGNORECASE):
            yield match[0], term


def is_allowed(path: str, context: str, word: str) -> bool:
    """Whether a word may stand in that identifier or text of that file."""
    return any(re.fullmatch(file, path) and re.search(rf"({text})", context) for (file, text) in ALLOWED if _about(text, word))


def _about(text: str, word: str) -> bool:
    """Whether an entry of ALLOWED is about that word."""
    return text == ".*" or word.lower() in text.lower()


def check(paths: Sequence[Path]) -> list[str]:
    """Return a message for each private word."""
    messages = []
    for path in paths:
        name = path.resolve().relative_to(ROOT).as_posix() if path.resolve().is_relative_to(ROOT) else path.as_posix()
        for line, word, context, term in find_words(path):
            if not is_allowed(name, context, word):
                messages.append(f"{name}:{line}: {word!r} in {context[:80]!r}; use: {term}")
    return messages


def list_files() -> list[Path]:
    """Return the project's Python files, templates and pages."""
    patterns = ["*.py", "*.txt", "*.j2"]
    names = subprocess.run(["git", "ls-files", *patterns], cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    return [ROOT / name for name in names if (ROOT / name).is_file()]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path)
    messages = check(parser.parse_args().paths or list_files())
    print("\n".join(messages) or "vocabulary: no private words")
    return 1 if messages else 0


if __name__ == "__main__":
    sys.exit(main())
