"""Exit statuses, parsers of option values, shared options, and output to the terminal."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable
from pathlib import Path

from bench.core.errors import UserError

DONE, FAILED, MISTAKE, REGRESSION, INTERRUPTED = 0, 1, 2, 3, 130
BROKEN_PIPE = 141  # exit status of a program that SIGPIPE ended, as a shell reports it
PIPED_WIDTH = 400  # width of a table in a file, in characters: wide, so that text is not wrapped and can be searched


def require(args: argparse.Namespace, options: Iterable[str], command: str) -> None:
    """Raise UserError if one of `options` is missing."""
    for option in options:
        if getattr(args, option) in (None, ""):
            raise UserError(f"--{option.replace('_', '-')} is missing (see bench {command} --help)")


def print_status(status: int, line: str) -> int:
    """Print a line on stderr and return the status."""
    print(f"bench: {line}", file=sys.stderr, flush=True)
    return status


def print_rich(*items: object) -> None:
    """Print tables, texts and other objects that rich can draw."""
    from rich.console import Console
    from rich.text import Text

    from bench.core.table import Table, to_terminal

    console = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
    # On a closed pipe rich exits with status 1, which has another meaning here.
    with console.capture() as captured:
        for item in items:
            console.print(to_terminal(item) if isinstance(item, Table) else Text(item) if isinstance(item, str) else item)
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(captured.get().encode(encoding, "backslashreplace").decode(encoding))


def parse_whole(text: str) -> int:
    """Parse a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, not {text!r}") from None


def parse_wholes(text: str) -> tuple[int, ...]:
    """Parse whole numbers separated by commas."""
    return tuple(parse_whole(part) for part in text.split(","))


def parse_number(text: str) -> float:
    """Parse a decimal or a fraction, exactly."""
    from bench.core.exact import Exact

    try:
        return Exact(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number or a fraction, not {text!r}") from None


def add_seed(parser: argparse.ArgumentParser, purpose: str = "all random numbers") -> None:
    """Declare --seed."""
    parser.add_argument("--seed", type=parse_whole, default=0, metavar="N", help=f"seed of {purpose} (default: %(default)s)")


def add_extractor(parser: argparse.ArgumentParser, default: str | None = "sift", shown: str = "sift") -> None:
    """Declare --extractor; `shown` is the default in the help text."""
    parser.add_argument("--extractor", metavar="SPEC", default=default, help=f"extractor of the features (default: {shown})")


def add_images(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Declare --images; `default` describes what is read without it."""
    text = "a folder of photographs, or torchvision:NAME,root=DIR,... (docs/formats.md)"
    parser.add_argument("--images", type=Path, metavar="DIR", help=text if default is None else f"{text} (default: {default})")


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Declare --workers, --engine and --scheduler."""
    parser.add_argument("--workers", type=parse_whole, default=1, metavar="N", help="worker processes (default: %(default)s)")
    parser.add_argument("--engine", metavar="NAME", default="processes", help="processes or dask (default: %(default)s)")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of dask's scheduler, such as tcp://127.0.0.1:8786 (docs/running.md)"
    )


def parse_size(text: str) -> int:
    """Parse a number of bytes: `500`, `20kB`, `1.5GB`."""
    match = re.fullmatch(r"([0-9.]+)\s*([kMGT]?)B?", text.strip())
    try:
        return round(float(match[1]) * 1000 ** " kMGT".index(match[2] or " ")) if match else int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a size such as 20MB, not {text!r}") from None


def format_count(count: int, noun: str) -> str:
    """Format a number of things: `1 record`, `2 records`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def format_size(count: int) -> str:
    """Format a number of bytes."""
    power = min(3, max(0, (len(str(count)) - 1) // 3))
    return f"{count / 1000**power:.3g} {('B', 'kB', 'MB', 'GB')[power]}"
