"""The comparison of features resumes, and a row that cannot be measured says why."""

from pathlib import Path
from typing import Any

import measure_features
import pytest
import result_page
from fakes import write_album
from measure_features import DEFENSES, EXTRACTORS, LIMITS, TITLE, build_row, list_attacks, list_reasons, measure, read_defense
from result_page import RECALLS

from bench.cache import store
from bench.core.errors import UserError
from bench.images.photographs import list_photographs
from bench.registry import discovery, spec
from bench.runner.records import FILE
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended
from leaderboard.provenance import list_stale


def fabricate_localization(features: str, defense: str, dataset: str, work: Path) -> list[dict[str, Any]]:
    """Return records of two queries for SIFT."""
    spec.read(features, discovery.EXTRACTOR)
    recalls = [dict.fromkeys(RECALLS, 1.0), dict.fromkeys(RECALLS, 1.0) | {"recall_0.25m_2deg": 0.0}]
    metrics = [{**recall, "matches": matches} for recall, matches in zip(recalls, (20.0, 40.0), strict=True)]
    return [{"status": "ok", "privacy": {"log10_true": None}, "metrics": values} for values in metrics]


@pytest.mark.slow
def test_the_page_resumes_and_states_reasons(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(result_page, "RESULTS", tmp_path)
    monkeypatch.setattr("sys.argv", ["tools/measure_features.py", "--work", str(tmp_path)])
    monkeypatch.setattr(measure_features, "EXTRACTORS", {"sift": "", "xfeat:weights=absent.pt": "shipped-xfeat"})
    monkeypatch.setattr(measure_features, "DEFENSES", ("none", "ldp:epsilon=10,words=1000"))
    monkeypatch.setattr(measure_features, "ATTACKS", ("dia", "keypoints"))
    monkeypatch.setattr(measure_features, "run_localization", fabricate_localization)
    first, second = list_photographs(write_album(tmp_path / "album", 2))
    counts = {first: 250, second: 249}  # the second has too few for the networks
    monkeypatch.setattr(measure_features, "count_keypoints", counts.get)
    sources = [first, second]

    measure_features.write_results(tmp_path / "work", sources, "gallery")
    page = (tmp_path / "features.md").read_text(encoding="utf-8")
    assert list_stale(page) == []
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| `sift`")]
    attacked, localized = {(row[2], row[4]): row for row in rows[:4]}, rows[4:]
    assert attacked["`none`", "`dia`"][-1] in ("0 of 1 |", "1 of 1 |")
    assert attacked["`ldp:epsilon=10,words=1000`", "`keypoints`"][3] == "0.98"  # chance of the true word among 1,000
    assert attacked["`ldp:epsilon=10,words=1000`", "`dia`"][-1] == "n/a |"
    assert [row[3:] for row in localized] == [["2", "0.50", "1.00", "1.00", "30 |"]] * 4
    assert "under `dia`: no adapted attacker (" in page
    assert "inversion-ldp.safetensors was trained for words" in page
    assert page.count("xfeat: absent.pt: no such file") == 2  # once in each section

    records = (tmp_path / "work" / "attacks" / FILE).read_bytes()
    measure_features.write_results(tmp_path / "work", sources, "gallery")
    assert (tmp_path / "features.md").read_text(encoding="utf-8") == page
    assert (tmp_path / "work" / "attacks" / FILE).read_bytes() == records  # nothing was computed again


def test_each_defense_uses_the_words_of_the_features() -> None:
    assert read_defense("none", "shipped-xfeat") == Undefended()
    assert read_defense("ldp:epsilon=12", "shipped-xfeat") == LDP(epsilon=12.0, dictionary="shipped-xfeat")
    assert read_defense("affine", "shipped-xfeat") == Affine(database="shipped-xfeat")
    assert read_defense("affine", "") == Affine()


def test_the_page_of_the_repository_is_that_of_the_tool() -> None:
    page = (result_page.RESULTS / "features.md").read_text(encoding="utf-8")
    assert page.startswith(TITLE.format(count=6, low=LIMITS[0], high=LIMITS[1]))
    rows = [line.split(" | ") for line in page.partition("## Localization")[0].splitlines() if line.startswith("| `")]
    expected = {
        (f"| `{features}`", f"`{defense}`", f"`{attack}`")
        for features in EXTRACTORS
        for defense in DEFENSES
        for attack in list_attacks(defense)
    }
    assert {(row[0], row[2], row[4]) for row in rows} == expected


def test_each_defense_has_the_attacks_on_its_kind_of_release() -> None:
    assert list_attacks("affine:dim=4") == ["dia", "database", "keypoints", "blank"]
    assert list_attacks("none") == list_attacks("ldp") == ["dia", "keypoints", "blank"]


def test_reasons() -> None:
    def fail() -> list[dict[str, str]]:
        raise UserError("absent.pt: no such file")

    records = [{"status": "ok", "reason": None}, {"status": "failed", "reason": "no keypoint"}]
    assert build_row("sift", "none", records, "").reason == "no keypoint"
    assert build_row("sift", "none", records[:1], "").records == records[:1]
    rows = [build_row("xfeat", "none", *measure(fail), attack=attack) for attack in ("dia", "blank")]
    text = "`xfeat` with `none` under `dia`, `xfeat` with `none` under `blank`: absent.pt: no such file"
    assert list_reasons(rows) == ["n/a:", "", f"- {text}"]
    assert list_reasons([build_row("sift", "none", records[:1], "")]) == []
