"""Writes a small package with a plugin of one's own, and with a test of the contract that it must keep."""

from __future__ import annotations

import keyword
import re
from importlib.metadata import version
from pathlib import Path
from string import Template

from bench.core.errors import UserError, unknown_name
from bench.registry import discovery
from bench.registry.discovery import Kind

TEMPLATES = Path(__file__).parent / "templates"
KINDS: dict[str, Kind] = {
    kind.word: kind
    for kind in (
        discovery.DEFENSE,
        discovery.ATTACK,
        discovery.METRIC,
        discovery.TASK,
        discovery.EXTRACTOR,
        discovery.DATASET,
    )
}
NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def write(word: str, name: str, out: Path) -> list[Path]:
    """Write the package into the new folder `out`, and return its files.

    Raises
    ------
    UserError
        if there is no such kind of plugin, the name cannot be one, is taken, or `out` holds something already.
    """
    if word not in KINDS:
        raise unknown_name("kind of plugin", word, KINDS)
    module = name.replace("-", "_")
    if not NAME.fullmatch(name) or keyword.iskeyword(module):
        raise UserError(f"{name!r} cannot be a plugin's name: write small letters, digits and - between words")
    taken = discovery.discover(KINDS[word])
    if name in taken:
        raise UserError(f"there is a {word} called {name!r} already: {taken[name].origin}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out}: exists already; name a new folder")
    words = {
        "kind": word,
        "name": name,
        "module": module,
        "title": "".join(part.capitalize() for part in name.split("-")),
        "group": KINDS[word].group,
        "version": version("feature-privacy-bench"),
    }
    texts = {
        "pyproject.toml": "pyproject.toml",
        "README.md": "README.md",
        f"{module}.py": f"{word}.py",
        f"tests/test_{module}.py": f"tests/{word}.py",
    }
    for path, template in texts.items():
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        written = Template((TEMPLATES / f"{template}.txt").read_text(encoding="utf-8")).substitute(words)
        (out / path).write_text(written, encoding="utf-8")
    return [out / path for path in texts]
