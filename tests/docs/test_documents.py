"""What the documents show works as it stands there: each command is run, in one folder and in their order, on small data.

Some are run in a smaller form, or not at all; SMALLER and ELSEWHERE say which, how, and why.
"""

import re
import shlex
from pathlib import Path

import pytest
from fakes import write_album

from bench import cli
from bench.cli import build_parser
from bench.registry import scaffold

ROOT = Path(__file__).resolve().parents[2]
PAGES = {name: ROOT / f"{name}.md" for name in ("README", "docs/method", "docs/formats", "docs/extending", "docs/scale")}
FEW_VIEWS = "gallery:views=9,queries=2,rooms=1"

# Run with more options, or fewer images, so that it takes seconds.
SMALLER = {
    "run --defense ldp --attack dia": "--images photos/",
    "dataset gallery --layout colmap --views 2 --queries 2 --out gallery/": "gallery:width=64,height=48,detail=0.1",
    "train --defense none --images photos/ --out W.safetensors --log logs/": "--steps 1 --batch 1 --widths 8,8",
    "export --images photos/ --defense affine --attack nearest --layout hloc --out recovered.h5": "--images one/",
    "scale --markdown": "--words 1000",
    "run --defense none --defense affine --defense ldp:epsilon=16 --defense ldp --attack dia --attack nearest": "--images one/",
    "dictionary build --images photos/ --size 256000 --out K.safetensors": "--size 64",
    "train --defense ldp:dictionary=K.safetensors --images other-photos/ --out W.safetensors": (
        "--validation unseen/ --steps 1 --batch 1 --widths 8,8"
    ),
    "run --task matching --defense none --defense ldp --defense affine": "--task matching:each=1",
    "run --task localization --defense none --defense ldp:epsilon=6.534,words=8000 --workers 2": f"--dataset {FEW_VIEWS}",
    "run --task localization --defense affine --dataset colmap:path=mine/": "--dataset colmap:path=gallery/",
    "dataset gallery --layout colmap --views 300 --queries 300 --out gallery/": "gallery:rooms=1 --views 9 --queries 2",
    "scale": "--words 1000",
    "sweep smoke": "--images one/",
}
# Another test runs it: it needs what that test makes.
ELSEWHERE = {
    "reproduce table1 --profile smoke": "test_reproduce.py, and .ci/run as it stands",
    "run --task localization --defense none --dataset aachen:path=aachen/ --out runs/aachen": "test_localization.py",
    "run --task localization:pairs=runs/aachen/pairs.txt --defense none --dataset aachen:path=aachen/ --out runs/pairs": (
        "test_localization.py"
    ),
    "reproduce table4 --profile smoke": "test_reproduce.py, and .ci/run as it stands",
    "reproduce table1": "test_reproduce.py, and .ci/run by the profile smoke",
    "reproduce table2": "test_reproduce.py, and .ci/run by the profile smoke",
    "audit --defense ldp:epsilon=2,subset_size=2 --words 64 --trials 1000000": "test_guarantee.py",
    (
        "run --task structure --defense none --defense ldp:words=256000,epsilon=9.307,subset_size=16 "
        "--extractor sift:max_keypoints=2000"
    ): "test_structure.py and test_reproduce.py, with fewer words",
    "train --defense none --images megadepth/ --out W.safetensors --profile paper --devices 4": "test_team.py, on two CPUs",
    "sweep privacy-utility": "test_sweep.py plans it; it takes an hour",
    "run --defense my-defense --attack keypoints": "test_skeleton.py, with the package installed",
    "audit --defense ldp:epsilon=1/3,subset_size=1 --words 3 --trials 20000": "test_guarantee.py",
}


def commands(page: str) -> list[str]:
    """What a page shows, without the remarks beside it."""
    text = PAGES[page].read_text(encoding="utf-8")
    return re.findall(r"^(?:\.venv/bin/)?bench (.+?)(?:\s+#.*)?$", text, re.MULTILINE)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Photographs, results and a baseline, as whoever reads the documents has them."""
    write_album(tmp_path / "photos", 3)
    write_album(tmp_path / "one", 1)
    write_album(tmp_path / "other-photos", 3, first=3)
    write_album(tmp_path / "unseen", 3, first=6)
    monkeypatch.chdir(tmp_path)
    assert cli.main(shlex.split("run --defense none --attack keypoints --images photos/ --out runs/x")) == 0
    for name in ("baseline.jsonl", "theirs.jsonl"):
        (tmp_path / name).write_bytes((tmp_path / "runs" / "x" / "records.jsonl").read_bytes())
    return tmp_path


@pytest.mark.parametrize("page", PAGES)
def test_commands_run(page: str, place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    found = commands(page)
    assert found
    for command in found:
        assert cli.main(arguments(command)) == 0, (command, capfd.readouterr().err)


def arguments(command: str) -> list[str]:
    """What is run for a command of a document."""
    words = shlex.split(command)
    args, extra = build_parser().parse_known_args(words)
    assert not extra
    assert all(getattr(args, option) for option in args.required)
    if command in ELSEWHERE:
        return ["list", "metrics"]
    if command.startswith("dataset gallery"):
        smaller, *more = shlex.split(SMALLER[command])
        return [smaller if word == "gallery" else word for word in words] + more
    if command.startswith("submit-check"):
        return [*words, "--images", "photos/"]
    return [*words, *shlex.split(SMALLER.get(command, ""))]


def test_what_is_said_of_commands_is_of_commands_that_are_there() -> None:
    every = {command for page in PAGES for command in commands(page)}
    assert every >= SMALLER.keys() | ELSEWHERE.keys()


def test_all_kinds_of_plugins_are_shown() -> None:
    assert {command.split()[1] for command in commands("docs/extending") if command.startswith("new ")} == set(scaffold.KINDS)


def test_targets_of_make_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for name in ("CONTRIBUTING.md", "docs/method.md", "docs/scale.md", "README.md"):
        for target in re.findall(r"(?:^|`)make ([a-z]+)", (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE):
            assert f"\n{target}:" in makefile, f"{name}: make {target}"


def test_links_lead_somewhere() -> None:
    for path in (*(ROOT / "docs").glob("*.md"), ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"):
        for link in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
            assert link.startswith("https://") or (path.parent / link).exists(), f"{path.name}: {link}"


def test_citation_is_of_this_version() -> None:
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version = re.search(r'^version = "(.+)"$', pyproject, re.MULTILINE)
    assert version is not None
    assert f"\nversion: {version[1]}\n" in citation
    assert citation.startswith("cff-version: 1.2.0\n")
