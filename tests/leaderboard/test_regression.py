"""The regression check: a weakened attack and a broken defense must fail it, and chance must not."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_plugins.guess import Guess
from fakes import FAKES, install_plugins, write_album
from scipy import stats

import bench
from bench import cli
from bench.api import View
from bench.codebook.examples import write_dictionary
from bench.geometry.nearest_words import unit_rows
from bench.runner.records import seal
from bench.tasks.reconstruction import Reconstruction
from bench.types import Features, WordSets
from defenses.ldp import LDP
from leaderboard import regression_report, speed
from leaderboard.regression import RegressionResult, compare, compute_tolerance

Records = list[dict[str, Any]]
SEEDS = range(2)
RECONSTRUCTION = Reconstruction(inverter="sketch")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder of photographs, with the fake plugins installed."""
    folder = tmp_path_factory.mktemp("regression")
    write_album(folder / "album", 3)
    with pytest.MonkeyPatch.context() as monkeypatch:
        install_plugins(folder / "installed", monkeypatch, FAKES)
        yield folder


@pytest.fixture(scope="module")
def before(folder: Path) -> Records:
    return measure(folder, SEEDS)


def measure(folder: Path, seeds: range, epsilon: float = 8.0) -> Records:
    """Return records of an attack that takes the first word. At this ε about every second set contains the true word."""
    defense = LDP(epsilon=epsilon, dictionary=write_dictionary(folder))
    return [
        record for seed in seeds for record in bench.run([defense], [Guess()], folder / "album", task=RECONSTRUCTION, seed=seed)
    ]


def verdicts(results: list[RegressionResult]) -> dict[str, str]:
    return {result.metric: result.verdict for result in results}


# ---- results that must pass, and results that must fail


@pytest.mark.slow
def test_equal_results_have_the_verdict_same(folder: Path, before: Records) -> None:
    results = compare(before, copy.deepcopy(before))
    assert {result.verdict for result in results} == {"same"}
    assert {"angle", "l2", "recovered"} <= set(verdicts(results))


@pytest.mark.slow
def test_other_seeds_are_within_the_tolerance(folder: Path, before: Records) -> None:
    """They differ, so the tolerance has an effect."""
    results = compare(before, measure(folder, range(2, 4)))
    assert {result.verdict for result in results} == {"same"}
    assert any(result.before != result.after for result in results)


@pytest.mark.slow
def test_a_weakened_attack_fails(folder: Path, before: Records, monkeypatch: pytest.MonkeyPatch) -> None:

    def blunt(self: Guess, view: View, rng: np.random.Generator) -> np.ndarray:
        assert isinstance(view.release, WordSets)
        return unit_rows(rng.normal(size=view.release.candidates[:, 0].shape).astype(np.float32))

    monkeypatch.setattr(Guess, "recover", blunt)
    results = verdicts(compare(before, measure(folder, SEEDS)))
    assert results["recovered"] == results["angle"] == "weaker"
    assert "better" not in results.values()


@pytest.mark.slow
def test_a_broken_defense_fails(folder: Path, before: Records, monkeypatch: pytest.MonkeyPatch) -> None:
    """The defense always releases the true word first."""
    protect = LDP.protect

    def telling(self: LDP, secret: Features, public: Any, rng: np.random.Generator) -> WordSets:
        release = protect(self, secret, public, rng)
        release.candidates[:, 0] = secret.descriptors
        return release

    monkeypatch.setattr(LDP, "protect", telling)
    results = verdicts(compare(before, measure(folder, SEEDS)))
    assert results["recovered"] == results["angle"] == "worse"


@pytest.mark.slow
def test_a_defense_with_changed_source_may_get_better(folder: Path, before: Records, monkeypatch: pytest.MonkeyPatch) -> None:
    protect = LDP.protect

    def silent(self: LDP, secret: Features, public: Any, rng: np.random.Generator) -> WordSets:
        release = protect(self, secret, public, rng)
        release.candidates[:] = unit_rows(rng.normal(size=release.candidates[:, 0].shape).astype(np.float32))[:, None]
        return release

    monkeypatch.setattr(LDP, "protect", silent)
    after = measure(folder, SEEDS)
    assert verdicts(compare(before, after))["recovered"] == "weaker"
    for record in after:
        record["sources"]["defense"] = "sha256:another"
    assert verdicts(compare(before, after))["recovered"] == "better"


