"""hloc's lists of image pairs."""

from pathlib import Path

import pytest

from bench.core.errors import UserError
from bench.formats import pairs


def test_pairs_are_read_as_written(tmp_path: Path) -> None:
    retrieved = {"query/day/b.png": ["db/2.png", "db/1.png"], "query/a.png": ["db/1.png"]}
    path = tmp_path / "new" / "pairs.txt"
    assert pairs.write(path, retrieved) == 3
    assert path.read_text() == "query/day/b.png db/2.png\nquery/day/b.png db/1.png\nquery/a.png db/1.png\n"
    assert pairs.read(path) == retrieved


def test_every_pair_once(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    assert pairs.write(path, pairs.pair_all(["a", "b", "c"])) == 3
    assert path.read_text() == "a b\na c\nb c\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a b\n\na\n", "pairs.txt:3: a pair is two names, 'query reference', but there are 1 fields"),
        ("a b\na c d\n", "pairs.txt:2: a pair is two names, 'query reference', but there are 3 fields"),
        ("a b\nc b\na b\n", "pairs.txt:3: a b occurs a second time"),
        ("# nothing\n", "pairs.txt: the file is empty"),
    ],
)
def test_damaged_pairs_are_refused_by_line(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text(text)
    with pytest.raises(UserError, match=complaint):
        pairs.read(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"pairs\.txt: no such file"):
        pairs.read(tmp_path / "pairs.txt")


def test_names_with_spaces_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"'a b\.png': a list of pairs cannot hold a name with a space"):
        pairs.write(tmp_path / "new.txt", pairs.pair_all(["a b.png", "c.png"]))
    assert not (tmp_path / "new.txt").exists()


@pytest.mark.parametrize("name", ["#1.png", "caf\udce9.png"])
def test_names_that_a_list_cannot_hold_are_not_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError, match="a list of pairs cannot hold a name that begins with #, or is not UTF-8"):
        pairs.write(tmp_path / "new.txt", {"a.png": [name]})
    assert not (tmp_path / "new.txt").exists()


def test_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "pairs.txt").write_text("a.png b.png\n", encoding="utf-8-sig")
    assert pairs.read(tmp_path / "pairs.txt") == {"a.png": ["b.png"]}
