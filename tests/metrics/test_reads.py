"""Words that an OCR engine reads again, on pairs with known answers. The program is Tesseract, which is no Python package."""

import os
from pathlib import Path

import pytest
from measure_identity import read
from measure_reads import OTHER_WORDS, draw_sign, list_known_pairs, list_texts

from bench import testing
from bench.core.errors import SampleError, UserError
from bench.identification import words
from bench.identification.words import Word
from bench.images import photographs
from bench.registry import discovery
from bench.types import Floats
from metrics.reads import Reads

SIZE = 24  # pixels of the font
WORDS = "station", "market", "harbour"
TABLE = """level\tpage_num\tleft\ttop\twidth\theight\tconf\ttext
4\t1\t0\t0\t200\t40\t-1\t
5\t1\t20\t10\t100\t30\t96.5\tStation,
5\t1\t130\t10\t40\t30\t12\t"--
5\t1\t180\t10\t40\t30\t59.9\tDK-41
"""


@pytest.fixture(scope="module")
def reads() -> Reads:
    try:
        return Reads()
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def texts(tmp_path_factory: pytest.TempPathFactory) -> list[Floats]:
    """A printed page and three signs, (256, 256, 3) in [0, 1]."""
    return [read(source) for source in list_texts(tmp_path_factory.mktemp("signs"))]


@pytest.mark.slow
def test_pairs_with_known_answers(reads: Reads, texts: list[Floats]) -> None:
    for photograph in (texts[0], texts[2]):
        pairs = list_known_pairs(photograph, draw_sign(OTHER_WORDS, SIZE))
        values = {name: reads(photograph, estimate) or 0.0 for name, estimate in pairs.items()}
        assert values["itself"] == 1
        assert values["shifted by 2 pixels"] > 0.8
        assert values["blur of 0.5 pixels"] > values["blur of 2 pixels"] > values["blur of 4 pixels"] - 0.1
        for name in ("mirrored", "other words", "grey", "white noise"):
            assert values[name] == 0, name


@pytest.mark.slow
def test_each_word_counts_at_its_position(reads: Reads) -> None:
    sign = draw_sign(WORDS, SIZE)
    assert reads.describe_truth(sign) == "words in the photograph: 3"
    assert reads(sign, draw_sign(("station", "market", "library"), SIZE)) == pytest.approx(2 / 3)
    assert reads(sign, draw_sign(("harbour", "market", "station"), SIZE)) == pytest.approx(1 / 3)  # two at other positions
    assert reads(sign, draw_sign(("stadion", "markat", "harbour"), SIZE)) == 1  # one wrong character


@pytest.mark.slow
def test_a_photograph_without_text_has_no_value(reads: Reads, texts: list[Floats]) -> None:
    ground = read(photographs.list_ground_textures()[0])
    assert reads(ground, texts[0]) is None
    assert reads.describe_truth(ground) == "words in the photograph: 0"


@pytest.mark.slow
def test_contract_of_metrics(reads: Reads) -> None:
    discovery.check(discovery.METRIC, Reads)
    testing.check_metric(reads)


def test_table_of_words() -> None:
    station, plate = words._parse_table(TABLE, scale=2)
    assert station == Word(text="station", box=(5, 10, 15, 50), confidence=96.5)
    assert (plate.text, plate.confidence) == ("dk41", 59.9)
    assert words.select_legible([station, plate]) == [station]


@pytest.mark.parametrize(
    ("text", "left", "expected"),
    [("station", 10, True), ("statiom", 10, True), ("stotiom", 10, False), ("station", 40, True), ("station", 44, False)],
)
def test_words_at_the_same_position(text: str, left: float, expected: bool) -> None:
    """Of 50 pixels in width, moved by 30: the intersection over union is 20 / 80."""
    word = Word(text="station", box=(5, 10, 15, 50), confidence=90)
    assert words.is_among(word, [Word(text=text, box=(5, left, 15, 50), confidence=10)]) is expected


# ---- without the program


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Put a program of this name on the PATH, before all others."""
    folder.mkdir()
    program = folder / words.PROGRAM
    program.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def test_without_the_program_the_error_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not Reads.is_installed()
    with pytest.raises(UserError, match=r"reads: Tesseract 5 .* is not on the PATH; install it, such as by apt install"):
        Reads()


@pytest.mark.skipif(os.name != "posix", reason="the program is a shell script")
@pytest.mark.parametrize("answer", ["List of available languages (2):", 'List of available languages in "/absent/" (0):', ""])
def test_other_versions_count_as_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str) -> None:
    install(tmp_path / "bin", monkeypatch, f"echo '{answer}'; exit 1")
    assert not Reads.is_installed()


@pytest.mark.skipif(os.name != "posix", reason="the program is a shell script")
def test_a_program_that_fails_is_the_failure_of_a_sample(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / words.MODEL).touch()
    answer = f'List of available languages in "{tmp_path}/" (1):'
    install(tmp_path / "bin", monkeypatch, f"test $1 = --list-langs && echo '{answer}' && exit; echo 'no memory' >&2; exit 1")
    assert Reads.is_installed()
    with pytest.raises(SampleError, match="tesseract failed: no memory"):
        Reads()(draw_sign(WORDS, SIZE), draw_sign((), SIZE))
    with pytest.raises(UserError, match="absent: no such file"):
        Reads(model=tmp_path / "absent")
