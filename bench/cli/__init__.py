"""The command line. Each command imports its heavy libraries when it is executed, so `bench --help` is fast."""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import re
import shlex
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import NoReturn

from bench.cli import commands
from bench.cli.terminal import BROKEN_PIPE, FAILED, INTERRUPTED, MISTAKE, print_status, require
from bench.core import threads
from bench.core.errors import UserError, unknown_name

RESUME = "finished records are stored; run the same command again to continue"

EXAMPLES = """examples:
  bench run --defense ldp --attack dia
  bench run --defense ldp:epsilon=12,subset_size=4 --defense affine:dim=4 --attack nearest --attack dia --images DIR --out runs/x
  bench list
  bench dictionary build --images DIR --size 256000 --out K.safetensors
  bench train --defense ldp --images DIR --out W.safetensors
  bench dataset gallery --layout colmap --out DIR
  bench reproduce table1
  bench sweep smoke --workers 2
  bench status
  bench cache list
  bench audit --defense ldp:epsilon=2,subset_size=2 --words 64 --trials 1000000
  bench budget --image-epsilon 10

exit status: 0 success; 1 a sample failed (all others are written), or an audit found a violation;
2 invalid arguments (nothing is written)
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    threads.limit_spinning()
    try:
        status = _run_command(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except UserError as error:
        return print_status(MISTAKE, " ".join(str(error).split()))
    except KeyboardInterrupt:
        return print_status(INTERRUPTED, f"interrupted; {RESUME}")
    except MemoryError:
        return print_status(FAILED, f"out of memory; {RESUME}, with fewer defenses if the error repeats")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python's final flush fails again
        return BROKEN_PIPE
    except OSError as error:
        return print_status(FAILED, f"{error.filename or 'writing'}: {error.strerror or error}; {RESUME}")
    return status


class Parser(argparse.ArgumentParser):
    """Parser that raises `UserError` for invalid arguments."""

    def error(self, message: str) -> NoReturn:
        raise UserError(message)


def list_commands() -> list[str]:
    """Return the names of all commands."""
    return sorted(info.name.replace("_", "-") for info in pkgutil.iter_modules(commands.__path__))


def build_parser(names: Sequence[str] | None = None) -> Parser:
    """Return the parser of the commands `names`, or of all commands.

    Parsed arguments have `execute`, `required` (names of required options) and `format_help`.
    """
    text = argparse.RawDescriptionHelpFormatter
    top = Parser(
        prog="bench",
        description="Privacy benchmark for local image features: reconstruction by an attacker, and utility for a server.",
        epilog=EXAMPLES,
        formatter_class=text,
        allow_abbrev=False,
    )
    top.add_argument("--version", action="version", version=f"feature-privacy-bench {version('feature-privacy-bench')}")
    subparsers = top.add_subparsers(metavar="COMMAND", parser_class=Parser)
    for name in list_commands() if names is None else names:
        module = importlib.import_module(f"{commands.__name__}.{name.replace('-', '_')}")
        epilog = getattr(module, "EPILOG", "")
        command = subparsers.add_parser(
            name, help=module.SUMMARY, description=module.SUMMARY, epilog=epilog, formatter_class=text, allow_abbrev=False
        )
        module.add_options(command)
        command.set_defaults(execute=module.execute, required=module.REQUIRED, format_help=command.format_help)
    return top


def format_command(argv: Sequence[str]) -> str:
    """Return the command line without `--out`, which changes no result.

    >>> format_command(["run", "--defense", "ldp", "--out", "runs/x"])
    'bench run --defense ldp'
    """
    pairs = zip(["", *argv], argv, strict=False)
    return shlex.join(["bench", *(word for before, word in pairs if "--out" not in (before, word.partition("=")[0]))])


def _run_command(argv: list[str]) -> int:
    named = bool(argv) and not argv[0].startswith("-")
    if named and argv[0] not in list_commands():
        raise unknown_name("command", argv[0], list_commands())  # argparse suggests no similar name
    args, extra = build_parser(argv[:1] if named else None).parse_known_args(argv)  # the parsers of all take 50 ms
    if "execute" not in args:
        raise UserError(f"give a command: {', '.join(list_commands())} (see bench --help)")
    if extra:
        option = extra[0].partition("=")[0]
        if option.startswith("-"):
            raise unknown_name("option", option, set(re.findall(r"--[a-z][a-z-]*", args.format_help())))
        raise UserError(f"{extra[0]!r} is an unexpected argument")
    require(args, args.required, argv[0])
    args.command = format_command(argv)
    return int(args.execute(args))
