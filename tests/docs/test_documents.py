"""The examples of the documents run, and their links, commands and versions are valid.

Blocks of `console` and `python` run exactly as printed (`sessions.py`). Blocks of `bash` or of no language list commands that
take long or need large data: their `bench` commands run in smaller forms (SMALLER, LONG), or are parsed only (UNTESTED).
"""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from fakes import install_plugins, write_album
from sessions import create_environment, list_blocks, list_commands, run_page

from bench import cli
from bench.cli import build_parser
from bench.images.photographs import list_builtin
from bench.registry import scaffold

ROOT = Path(__file__).resolve().parents[2]
PATHS = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.md")]
DOCUMENTS = {path.relative_to(ROOT).with_suffix("").as_posix(): path.read_text(encoding="utf-8") for path in sorted(PATHS)}
ELSEWHERE = {"docs/guarantee": "test_guarantee.py", "docs/running": "test_sweep.py"}  # documents with tests of their own
EXECUTED = {name: page for name, page in DOCUMENTS.items() if name not in ELSEWHERE and list_commands(page)}
TUTORIALS = "docs/tutorials/"  # they make their own photographs

SMALL_VIEWS = "gallery:views=8,queries=3,width=320,height=240,rooms=1,detail=0.3"

# Further options that make a command run in seconds.
SMALLER = {
    "dataset gallery --layout colmap --views 2 --queries 2 --out gallery/": "gallery:width=64,height=48,detail=0.1",
    "train --defense none --images photos/ --out W.safetensors --log logs/": "--steps 1 --batch 1 --widths 8,8",
    "export --images photos/ --defense affine --attack nearest --layout hloc --out recovered.h5": "--images one/",
    "train --defense lines --images photos/ --out W.safetensors --widths 32,64,112,56 --steps 2500": (
        "--steps 1 --batch 1 --widths 8,8"
    ),
    "train --model flow --defense none --images photos/ --out F.safetensors": "--steps 1 --batch 1 --widths 8,8",
    "run --defense lines --attack dia-lines:weights=W.safetensors --attack neighbourhood": "--images one/",
    "cost --markdown": "--words 1000",
    "dictionary build --images other-photos/ --extractor xfeat --size 16000 --out words.safetensors": "--size 1600",
    "train --images other-photos/ --extractor xfeat --defense none --out raw.safetensors": "--steps 1 --batch 1 --widths 8,8",
    "train --images other-photos/ --extractor xfeat --defense none --encoding positions --out positions.safetensors": (
        "--steps 1 --batch 1 --widths 8,8"
    ),
}
# Further options of commands that take many seconds even so: an exhaustive test runs each of them by itself.
LONG = {
    "train --defense none --images megadepth/ --out W.safetensors --profile paper --devices 4": (
        "--validation unseen/ --steps 1 --batch 2 --widths 8,8 --devices 2"
    ),
}
# Commands that are parsed only, by their beginnings, with the reason.
UNTESTED = {
    "reproduce figure-inlier": "minutes; test_reproduce.py runs it in the profile smoke",
    "reproduce tableS2": "minutes; test_reproduce.py runs it in the profile smoke",
    "dataset fetch places365-val --to": "2 GB; test_published.py downloads small archives",
    "dataset fetch hpatches --to": "1.3 GB; test_published.py downloads small archives",
    "run --defense none --attack dia --images torchvision:Places365": "its photographs are not distributed",
    "run --task localization --dataset captured:path=fox/": "its photographs are not distributed",
    "run --defense none --defense affine --defense ldp:epsilon=16": "the release of networks: 100 photographs",
    "run --defense none --attack dia --extractor sift:upright=false": "the release of networks: 100 photographs",
}


