"""Runs every command that the documents show, in one folder and in their order, on small data.

SMALLER and LONG list the commands that run in a smaller form, UNTESTED those that do not run.
"""

import re
import shlex
from pathlib import Path

import pytest
from fakes import install_plugins, write_album

from bench import cli
from bench.cli import build_parser
from bench.registry import scaffold

ROOT = Path(__file__).resolve().parents[2]
PAGES = {name: ROOT / f"{name}.md" for name in ("README", "docs/method", "docs/formats", "docs/extending", "docs/scale")}
SMALL_VIEWS = "gallery:views=8,queries=3,width=320,height=240,rooms=1,detail=0.3"

# Further options that make a command run in seconds.
SMALLER = {
    "run --defense ldp --attack dia": "--images photos/",
    "dataset gallery --layout colmap --views 2 --queries 2 --out gallery/": "gallery:width=64,height=48,detail=0.1",
    "train --defense none --images photos/ --out W.safetensors --log logs/": "--steps 1 --batch 1 --widths 8,8",
    "export --images photos/ --defense affine --attack nearest --layout hloc --out recovered.h5": "--images one/",
    "cost --markdown": "--words 1000",
    "run --defense none --defense affine --defense ldp:epsilon=16 --defense ldp --attack dia --attack nearest": "--images one/",
    "dictionary build --images photos/ --size 256000 --out K.safetensors": "--size 64",
    "train --defense ldp:dictionary=K.safetensors --images other-photos/ --out W.safetensors": (
        "--validation unseen/ --steps 1 --batch 1 --widths 8,8"
    ),
    "run --task matching --defense none --defense ldp --defense affine": "--task matching:each=1",
    "run --task localization --defense none --defense ldp:epsilon=6.534,words=8000 --workers 2": f"--dataset {SMALL_VIEWS}",
    "run --task localization --defense affine --dataset colmap:path=mine/": "--dataset colmap:path=gallery/",
    "dataset gallery --layout colmap --views 300 --queries 300 --out gallery/": f"{SMALL_VIEWS} --views 9 --queries 2",
    "cost": "--words 1000",
    "sweep smoke": "--images one/",
    "audit --defense ldp:epsilon=2,subset_size=2 --words 64 --trials 1000000": "--trials 10000",
}
# Further options of commands that take many seconds even so: an exhaustive test runs each of them by itself.
LONG = {
    "reproduce table1": "--profile smoke --images one/",
    "reproduce table2": f"--profile smoke --dataset {SMALL_VIEWS} --workers 1",
    "reproduce table1 --profile smoke": "--images one/",
    "reproduce table4 --profile smoke": "--images one/",
    (
        "run --task structure --defense none --defense ldp:words=256000,epsilon=9.307,subset_size=16 "
        "--extractor sift:max_keypoints=2000"
    ): "--dataset walk:views=4,others=6,steps=60,width=320,height=240,detail=0.3",
    "train --defense none --images megadepth/ --out W.safetensors --profile paper --devices 4": (
        "--validation unseen/ --steps 1 --batch 2 --widths 8,8 --devices 2"
    ),
}
# Never run here, with the reason.
UNTESTED = {"sweep privacy-utility": "takes half an hour; test_sweep.py plans it"}