@pytest.mark.slow
def test_a_weaker_guarantee_is_worse_without_tolerance(folder: Path, before: Records) -> None:
    after = copy.deepcopy(before)
    for record in after:
        record["privacy"] |= {"epsilon_descriptor": 8.5}
    assert verdicts(compare(before, after))["epsilon_descriptor"] == "worse"
    assert verdicts(compare(after, before))["epsilon_descriptor"] == "better"
    for record in after:
        record["privacy"] |= {"guarantee": "none", "epsilon_descriptor": None}
    assert verdicts(compare(before, after))["epsilon_descriptor"] == "worse"


@pytest.mark.slow
def test_lost_samples_failures_and_experiments(folder: Path, before: Records) -> None:
    broken = [
        record | {"status": "failed", "reason": "out of paper"} if record["sample"] == "1.png" else record for record in before
    ]
    (lost,) = [result for result in compare(before, broken) if result.verdict == "missing"]
    assert lost.note == "1 of 3 samples: 1.png: out of paper"
    other = measure(folder, range(1), epsilon=9.0)
    assert [result.verdict for result in compare(before, other)] == ["missing", "new"]


def test_a_new_metric_keeps_the_experiment_and_other_settings_cannot_be_compared(before: Records) -> None:
    after = copy.deepcopy(before)
    for record in after:
        record["metric_settings"] |= {"more": {}, "ssim": {"sigma": 2.0}}
    results = verdicts(compare(before, after))
    assert results["ssim"] == "missing"
    assert results["recovered"] == "same"


def test_utility_has_its_own_direction() -> None:
    """A greater recall of localization is better. No attack takes part."""

    def judged(recall: float) -> Records:
        head = {
            "experiment_id": "0",
            "schema": 1,
            "task": "localization",
            "defense": {"name": "none"},
            "attack": None,
            "dataset": {},
        }
        head |= {"status": "ok", "privacy": {"guarantee": "none", "epsilon_descriptor": None}}
        return [head | {"sample": str(sample), "metrics": {"recall_0.25m_2deg": recall}} for sample in range(5)]

    assert verdicts(compare(judged(0.9), judged(0.5))) == {"recall_0.25m_2deg": "worse"}
    assert verdicts(compare(judged(0.5), judged(0.9))) == {"recall_0.25m_2deg": "better"}


# ---- tolerances, against an independent reference


def draw_values(rng: np.random.Generator, samples: int, seeds: int, spread: float) -> dict[str, list[float]]:
    heights = np.linspace(0, 50, samples)
    return {str(sample): (heights[sample] + rng.normal(0, spread, seeds)).tolist() for sample in range(samples)}


def test_tolerance_of_one_sample_is_that_of_students_test(rng: np.random.Generator) -> None:
    before, after = draw_values(rng, 1, 5, 2.0), draw_values(rng, 1, 4, 2.0)
    reference = stats.ttest_ind(after["0"], before["0"]).confidence_interval(0.999)
    assert compute_tolerance(before, after, 0.0) == pytest.approx((reference.high - reference.low) / 2)


@pytest.mark.slow
def test_false_alarms_are_rare_and_shifts_are_found(rng: np.random.Generator) -> None:
    """Samples differ far more than seeds, which has no effect on the verdict."""

    def apart(shift: float) -> bool:
        before, after = draw_values(rng, 7, 3, 1.0), draw_values(rng, 7, 3, 1.0)
        gap = np.mean([np.mean(after[sample]) + shift - np.mean(before[sample]) for sample in before])
        return bool(abs(gap) > compute_tolerance(before, after, 0.0))

    assert sum(apart(0.0) for _ in range(2000)) <= 10  # two are expected
    assert sum(apart(3.0) for _ in range(200)) >= 198


def test_tolerance_with_one_seed_is_students_and_with_one_sample_the_minimum() -> None:
    before = {str(sample): [0.0] for sample in range(7)}
    steady = {str(sample): [0.1 + sample / 1000] for sample in range(7)}
    mixed = {str(sample): [0.3 * (-1) ** sample] for sample in range(7)}
    assert compute_tolerance(before, steady, 0.01) == 0.01  # all samples moved alike
    assert compute_tolerance(before, mixed, 0.01) > 0.2
    assert compute_tolerance({"0": [0.0]}, {"0": [5.0]}, 0.01) == 0.01


# ---- the command