# ---- examples that run as printed


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    return create_environment(tmp_path / "environment")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "folder"
    folder.mkdir()
    return folder


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", EXECUTED)
def test_examples_run_as_printed(name: str, folder: Path, environment: Path) -> None:
    if not name.startswith(TUTORIALS):
        for number, photograph in enumerate(list_builtin()):
            album = folder / ("photos" if number < 3 else "other-photos")
            album.mkdir(exist_ok=True)
            shutil.copy(photograph.path, album)
    run_page(EXECUTED[name], folder, environment)


@pytest.mark.slow
def test_notation(folder: Path, environment: Path) -> None:
    run_page(
        """
```console
$ echo one   two; echo; echo three >&2; echo four  # a comment
one two
three
$ printf 'a\\nb 0.123\\nc\\n' && \\
    mkdir inner
...
b 0.1...
$ (exit 3)
$ echo $?
3
$ export NAME=value; cd inner
```
1. An indented block:

   ```console
   $ echo $NAME; pwd
   value
   .../inner
   ```
```python
# package/module.py
LETTERS = "ab"
```
```python
from package.module import LETTERS

print(LETTERS)
```
```text
$ false
```
""",
        folder,
        environment,
    )
    assert (folder / "inner" / "package" / "module.py").read_text() == '# package/module.py\nLETTERS = "ab"\n'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("console\n$ echo one\ntwo", "line 3: echo one\npromised:\ntwo\nprinted:\none"),
        ("console\n$ echo one\none\ntwo", "promised:\none\ntwo\nprinted:\none"),
        ("console\n$ echo one; echo two\ntwo", "promised:\ntwo"),
        ("console\n$ echo one\non", "promised:\non"),
        ("console\n$ echo one\n...\ntwo", "promised:\n...\ntwo"),
        ("console\n$ echo one\n$ exit 1\n$ echo two", "line 4: exit 1\nnot executed"),
        ("console\n$ echo one\n$ false\n$ echo two", "line 4: false\nexit status 1, not 0"),
        ("console\n$ false\n$ echo $?\n2", "line 3: false\nexit status 1, not 2"),
        ("console\n$ true\n$ echo $?\n2", "line 3: true\nexit status 0, not 2"),
        ("console\n$ bench-mark --all", "exit status 127, not 0"),
        ("console\n$ bench run --defence none", "exit status 2, not 0"),
        ("console\nbench list", "a console block begins with"),
        ("python\nprint(undefined)", "exit status 1, not 0"),
        ("python\ndef unfinished(", "exit status 1, not 0"),
        ("console\n$ echo 'unfinished", "not executed"),
    ],
)
def test_broken_promises_are_found(block: str, message: str, folder: Path, environment: Path) -> None:
    with pytest.raises(AssertionError) as raised:
        run_page(f"# A page\n```{block}\n```\n", folder, environment)
    assert message in str(raised.value)


@pytest.mark.slow
def test_installations_stay_in_the_environment(folder: Path, environment: Path) -> None:
    install = "```console\n$ bench new defense local\n$ pip install -q -e local\n```\n"
    run_page(f"{install}```console\n$ bench list defenses | grep local\nlocal...\n```\n", folder, environment)
    with pytest.raises(AssertionError, match="exit status 1"):
        run_page("```console\n$ bench list defenses | grep local\n```\n", folder, create_environment(folder / "other"))


# ---- commands that are listed


def list_listed(page: str) -> list[str]:
    """Return the arguments of the `bench` commands in blocks of `bash` or of no language."""
    text = "".join(block.text for block in list_blocks(page) if block.language in ("", "bash"))
    lines = [re.sub(r"\s+#.*", "", line) for line in text.replace("\\\n", "").splitlines()]
    commands = [" ".join(line.split()) for line in lines]
    return [match[1] for command in commands if (match := re.fullmatch(r"(?:\.venv/bin/)?bench (.+)", command))]


