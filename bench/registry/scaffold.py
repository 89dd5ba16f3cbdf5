"""Generation of a small package with a new plugin and a test of its contract."""

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
    kind.name: kind
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


def write(kind: str, name: str, out: Path) -> list[Path]:
    """Write the package into the new folder `out`, and return its files.

    Raises
    ------
    UserError
        if the kind is unknown, the name is invalid or taken, or `out` is not empty.
    """
    if kind not in KINDS:
        raise unknown_name("kind of plugin", kind, KINDS)
    module = name.replace("-", "_")
    if not NAME.fullmatch(name) or keyword.iskeyword(module):
        raise UserError(f"{name!r} is not a valid plugin name: use lower-case letters, digits, and - between words")
    existing = discovery.discover(KINDS[kind])
    if name in existing:
        raise UserError(f"{name!r} is taken by {existing[name].origin}; choose another name for the {kind}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out}: exists already; give a new folder")
    values = {
        "kind": kind,
        "name": name,
        "module": module,
        "title": "".join(part.capitalize() for part in name.split("-")),
        "group": KINDS[kind].group,
        "version": version("feature-privacy-bench"),
    }
    files = {
        "pyproject.toml": "pyproject.toml",
        "README.md": "README.md",
        f"{module}.py": f"{kind}.py",
        f"tests/test_{module}.py": f"tests/{kind}.py",
    }
    for path, template in files.items():
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        text = Template((TEMPLATES / f"{template}.txt").read_text(encoding="utf-8")).substitute(values)
        (out / path).write_text(text, encoding="utf-8")
    return [out / path for path in files]
