"""The code and the commands of the README work."""

import re
from pathlib import Path

import numpy as np
import pytest

from bench.cli import build_parser
from bench.codebook import examples
from bench.codebook.public import Public
from bench.registry import discovery

README = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")


def test_the_defense_in_twenty_lines(tmp_path, monkeypatch):
    code = next(block for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "class Rounding" in block)
    (tmp_path / "rounding.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    import rounding

    plugin = discovery.check(discovery.DEFENSE, rounding.PLUGIN)
    secret = examples.draw_features(20, 0)
    release = plugin(levels=4).protect(secret, Public(), np.random.default_rng(0))
    assert set(np.unique(release.descriptors * 4)) <= {0, 1, 2, 3, 4}
    assert plugin.name() == "rounding"


@pytest.mark.parametrize("line", re.findall(r"^(?:\.venv/bin/)?bench (.+?)(?:\s+#.*)?$", README, re.MULTILINE))
def test_commands_are_parsed(line):
    args, extra = build_parser().parse_known_args(line.split())
    assert not extra
    assert all(getattr(args, option) for option in args.required)
