"""Metrics of optional extras and programs: `bench run` and suites compute them, other plans need not know what is installed."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from fake_plugins.sketch import Sketch
from fakes import FAKES, install_plugins, write_album

from bench import cli
from bench.core import environment
from bench.core.errors import UserError
from bench.identification import words
from bench.registry import discovery
from bench.runner import plan, records, suite
from bench.runner.plan import build_plan, list_extra_metrics
from defenses.none import Undefended
from leaderboard import comparison, recipe, regression, submission
from metrics.reads import Reads

EXTRAS = ("identity", "identity-distance", "perceptual")
COMMAND = ["run", "--defense", "none", "--attack", "sketch", "--images", "album"]


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Choose the extras as a user's installation does that lacks the program of `reads`."""
    monkeypatch.setattr(words, "find_model", lambda: None)
    for name in EXTRAS:
        metric = discovery.load_plugin(discovery.METRIC, name)
        for package in metric.packages:
            if not environment.is_installed(package):
                pytest.skip(f"{name} needs {package} (pip install -e '.[identity,perceptual]')")
    monkeypatch.delenv(plan.VARIABLE)


def test_metrics_of_installed_extras(installed: None, monkeypatch: pytest.MonkeyPatch) -> None:
    assert tuple(metric.name() for metric in list_extra_metrics()) == EXTRAS
    monkeypatch.setenv(plan.VARIABLE, "none")
    assert list_extra_metrics() == ()
    monkeypatch.setenv(plan.VARIABLE, "perceptual")
    with pytest.raises(UserError, match="FEATURE_PRIVACY_EXTRA_METRICS=perceptual: must be none, or not set"):
        list_extra_metrics()


def test_an_extra_that_lacks_a_package_is_left_out(installed: None, monkeypatch: pytest.MonkeyPatch) -> None:
    is_installed = environment.is_installed
    monkeypatch.setattr(environment, "is_installed", lambda name: name != "dlib-bin" and is_installed(name))
    assert [metric.name() for metric in list_extra_metrics()] == ["perceptual"]


def test_a_metric_whose_program_is_installed(installed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tmp_path / words.MODEL
    model.touch()
    monkeypatch.setattr(words, "find_model", lambda: model)
    assert tuple(metric.name() for metric in list_extra_metrics()) == (*EXTRAS, "reads")


@pytest.mark.slow
def test_a_suite_chooses_them_and_another_plan_does_not(installed: None, monkeypatch: pytest.MonkeyPatch, images: Path) -> None:
    (part,) = suite.grid(defenses=[Undefended()], attacks=[Sketch()], images=images)
    assert tuple(metric.name() for metric in part.metrics) == EXTRAS
    plain = dataclasses.replace(part, metrics=())
    identifier = build_plan(plain).hash
    assert build_plan(part).hash != identifier
    assert set(EXTRAS).isdisjoint(build_plan(plain).experiments[0].metadata["metric_settings"])
    monkeypatch.setenv(plan.VARIABLE, "none")
    assert build_plan(plain).hash == identifier
    monkeypatch.setattr(environment, "is_installed", lambda name: False)
    assert build_plan(plain).hash == identifier


@pytest.fixture
def album(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    install_plugins(tmp_path / "installed", monkeypatch, FAKES)
    monkeypatch.chdir(tmp_path)
    return write_album(tmp_path / "album", 1)


def run(capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, Any]:
    assert cli.main([*COMMAND, "--json", *more]) == 0
    return dict(json.loads(capsys.readouterr().out))


@pytest.mark.slow
def test_records_with_extras(
    installed: None, album: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All other values are those of a run without extras. The records pass the check of submissions, and have a recipe."""
    record = run(capsys, "--out", "with")
    assert record["metrics"]["perceptual"] > 0
    assert record["metric_settings"]["perceptual"]["weights"].startswith("sha256:")
    assert {"identity", "identity-distance"} <= record["metrics"].keys()
    monkeypatch.setenv(plan.VARIABLE, "none")
    plain = run(capsys, "--out", "without")
    assert plain["metrics"] == {name: value for name, value in record["metrics"].items() if name not in EXTRAS}
    assert submission.check(Path("with") / records.FILE, images=album, sample=1) == (1, [])
    assert {one.verdict for one in regression.compare([plain], [record])} == {"same"}
    (group,) = comparison.build_groups(comparison.load_records(Path("with")))
    command = recipe.build_recipe(group.experiments[0]).command
    assert "--metric identity --metric identity-distance --metric perceptual" in command
    given = command.split()[command.split().index("--metric") : command.split().index("--seed")]
    assert run(capsys, "--out", "again", *given)["experiment_id"] == record["experiment_id"]


@pytest.mark.slow
def test_records_of_words(album: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The records can be checked where the program is, and the check says why it fails where it is not."""
    if not Reads.is_installed():
        pytest.skip("reads needs the program tesseract 5 (apt install tesseract-ocr)")
    record = run(capsys, "--metric", "reads", "--out", "read")
    assert record["metrics"]["reads"] is None
    assert "reads: words in the photograph: 0" in record["notes"]
    assert record["metric_settings"]["reads"]["model"].startswith("sha256:")
    assert submission.check(Path("read") / records.FILE, images=album, sample=1) == (1, [])
    monkeypatch.setattr(words, "find_model", lambda: None)
    _, (fault,) = submission.check(Path("read") / records.FILE, images=album, sample=1)
    assert "Tesseract 5 with eng.traineddata is not on the PATH" in fault.message


@pytest.mark.slow
def test_control_a_changed_value_is_found(installed: None, album: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = run(capsys, "--out", "with")
    record["metrics"]["perceptual"] *= 2
    Path("changed.jsonl").write_text(json.dumps(records.seal(record)) + "\n", encoding="utf-8")
    _, faults = submission.check(Path("changed.jsonl"), images=album, sample=1)
    assert any("metrics.perceptual" in fault.message for fault in faults)
