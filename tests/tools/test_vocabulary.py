"""The vocabulary check finds private words in identifiers and text, and allows the listed exceptions."""

from pathlib import Path

import check_vocabulary
import pytest


@pytest.mark.parametrize(
    ("code", "word"),
    [
        ("def paint(): ...", "paint"),
        ("class ScenePlace: ...", "place"),
        ("rebuilt_words = 1", "rebuilt"),
        ('raise ValueError("the network was told nothing")', "told"),
        ("x = 1  # whoever reads this", "whoever"),
    ],
)
def test_a_private_word_is_found(tmp_path: Path, code: str, word: str) -> None:
    (tmp_path / "module.py").write_text(code + "\n")
    (message,) = check_vocabulary.check([tmp_path / "module.py"])
    assert repr(word) in message


@pytest.mark.parametrize("code", ["unit_rows = 1", "def reconstruct(): ...", '"replaced"', "# a placement is no place"])
def test_other_words_are_allowed(tmp_path: Path, code: str) -> None:
    (tmp_path / "module.py").write_text(code + "\n")
    assert check_vocabulary.check([tmp_path / "module.py"]) == []


@pytest.mark.exhaustive  # and `make lint`
def test_the_project_has_no_private_word() -> None:
    assert check_vocabulary.check(check_vocabulary.list_files()) == []
