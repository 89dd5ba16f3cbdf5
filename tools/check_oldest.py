"""Installs the oldest release of every dependency that pyproject.toml claims, and runs the quick tests with them.

    python tools/check_oldest.py [--venv .venv-oldest]

Each lower bound of `dependencies` becomes an exact version; packages of the extra `test` are the newest that fit. The tests'
exit status is returned. A bound may be lowered only if this passes.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tomllib
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]


def pin_oldest(requirements: Sequence[str]) -> list[str]:
    """Return `name==bound` of each requirement.

    >>> pin_oldest(["numpy>=1.26", "pycolmap>=4.0,<5"])
    ['numpy==1.26', 'pycolmap==4.0']
    """
    pins = []
    for requirement in requirements:
        match = re.fullmatch(r"([A-Za-z0-9_.-]+)>=([0-9.]+)(,.*)?", requirement)
        if match is None:
            raise ValueError(f"pyproject.toml: {requirement!r} has no lower bound of the form name>=version")
        pins.append(f"{match[1]}=={match[2]}")
    return pins


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--venv", type=Path, default=ROOT / ".venv-oldest")
    options = parser.parse_args()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    if not options.venv.exists():
        venv.create(options.venv, with_pip=True)
    python = options.venv / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    constraints = options.venv / "oldest.txt"
    constraints.write_text("\n".join(pin_oldest(project["dependencies"])) + "\n", encoding="utf-8")
    subprocess.run([python, "-m", "pip", "install", "-q", "-c", constraints, "-e", f"{ROOT}[test]"], check=True)
    quick = [python, "-m", "pytest", "-q", "-n", "logical", "--dist", "worksteal", "-m", "not exhaustive and not slow"]
    return subprocess.run(quick, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
