"""Tools that write pages of results resume: no sample is measured twice."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import result_page
import tune_attacks
from fakes import write_album
from matplotlib.figure import Figure
from PIL import Image

from bench.cache import store
from bench.images.photographs import list_photographs
from leaderboard.provenance import list_stale


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))


def test_interrupted_tuning_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_album(tmp_path / "photos", 2)
    tuning = tune_attacks.Tuning(
        attack=tune_attacks.Database,
        grid={"neighbours": (10, 20)},
        photographs=2,
        keypoints=5,
        recover=tune_attacks.recover_by_database,
    )
    measured: list[tuple[int, int]] = []

    def measure(limit: float, _tuning: Any, _source: Any, number: int, _defense: Any, point: int, _pool: Any) -> Any:
        if len(measured) >= limit:
            raise KeyboardInterrupt
        measured.append((point, number))
        return {"values": np.full((2, 3), 10.0 * point + number)}

    sources = list_photographs(tmp_path / "photos")
    monkeypatch.setattr(tune_attacks, "measure_photograph", partial(measure, 3))
    with pytest.raises(KeyboardInterrupt):
        tune_attacks.measure(tuning, sources)
    assert measured == [(0, 0), (0, 1), (1, 0)]
    monkeypatch.setattr(tune_attacks, "measure_photograph", partial(measure, np.inf))
    values = tune_attacks.measure(tuning, sources)
    assert measured == [(point, number) for point in range(4) for number in range(2)]
    assert np.array_equal(values[:, 0, :, 0], [[0, 1], [10, 11], [20, 21], [30, 31]])


def test_cached_arrays_depend_on_the_inputs() -> None:
    for inputs, expected in (([1, "a"], 1.0), ([1, "a"], 1.0), ([1, "b"], 2.0)):
        arrays = result_page.cache_arrays("tune_attacks", inputs, lambda value=expected: {"value": np.array([value])})
        assert arrays["value"].tolist() == [expected]


def test_a_page_ends_with_its_provenance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(result_page, "RESULTS", tmp_path)
    monkeypatch.setattr("sys.argv", ["tools/tune_attacks.py", "--data", "/home/me/photos"])
    result_page.write_page("page.md", "# Title\n", [])
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert text.startswith("# Title\n\n## Provenance\n")
    assert "```\npython tools/tune_attacks.py --data DATA\n```" in text
    assert list_stale(text) == []


def test_a_command_with_other_options_keeps_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And the picture. The command of the page replaces both, also from another folder (control)."""
    monkeypatch.setattr(result_page, "RESULTS", tmp_path)
    monkeypatch.setattr(result_page, "OTHER_RESULTS", tmp_path / "other")
    page, picture = tmp_path / "page.md", tmp_path / "picture.png"

    def run(text: str, *options: str) -> str:
        monkeypatch.setattr("sys.argv", ["tools/measure_curves.py", *options])
        result_page.write_page("page.md", text, [])
        figure = Figure(figsize=(len(text), 1))
        result_page.save_figure(figure, picture, [])
        return capsys.readouterr().out

    def read(folder: Path) -> tuple[str, int]:
        return (folder / page.name).read_text(encoding="utf-8").splitlines()[0], Image.open(folder / picture.name).width // 110

    assert run("12", "--data", "one", "--samples", "4") == ""
    assert read(tmp_path) == ("12", 2)
    for options in ((), ("--samples", "44"), ("--samples", "4", "--photographs", "2")):
        assert str(tmp_path / "other" / "picture.png") in run("123", "--data", "one", *options)
        assert (read(tmp_path), read(tmp_path / "other")) == (("12", 2), ("123", 3))
    assert run("1234", "--data", "two", "--samples", "4") == ""
    assert read(tmp_path) == ("1234", 4)
