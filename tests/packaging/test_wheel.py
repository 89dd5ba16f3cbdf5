"""The wheel: built, installed into a new environment, and run from another folder."""

import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.exhaustive

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("bench", "defenses", "attacks", "metrics", "leaderboard", "suites")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build from a copy, without files of earlier builds."""
    source = tmp_path_factory.mktemp("source")
    for package in (*PACKAGES, "tests"):
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / file, source / file)
    out = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(out), str(source)]
    subprocess.run(pip, check=True)
    (built,) = out.iterdir()
    return built


def test_contains_packages_and_assets_but_no_tests(wheel):
    with zipfile.ZipFile(wheel) as opened:
        names = opened.namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == set(PACKAGES)
    for path in (ROOT / "bench" / "assets").iterdir():
        assert f"bench/assets/{path.name}" in names
    for path in (ROOT / "leaderboard" / "reproduce" / "paper").iterdir():
        assert f"leaderboard/reproduce/paper/{path.name}" in names
    for path in (ROOT / "leaderboard" / "site" / "page").iterdir():
        assert f"leaderboard/site/page/{path.name}" in names
    for path in (ROOT / "suites").glob("*.toml"):
        assert f"suites/{path.name}" in names
    assert wheel.name.startswith("feature_privacy_bench-")


def test_runs_from_a_new_environment(wheel, tmp_path):
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    python = environment / "bin" / "python"
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-deps", str(wheel)], check=True)
    (site,) = environment.glob("lib/python*/site-packages")
    # The dependencies are shared. Folders of a .pth file are not searched for .pth files, so the editable install is not found.
    (site / "shared.pth").write_text(sysconfig.get_path("purelib") + "\n")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()

    def run(*command):
        return subprocess.run(command, cwd=elsewhere, check=True, capture_output=True, text=True).stdout

    home = run(str(python), "-c", "import bench; print(bench.__file__)").strip()
    assert Path(home).is_relative_to(site)
    table = run(str(environment / "bin" / "bench"), "run", "--defense", "ldp", "--attack", "dia", "--out", "results")
    assert "ldp" in table
    assert len((elsewhere / "results" / "records.jsonl").read_text().splitlines()) == 7
    assert len(list((elsewhere / "results" / "figures").iterdir())) == 7
