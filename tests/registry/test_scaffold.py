"""Packages of `bench new`: their tests pass, they can be installed, and they run with every applicable attack."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image, ImageDraw

from bench import cli
from bench.registry import discovery, scaffold

ROOT = Path(__file__).resolve().parents[2]

# A second defense, which releases subspaces, so that attacks on subspaces run too.
LIFTING = '''
"""Hides each descriptor in a plane through it and random directions."""

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, Privacy
from bench.types import Points, Subspaces


@dataclass(frozen=True, kw_only=True)
class Planes(Defense):
    """Lifts to random planes."""

    releases = Subspaces

    def protect(self, secret, public, rng):
        directions = np.linalg.qr(rng.normal(size=(len(secret), 128, 2)))[0].transpose(0, 2, 1).astype(np.float32)
        moved = np.einsum("nd,ndk->nk", rng.normal(size=(len(secret), 2)), directions).astype(np.float32)
        positions = Points(keypoints=secret.keypoints.copy())
        return Subspaces(positions=positions, size=secret.size, origins=secret.descriptors + moved, bases=directions)

    def privacy(self, public):
        return Privacy("none")


PLUGIN = Planes
'''


def run_python(*command: str, path: list[Path], cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run Python with these folders and this project on its path."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [*path, ROOT]))}
    return subprocess.run([sys.executable, *command], cwd=cwd, env=environment, capture_output=True, text=True, check=False)


def draw_dots(count: int) -> Image.Image:
    """Draw a picture with few keypoints: all attacks are quick on it."""
    image = Image.new("RGB", (256, 256), "white")
    draw = ImageDraw.Draw(image)
    for number in range(count):
        x, y = 40 + 60 * (number % 3), 40 + 60 * (number // 3)
        draw.ellipse([x, y, x + 5 + number, y + 9], fill="black")
    return image


@pytest.mark.slow
def test_contract_tests_of_all_kinds_pass(tmp_path: Path) -> None:
    for kind in scaffold.KINDS:
        assert cli.main(["new", kind, f"my-{kind}", "--out", str(tmp_path / kind)]) == 0
    folders = [tmp_path / kind for kind in scaffold.KINDS]
    tests = [str(folder / "tests") for folder in folders]
    done = run_python("-m", "pytest", "-q", "-p", "no:cacheprovider", *tests, path=folders, cwd=tmp_path)
    assert done.returncode == 0, done.stdout[-3000:]
    assert "failed" not in done.stdout
    style = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--config", str(ROOT / "pyproject.toml"), *map(str, folders)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert style.returncode == 0, style.stdout


@pytest.mark.slow
def test_contract_test_fails_for_a_wrong_defense(tmp_path: Path) -> None:
    """The written test detects a defense that moves its keypoints."""
    assert cli.main(["new", "defense", "my-defense", "--out", str(tmp_path)]) == 0
    plugin = tmp_path / "my_defense.py"
    plugin.write_text(plugin.read_text().replace("secret.keypoints.copy()", "secret.keypoints + 1"))
    done = run_python("-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "contract", "tests", path=[tmp_path], cwd=tmp_path)
    assert done.returncode == 1
    assert "the released keypoints differ from the secret ones" in done.stdout


@pytest.mark.exhaustive
def test_installed_packages_run_with_every_attack(tmp_path: Path) -> None:
    """Packages are installed by pip; the project is unchanged."""
    (tmp_path / "album").mkdir()
    draw_dots(9).save(tmp_path / "album" / "0.png")
    site = tmp_path / "site"
    for name in ("my-defense", "planes"):
        assert cli.main(["new", "defense", name, "--out", str(tmp_path / name)]) == 0
    (tmp_path / "planes" / "planes.py").write_text(LIFTING)
    pip = ["-m", "pip", "install", "-q", "--no-build-isolation", "--no-deps", "--no-index", "--target", str(site)]
    done = run_python(*pip, str(tmp_path / "my-defense"), str(tmp_path / "planes"), path=[], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    attacks = [option for attack in discovery.discover(discovery.ATTACK) for option in ("--attack", attack)]
    defenses = ["--defense", "my-defense:levels=4", "--defense", "planes"]
    results = ["--images", "album", "--out", "x"]
    done = run_python("-m", "bench.cli", "run", *defenses, *attacks, *results, path=[site], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    records = [json.loads(line) for line in (tmp_path / "x" / "records.jsonl").read_text().splitlines()]
    assert len(records) == 2 * len(discovery.discover(discovery.ATTACK))
    pairs = {(record["defense"]["name"], record["attack"]["name"]) for record in records if record["status"] == "ok"}
    assert {("my-defense", "keypoints"), ("planes", "keypoints"), ("planes", "nearest"), ("planes", "sparsity")} <= pairs
    assert all(record["reason"] for record in records if record["status"] == "n/a")
    assert records[0]["sources"]["defense"] is not None


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("defence", "mine"), "unknown kind of plugin 'defence'; did you mean 'defense'?"),
        (("defense",), "--name is missing"),
        (("defense", "My Defense"), "is not a valid plugin name"),
        (("defense", "../up"), "is not a valid plugin name"),
        (("defense", "class"), "is not a valid plugin name"),
        (("defense", "ldp"), "'ldp' is taken by defenses.ldp; choose another name for the defense"),
    ],
)
def test_invalid_arguments(
    arguments: tuple[str, ...],
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["new", *arguments]) == 2
    assert complaint in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert cli.main(["new", "metric", "mine", "--out", str(tmp_path)]) == 2
    assert "exists already" in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
