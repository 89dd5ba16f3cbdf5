"""The layers of the package are checked, and an import in the wrong direction breaks the check."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("importlinter", reason="the extra `lint` is not installed")

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("bench", "attacks", "defenses", "metrics", "leaderboard", "suites")
CODE = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"


def check_layers(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", CODE, "--no-cache"], cwd=folder, capture_output=True, text=True)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("*.safetensors", "__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "statement"),
    [
        ("bench/core/errors.py", "import bench.runner.plan"),
        ("bench/geometry/estimates.py", "def hidden():\n    import bench.runner.plan"),
        ("attacks/dia.py", "import attacks.keypoints"),
    ],
)
def test_a_wrong_import_breaks_the_layers(copy: Path, module: str, statement: str) -> None:
    checked = check_layers(copy)
    assert checked.returncode == 0, checked.stdout
    with (copy / module).open("a") as file:
        file.write(f"\n\n{statement}\n")
    assert check_layers(copy).returncode == 1
