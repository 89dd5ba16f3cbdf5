"""Executes the examples of a Markdown page exactly as printed: one bash, one folder, from top to bottom.

    ```console
    $ bench run --defense none --attack keypoints --images photos/
    Reconstruction on photos (3 photographs)...
    ...
    bench: written to ...
    $ bench run --defense none --attack nearest
    bench: nothing to run...
    $ echo $?
    2
    ```

- `$ ` begins a command, and `\\` at the end of a line continues it.
- The lines below a command are the first lines of its stdout and stderr together, but for blank lines and the widths of spaces.
- `...` stands for any lines, or within a line for any part of it.
- The exit status must be 0, unless the next command is `echo $?` with another status below it.
- A `python` block whose first line names a file in a comment (`# my_defense.py`) is written to that file; others run as scripts.
- Blocks of `bash` or of no language list commands that take long or need large data. Blocks of other languages illustrate.
"""

from __future__ import annotations

import os
import re
import subprocess
import sysconfig
import venv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

PROMPT = re.compile(r"^\$ ((?:.*\\\n)*.*)\n((?:(?!\$ ).*\n)*)", re.MULTILINE)  # a command, and its output
PRINT_STATUS = "echo $?"
MARK = "\x1e"  # ends the output of a command, before and after its exit status
PROGRESS = re.compile(r"^.*: \d+/\d+ .*\d+ s left\n", re.MULTILINE)  # a terminal shows a bar instead
TIMEOUT = 1800  # seconds of a page


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    text: str
    line: int  # of its first line of text, from 1


@dataclass(frozen=True)
class Command:
    """A statement of bash and the promises of the page about it."""

    text: str
    line: int
    output: tuple[str, ...] = ()
    status: int = 0


def list_blocks(text: str) -> list[Block]:
    """Return the fenced blocks of a page."""
    tokens = [token for token in MarkdownIt().parse(text) if token.type == "fence"]
    return [Block(token.info.partition(" ")[0], token.content, token.map[0] + 2) for token in tokens if token.map]


def list_commands(page: str) -> list[Command]:
    """Return the commands of the blocks that are executed, in the order of the page."""
    parsers = {"console": _parse_console, "python": _parse_python}
    return [command for block in list_blocks(page) if block.language in parsers for command in parsers[block.language](block)]


def _parse_console(block: Block) -> Iterator[Command]:
    assert block.text.startswith("$ "), f"line {block.line}: a console block begins with '$ '"
    matches = list(PROMPT.finditer(block.text))
    for match, following in zip(matches, [*matches[1:], None], strict=True):
        status = int(following[2]) if following is not None and following[1] == PRINT_STATUS else 0
        line = block.line + block.text.count("\n", 0, match.start())
        yield Command(match[1], line, _normalise(match[2]), status)


def _parse_python(block: Block) -> Iterator[Command]:
    name = re.match(r"# ([\w/-]+\.py)\n", block.text)
    prepare = f'mkdir -p "$(dirname {name[1]})" && cat > {name[1]}' if name else "python -"
    yield Command(f"{prepare} <<'END_OF_BLOCK'\n{block.text}END_OF_BLOCK", block.line)


def run_page(page: str, folder: Path, environment: Path) -> None:
    """Execute a page in a folder, with the programs of a virtual environment.

    Raises
    ------
    AssertionError
        with the line of the first command that breaks a promise.
    """
    commands = list_commands(page)
    *results, rest = re.split(f"{MARK}([0-9]+){MARK}", _execute(commands, folder, environment))
    for number, command in enumerate(commands):
        where = f"line {command.line}: {command.text}\n"
        assert 2 * number < len(results), f"{where}not executed\n{rest}"
        output, status = results[2 * number : 2 * number + 2]
        assert int(status) == command.status, f"{where}exit status {status}, not {command.status}\n{output}"
        actual = _normalise(PROGRESS.sub("", output))
        assert begins_with(actual, command.output), where + "\n".join(("promised:", *command.output, "printed:", *actual))


def _execute(commands: Iterable[Command], folder: Path, environment: Path) -> str:
    """Return the outputs of commands, each followed by its exit status. The first wrong status ends the execution."""
    script = "".join(
        f"{{\n{command.text}\n}} < /dev/null\nstatus=$?; printf '{MARK}%s{MARK}' $status\n"
        f"[ $status = {command.status} ] || exit; (exit $status)\n"
        for command in commands
    )
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "COV_"))}
    settings = {
        "PATH": f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "PYTHONUNBUFFERED": "1",  # stdout and stderr in the order of a terminal
        "PIP_NO_INDEX": "1",
        "PIP_NO_BUILD_ISOLATION": "0",  # pip reads the value, not the name: no isolation, so nothing is downloaded
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }
    return subprocess.run(
        ["bash", "-c", script],
        cwd=folder,
        env=inherited | settings,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        timeout=TIMEOUT,
    ).stdout


def begins_with(lines: tuple[str, ...], promised: tuple[str, ...]) -> bool:
    """Whether lines begin with the promised ones, in which `...` stands for any lines, or for any part of a line."""
    patterns = (r"(?:.*\n)*?" if line == "..." else re.escape(line).replace(r"\.\.\.", ".*") + r"\n" for line in promised)
    return re.match("".join(patterns), "".join(f"{line}\n" for line in lines)) is not None


def _normalise(text: str) -> tuple[str, ...]:
    """Return the lines that are not blank, with single spaces."""
    return tuple(" ".join(line.split()) for line in text.splitlines() if line.strip())


def create_environment(folder: Path) -> Path:
    """Create a virtual environment that sees the packages and programs of this one, and takes installations for itself."""
    venv.create(folder)
    ours, theirs = (Path(sysconfig.get_path("purelib", vars=paths)) for paths in ({}, {"base": str(folder)}))
    (theirs / "parent.pth").write_text(f"import site; site.addsitedir({str(ours)!r})\n")
    for program in ("bench", "pip", "pytest"):
        path = folder / "bin" / program
        path.write_text(f'#!/bin/sh\nexec {folder}/bin/python {sysconfig.get_path("scripts")}/{program} "$@"\n')
        path.chmod(0o755)
    return folder
