"""Provenance of results: the command that computed them, the version, and the shipped files that they used.

A page with results ends with it, and a picture holds it as the PNG text chunk `CHUNK`. Results are stale once one of these files
is replaced; `list_stale` finds that from the text alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bench.codebook.public import ASSETS
from bench.core.environment import DISTRIBUTION
from bench.core.table import markdown_row
from bench.formats import tensor_file

HEADING = "## Provenance"
CHUNK = "Provenance"
NO_FILE = "The results use no shipped file."
DIGITS = 16  # of a digest


def read_digests(folder: Path = ASSETS) -> dict[str, str]:
    """Return the content digest of each shipped file from its header: name -> `sha256:` and 64 digits.

    `bench.formats.tensor_file` verifies it at every load.
    """
    return {path.name: tensor_file.read_header(path)[2] for path in sorted(folder.glob("*.safetensors"))}


def list_shipped_files(configurations: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Return the shipped files whose digests occur in records, or in other JSON of plugins: name -> digest."""
    text = json.dumps(list(configurations))
    return {name: digest for name, digest in read_digests().items() if digest in text}


def format_provenance(command: str, configurations: Iterable[Mapping[str, Any]]) -> str:
    """Return the section that ends a page: the command, the version, and the shipped files that `configurations` refer to."""
    files = list_shipped_files(configurations)
    rows = [("shipped file", f"SHA-256 of its content, first {DIGITS} digits"), ("---", "---")]
    rows += [(f"`{name}`", f"`{shorten(digest)}`") for name, digest in files.items()]
    lines = [HEADING, "", f"Written by version {version(DISTRIBUTION)} with this command:", "", "```", command, "```", ""]
    return "\n".join([*lines, *(map(markdown_row, rows) if files else [NO_FILE]), ""])


def list_stale(text: str, folder: Path = ASSETS) -> list[str]:
    """Return the reasons why the results of a page or picture are stale. The list is empty if all files are the shipped ones.

    Parameters
    ----------
    text : the page, or the text chunk of the picture
    folder : the shipped files
    """
    section = text.rpartition(HEADING)[2] if HEADING in text else ""
    files = re.findall(r"^\| `(\S+)` \| `([0-9a-f]+)` \|$", section, re.MULTILINE)
    if not files and NO_FILE not in section:
        return ["no provenance"]
    shipped = {name: shorten(digest) for name, digest in read_digests(folder).items()}
    return [f"{name}: used {digest}, shipped is {shipped.get(name)}" for name, digest in files if shipped.get(name) != digest]


def shorten(digest: str) -> str:
    """Return the first digits of a digest.

    >>> shorten("sha256:0123456789abcdef0123")
    '0123456789abcdef'
    """
    return digest.removeprefix("sha256:")[:DIGITS]