@pytest.fixture
def folders(before: Records, tmp_path: Path) -> tuple[Path, Path]:
    worse = [seal(record | {"metrics": record["metrics"] | {"recovered": 1.0}}) for record in before]
    for name, held in (("before", before), ("after", worse)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "records.jsonl").write_text("".join(json.dumps(record) + "\n" for record in held))
    return tmp_path / "before" / "records.jsonl", tmp_path / "after"


def test_command_shows_the_verdict_and_exits_with_3(folders: tuple[Path, Path], capfd: pytest.CaptureFixture[str]) -> None:
    baseline, results = map(str, folders)
    assert cli.main(["check", "--baseline", baseline, "--results", baseline]) == 0
    shown = capfd.readouterr().out
    assert "same" in shown
    assert "worse" not in shown
    assert cli.main(["check", "--baseline", baseline, "--results", results]) == 3
    shown = capfd.readouterr().out
    assert "worse" in shown
    assert "recovered" in shown
    Path(results, "records.jsonl").write_text("")
    assert cli.main(["check", "--baseline", baseline, "--results", results]) == 1
    assert "1 missing" in capfd.readouterr().out


def test_annotations_are_escaped(folders: tuple[Path, Path], capfd: pytest.CaptureFixture[str]) -> None:
    baseline, results = map(str, folders)
    assert cli.main(["check", "--baseline", baseline, "--results", results, "--format", "github"]) == 3
    (line, _) = capfd.readouterr().out.splitlines()
    assert line.startswith("::error title=worse%3A ldp%3Aepsilon=8%2Csubset_size=2%2Cwords=0 against guess::recovered was 0.")
    nasty = RegressionResult(verdict="missing", defense="a::b,100%\r\n::error::", attack="c", note="50%\r\n::stop-commands::x")
    written = regression_report.to_github(nasty)
    assert written == (
        "::warning title=missing%3A a%3A%3Ab%2C100%25%0D%0A%3A%3Aerror%3A%3A against c::50%25%0D%0A::stop-commands::x"
    )


# ---- speed, as ratios


def timed(path: Path, **minutes: float) -> Path:
    names = {"bare": "test_speed_of_the_bare_product[float32]", "search": "test_speed_of_the_search"}
    rows = [{"group": "nearest word", "name": names[name], "stats": {"min": time}} for name, time in minutes.items()]
    alone = {"group": None, "name": "test_alone", "stats": {"min": 1.0}}
    path.write_text(json.dumps({"machine_info": {"instruction_set": "A"}, "benchmarks": [*rows, alone]}))
    return path


def test_speed_is_compared_as_ratios(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    good = speed.compute_ratios(timed(tmp_path / "good.json", bare=1.0, search=1.5))
    assert good == {"nearest word: test_speed_of_the_search": 1.5}
    baseline = tmp_path / "speed.json"
    baseline.write_text(json.dumps({"A": good, "B": {name: ratio / 9 for name, ratio in good.items()}}))
    slow_machine = timed(tmp_path / "slow.json", bare=10.0, search=16.0)
    slow_code = timed(tmp_path / "worse.json", bare=1.0, search=3.2)
    assert cli.main(["check", "--baseline", str(baseline), "--results", str(slow_machine)]) == 0
    assert cli.main(["check", "--baseline", str(baseline), "--results", str(slow_code)]) == 3
    assert "nearest word" in capfd.readouterr().out


def test_ratios_of_an_unknown_instruction_set_are_reported(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    results, baseline = timed(tmp_path / "slow.json", bare=1.0, search=99.0), tmp_path / "speed.json"
    baseline.write_text(json.dumps({"B": {"nearest word: test_speed_of_the_search": 1.5}}))
    assert cli.main(["check", "--baseline", str(baseline), "--results", str(results)]) == 0
    out, err = capfd.readouterr()
    assert "new" in out
    assert "99" in out
    assert "no ratios for the instruction set A, only for: B" in err


@pytest.mark.parametrize("content", ["[]", "{", '{"a": "b"}', '{"a": {"b": "c"}}'])
def test_wrong_files_of_speed_are_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str], content: str) -> None:
    (tmp_path / "speed.json").write_text(content)
    assert cli.main(["check", "--baseline", str(tmp_path / "speed.json"), "--results", str(tmp_path / "absent.json")]) == 2
    assert capfd.readouterr().err.count("\n") == 1
