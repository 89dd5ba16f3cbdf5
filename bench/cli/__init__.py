"""The command line. Heavy libraries are imported by the command that needs them, so that `bench --help` is quick."""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import NoReturn

from bench.cli import commands
from bench.cli.terminal import BROKEN_PIPE, FAILED, INTERRUPTED, MISTAKE, require, say
from bench.core.errors import UserError, unknown_name

GO_ON = "what was written is kept; run the same command again to go on"

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

exit status: 0 done, 1 some photograph failed (all else is done and written) or an audit found a violation,
2 a mistake in what was asked (nothing is written)
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    try:
        status = _command(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except UserError as error:
        return say(MISTAKE, " ".join(str(error).split()))
    except KeyboardInterrupt:
        return say(INTERRUPTED, f"interrupted; {GO_ON}")
    except MemoryError:
        return say(FAILED, f"out of memory; {GO_ON}, perhaps with fewer defenses at once")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that Python's last flush does not fail again
        return BROKEN_PIPE
    except OSError as error:
        return say(FAILED, f"{error.filename or 'writing'}: {error.strerror or error}; {GO_ON}")
    return status


class Parser(argparse.ArgumentParser):
    """Reports mistakes as `UserError`s."""

    def error(self, message: str) -> NoReturn:
        raise UserError(message)


def names() -> list[str]:
    """The commands that there are."""
    return sorted(info.name.replace("_", "-") for info in pkgutil.iter_modules(commands.__path__))


def parser() -> Parser:
    """The parser of all commands. What it parses has `execute`, and `required`: the options that must be given."""
    text = argparse.RawDescriptionHelpFormatter
    everything = Parser(
        prog="bench",
        description="The privacy benchmark for local image features: what an attacker still sees, what a server can still do.",
        epilog=EXAMPLES,
        formatter_class=text,
        allow_abbrev=False,
    )
    everything.add_argument("--version", action="version", version=f"feature-privacy-bench {version('feature-privacy-bench')}")
    added = everything.add_subparsers(metavar="COMMAND", parser_class=Parser)
    for name in names():
        module = importlib.import_module(f"{commands.__name__}.{name.replace('-', '_')}")
        epilog = getattr(module, "EPILOG", "")
        own = added.add_parser(
            name, help=module.SUMMARY, description=module.SUMMARY, epilog=epilog, formatter_class=text, allow_abbrev=False
        )
        module.options(own)
        own.set_defaults(execute=module.execute, required=module.REQUIRED, options=own.format_help())
    return everything


def _command(argv: list[str]) -> int:
    if argv and not argv[0].startswith("-") and argv[0] not in names():
        raise unknown_name("command", argv[0], names())  # argparse would refuse it without a hint
    args, extra = parser().parse_known_args(argv)
    if "execute" not in args:
        raise UserError(f"say what to do: {', '.join(names())} (bench --help explains)")
    if extra:
        option = extra[0].partition("=")[0]
        if option.startswith("-"):
            raise unknown_name("option", option, set(re.findall(r"--[a-z][a-z-]*", args.options)))
        raise UserError(f"{extra[0]!r} is one argument too many")
    require(args, args.required, argv[0])
    return int(args.execute(args))
