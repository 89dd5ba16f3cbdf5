"""What commands share: exit statuses, how options are read, and how things are printed."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable

from bench.core.errors import UserError

DONE, FAILED, MISTAKE, REGRESSION, INTERRUPTED = 0, 1, 2, 3, 130
BROKEN_PIPE = 141  # as a shell reports a program that SIGPIPE ended
PIPED_WIDTH = 400  # columns of a table that goes to a file: its cells are not folded, so that they can be searched


def require(args: argparse.Namespace, options: Iterable[str], command: str) -> None:
    """Raise UserError if one of these options was not given."""
    for option in options:
        if getattr(args, option) in (None, ""):
            raise UserError(f"--{option.replace('_', '-')} is missing (bench {command} --help explains)")


def say(status: int, line: str) -> int:
    """Print a line on stderr; returns the status."""
    print(f"bench: {line}", file=sys.stderr, flush=True)
    return status


def print_rich(*items: object) -> None:
    """Print what rich can draw."""
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
    # Rich itself would answer a closed pipe with exit status 1, which is taken.
    with console.capture() as captured:
        for item in items:
            console.print(item)
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(captured.get().encode(encoding, "backslashreplace").decode(encoding))


def whole(text: str) -> int:
    """Read a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, not {text!r}") from None


def wholes(text: str) -> tuple[int, ...]:
    """Read whole numbers with commas between them."""
    return tuple(whole(part) for part in text.split(","))


def number(text: str) -> float:
    """Read a number, exactly."""
    from bench.core.exact import Exact

    try:
        return Exact(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number or a fraction, not {text!r}") from None


def add_seed(parser: argparse.ArgumentParser, what: str = "everything random") -> None:
    """Declare --seed."""
    parser.add_argument("--seed", type=whole, default=0, metavar="N", help=f"of {what} (default: %(default)s)")


def add_extractor(parser: argparse.ArgumentParser, default: str | None = "sift", told: str = "sift") -> None:
    """Declare --extractor; `told` names the default for people."""
    parser.add_argument("--extractor", metavar="SPEC", default=default, help=f"what makes the features (default: {told})")


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Declare --workers, --engine and --scheduler."""
    parser.add_argument("--workers", type=whole, default=1, metavar="N", help="processes of this machine (default: %(default)s)")
    parser.add_argument("--engine", metavar="NAME", default="processes", help="processes or dask (default: %(default)s)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of dask, such as tcp://127.0.0.1:8786 (docs/sweeps.md)")


def size(text: str) -> int:
    """Read a number of bytes: `500`, `20kB`, `1.5GB`."""
    found = re.fullmatch(r"([0-9.]+)\s*([kMGT]?)B?", text.strip())
    try:
        return round(float(found[1]) * 1000 ** " kMGT".index(found[2] or " ")) if found else int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a size such as 20MB, not {text!r}") from None


def told_size(count: int) -> str:
    """A number of bytes for people."""
    power = min(3, max(0, (len(str(count)) - 1) // 3))
    return f"{count / 1000**power:.3g} {('B', 'kB', 'MB', 'GB')[power]}"
