"""Paths of names from outside: none leads out of its folder, and none collides with another."""

import os
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bench.core import paths
from bench.core.errors import UserError
from bench.runner import directory

ODD = [
    "..",
    "../x",
    "a/../../x",
    "/etc/x",
    "//host/x",
    "C:\\x",
    "C:x",
    "..\\x",
    "",
    ".",
    "a//b",
    "a\0b",
    "nul",
    "NUL.png",
    "aux/1.png",
    "com1.tar.gz",
    "lpt¹",
    "a.",
    "a ",
    "12:30.png",
    "x" * 255,
    "m" + "x" * 250 + ".png",
    "é" * 127,
    "caf\udce9.png",
    "\ud800.png",
    "x.png.png/y.png",
]


def list_targets(names: list[str], suffix: str = ".png") -> list[str]:
    return [paths.assign_path(Path("out"), name, suffix).as_posix() for name in names]


@pytest.mark.parametrize("name", ODD)
def test_every_name_is_written_below_its_folder(tmp_path: Path, name: str) -> None:
    path = paths.assign_path(tmp_path / "out", name, ".png")
    path.parent.mkdir(parents=True)
    path.write_bytes(b"content")
    (written,) = (file for file in tmp_path.rglob("*") if file.is_file())
    assert written == path
    assert path.resolve().is_relative_to(tmp_path / "out")
    assert not any(paths._is_special(part) for part in path.relative_to(tmp_path).parts)  # nor on Windows


def test_usual_names_stay_as_they_are() -> None:
    assert list_targets(["a.png", "night/IMG_1.JPG", "é ü.png", "x" * 251]) == [
        "out/a.png.png",
        "out/night/IMG_1.JPG.png",
        "out/é ü.png.png",
        f"out/{'x' * 251}.png",
    ]


def test_a_photograph_beside_a_folder_with_the_name_of_its_picture(tmp_path: Path) -> None:
    for name in ("x.png", "x.png.png/y.png", "x.png.png.png/z.png"):
        path = paths.assign_path(tmp_path, name, ".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    assert len([file for file in tmp_path.rglob("*") if file.is_file()]) == 3


def test_an_encoded_name_differs_from_a_photograph_of_that_name() -> None:
    (encoded,) = list_targets(["nul.jpg"], "")
    assert list_targets([encoded.removeprefix("out/")], "") != [encoded]


NAMES = st.lists(st.sampled_from([*ODD, "x.png", "x.png.png", "y", "a", "A.PNG"]) | st.text(max_size=4), min_size=1, max_size=3)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.sets(NAMES.map("/".join), min_size=2, max_size=4))
@example({"x.png", "x.png.png/y"})
def test_no_name_takes_the_file_or_folder_of_another(names: set[str]) -> None:
    targets = list_targets(sorted(names))
    assert len(set(targets)) == len(names)
    assert not any(one.startswith(f"{other}/") for one in targets for other in targets)
    assert all(len(os.fsencode(part)) <= paths.LONGEST for target in targets for part in target.split("/"))
    assert all(part not in ("", ".", "..") for target in targets for part in target.split("/"))


@pytest.mark.parametrize("name", ["..", "../x", "a/../../x", "/etc/x", "", "a\0b", "x" * 256, "a/" + "é" * 128])
@pytest.mark.parametrize("windows", [False, True])
def test_a_reader_refuses_names_that_lead_out_of_the_folder(name: str, windows: bool) -> None:
    with pytest.raises(UserError, match="name of a file"):
        paths.find_file(Path("images"), name, windows)


@pytest.mark.parametrize("name", ["nul", "db/AUX.png", "C:\\x", "C:/x", "..\\x", "a.", "com1 .png"])
def test_names_that_only_windows_refuses(name: str) -> None:
    assert paths.find_file(Path("images"), name, windows=False) == Path("images") / name
    with pytest.raises(UserError, match="Windows"):
        paths.find_file(Path("images"), name, windows=True)


@pytest.mark.parametrize("name", ["a.png", "./db/1.png", "db//1.png", "aux2/1.png", "console.png"])
@pytest.mark.parametrize("windows", [False, True])
def test_a_reader_accepts_other_names(name: str, windows: bool) -> None:
    assert paths.find_file(Path("images"), name, windows) == Path("images") / name


def test_pictures_of_a_hostile_record_stay_in_the_folder(tmp_path: Path) -> None:
    far = "../" * 9
    record = {"experiment_id": f"{far}e", "sample": f"{far * 2}x", "dataset": {"hash": f"sha256:{far}h"}}
    for path in (
        directory.reconstruction_path(tmp_path, record),
        directory.photograph_path(tmp_path, record),
        directory.figure_path(tmp_path, f"{far}x"),
    ):
        assert path.resolve().is_relative_to(tmp_path.resolve())