LISTED = {name: listed for name, page in DOCUMENTS.items() if name not in ELSEWHERE and (listed := list_listed(page))}


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the photographs, results and baseline that the commands refer to."""
    write_album(tmp_path / "photos", 3)
    write_album(tmp_path / "one", 1)
    write_album(tmp_path / "unseen", 3, first=6)
    write_album(tmp_path / "other-photos", 3, first=3)
    write_album(tmp_path / "megadepth", 3, first=9)
    monkeypatch.chdir(tmp_path)
    assert cli.main(shlex.split("run --defense none --attack keypoints --images photos/ --out runs/x")) == 0
    (tmp_path / "baseline.jsonl").write_bytes((tmp_path / "runs" / "x" / "records.jsonl").read_bytes())
    return tmp_path


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", LISTED)
def test_listed_commands_run(
    name: str, workspace: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if any("aachen:path=aachen/" in command for command in LISTED[name]):
        assert cli.main(["dataset", SMALL_VIEWS, "--layout", "aachen", "--out", "aachen/"]) == 0
    for command in LISTED[name]:
        if "--defense my-defense" in command:  # an earlier command wrote it, and pip would install it
            plugins = {"feature_privacy.defenses": {"my-defense": "my_defense:PLUGIN"}}
            install_plugins(workspace / "installed", monkeypatch, plugins)
            monkeypatch.syspath_prepend(workspace / "my-defense")
        arguments = build_arguments(command)
        if command not in LONG and not command.startswith(tuple(UNTESTED)):
            assert cli.main(arguments) == 0, (command, capfd.readouterr().err)


@pytest.mark.exhaustive
@pytest.mark.parametrize("command", LONG)
def test_long_commands_run(command: str, workspace: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(build_arguments(command)) == 0, capfd.readouterr().err


def build_arguments(command: str) -> list[str]:
    """Parse a command of a document, and return the arguments that are run for it."""
    words = shlex.split(command)
    args, extra = build_parser().parse_known_args(words)
    assert not extra
    assert all(getattr(args, option) for option in args.required)
    smaller = shlex.split((SMALLER | LONG).get(command, ""))
    if command.startswith("dataset gallery"):
        return [smaller[0] if word == "gallery" else word for word in words] + smaller[1:]
    if command.startswith("submit-check"):
        return [*words, "--images", "photos/"]
    return [*words, *smaller]


def test_exceptions_are_of_listed_commands() -> None:
    listed = {command for commands in LISTED.values() for command in commands}
    assert listed >= SMALLER.keys() | LONG.keys()
    assert all(any(command.startswith(beginning) for command in listed) for beginning in UNTESTED)


def test_all_kinds_of_plugins_are_shown() -> None:
    shown = re.findall(r"^(?:\$ )?bench new ([a-z]+)", DOCUMENTS["docs/extending"], re.MULTILINE)
    assert set(shown) == set(scaffold.KINDS)


def test_targets_of_make_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for name, page in DOCUMENTS.items():
        for target in re.findall(r"(?:^|`)make ([a-z-]+)", page, re.MULTILINE):
            assert f"\n{target}:" in makefile, f"{name}: make {target}"


# ---- links and versions


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
    broken = {path.name: list_broken_links(path) for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))}
    broken["model card"] = list_broken_links(ROOT / "bench" / "assets" / "MODEL_CARD.md")
    assert {name: links for name, links in broken.items() if links} == {}


def test_broken_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# A title: of `two` parts\n")
    page = tmp_path / "page.md"
    page.write_text(
        "## Here\n[a](other.md#a-title-of-two-parts) [b](#here) [c](https://a.b/#c)\n[d](gone.md) [e](other.md#e) [f](#f)\n"
    )
    assert list_broken_links(page) == ["gone.md", "other.md#e", "#f"]


def test_readme_is_short() -> None:
    assert len(DOCUMENTS["README"].splitlines()) <= 150


def test_citation_has_this_version() -> None:
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version = re.search(r'^version = "(.+)"$', pyproject, re.MULTILINE)
    assert version is not None
    assert f"\nversion: {version[1]}\n" in citation
    assert citation.startswith("cff-version: 1.2.0\n")