def list_commands(page: str) -> list[str]:
    """Return the commands of a page, without comments."""
    text = PAGES[page].read_text(encoding="utf-8")
    return re.findall(r"^(?:\.venv/bin/)?bench (.+?)(?:\s+#.*)?$", text, re.MULTILINE)


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the photographs, results and baseline that the commands refer to."""
    write_album(tmp_path / "photos", 3)
    write_album(tmp_path / "one", 1)
    write_album(tmp_path / "other-photos", 3, first=3)
    write_album(tmp_path / "unseen", 3, first=6)
    write_album(tmp_path / "megadepth", 3, first=9)
    monkeypatch.chdir(tmp_path)
    assert cli.main(shlex.split("run --defense none --attack keypoints --images photos/ --out runs/x")) == 0
    for name in ("baseline.jsonl", "theirs.jsonl"):
        (tmp_path / name).write_bytes((tmp_path / "runs" / "x" / "records.jsonl").read_bytes())
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_commands_run(page: str, workspace: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    shown = list_commands(page)
    assert shown
    if any("aachen:path=aachen/" in command for command in shown):
        assert cli.main(["dataset", SMALL_VIEWS, "--layout", "aachen", "--out", "aachen/"]) == 0
    for command in shown:
        if "--defense my-defense" in command:  # which an earlier command has written, and pip would install
            install_plugins(
                workspace / "installed", monkeypatch, {"feature_privacy.defenses": {"my-defense": "my_defense:PLUGIN"}}
            )
            monkeypatch.syspath_prepend(workspace / "my-defense")
        if command not in LONG.keys() | UNTESTED.keys():
            assert cli.main(build_arguments(command)) == 0, (command, capfd.readouterr().err)


@pytest.mark.exhaustive
@pytest.mark.parametrize("command", LONG)
def test_long_commands_run(command: str, workspace: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(build_arguments(command)) == 0, capfd.readouterr().err


def build_arguments(command: str) -> list[str]:
    """Return the arguments that are run for a command of a document."""
    words = shlex.split(command)
    args, extra = build_parser().parse_known_args(words)
    assert not extra
    assert all(getattr(args, option) for option in args.required)
    if command.startswith("dataset gallery"):
        smaller, *more = shlex.split(SMALLER[command])
        return [smaller if word == "gallery" else word for word in words] + more
    if command.startswith("run --task structure"):  # the references of the small walk have few descriptors
        words = [word.replace("words=256000", "words=2560") for word in words]
    if command.startswith("submit-check"):
        return [*words, "--images", "photos/"]
    return [*words, *shlex.split((SMALLER | LONG).get(command, ""))]


def test_exceptions_are_of_existing_commands() -> None:
    every = {command for page in PAGES for command in list_commands(page)}
    assert every >= SMALLER.keys() | LONG.keys() | UNTESTED.keys()


def test_all_kinds_of_plugins_are_shown() -> None:
    assert {command.split()[1] for command in list_commands("docs/extending") if command.startswith("new ")} == set(
        scaffold.KINDS
    )


def test_targets_of_make_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for name in ("CONTRIBUTING.md", "docs/method.md", "docs/scale.md", "README.md"):
        for target in re.findall(r"(?:^|`)make ([a-z]+)", (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE):
            assert f"\n{target}:" in makefile, f"{name}: make {target}"


def list_anchors(path: Path) -> set[str]:
    """Return the fragments of a page's headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    slugs = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in re.findall(r"^#+ (.+)$", text, re.MULTILINE)]
    earlier = [slugs[:number].count(slug) for number, slug in enumerate(slugs)]
    return {f"{slug}-{count}" if count else slug for slug, count in zip(slugs, earlier, strict=True)}


def list_broken_links(path: Path) -> list[str]:
    """Return the relative links of a page whose file or heading does not exist."""
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, fragment = link.partition("#")
        target = path.parent / file if file else path
        if not target.exists() or (fragment and fragment not in list_anchors(target)):
            broken.append(link)
    return broken


def test_links_are_valid() -> None:
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")):
        assert not list_broken_links(path), path.name


def test_broken_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# A title: of `two` parts\n")
    page = tmp_path / "page.md"
    page.write_text(
        "## Here\n[a](other.md#a-title-of-two-parts) [b](#here) [c](https://a.b/#c)\n[d](gone.md) [e](other.md#e) [f](#f)\n"
    )
    assert list_broken_links(page) == ["gone.md", "other.md#e", "#f"]


def test_citation_has_this_version() -> None:
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version = re.search(r'^version = "(.+)"$', pyproject, re.MULTILINE)
    assert version is not None
    assert f"\nversion: {version[1]}\n" in citation
    assert citation.startswith("cff-version: 1.2.0\n")
