"""How idle threads wait, in this process and in commands that it starts."""

import os
import subprocess
import sys

import pytest

from bench.core import threads


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, "1000"),
        ({threads.SPINS: "5"}, "5"),
        ({"OMP_WAIT_POLICY": "active"}, None),
    ],
    ids=["default", "count of the user", "policy of the user"],
)
def test_the_environment_of_the_user_decides_how_threads_wait(
    given: dict[str, str], expected: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("OMP_WAIT_POLICY", threads.SPINS):
        monkeypatch.setenv(variable, "")  # so that the end of the test restores it
        monkeypatch.delenv(variable)
    for variable, value in given.items():
        monkeypatch.setenv(variable, value)
    threads.limit_spinning()
    assert os.environ.get(threads.SPINS) == expected


def test_a_command_sets_it_before_torch_is_imported() -> None:
    """The library reads the variable when it is loaded."""
    code = (
        "import os, sys; from bench.cli import main; before = 'torch' in sys.modules; main(['list'])\n"
        "print(before, os.environ.get('GOMP_SPINCOUNT'), file=sys.stderr)"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", threads.SPINS)}
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert ended.stderr.split() == ["False", "1000"]
