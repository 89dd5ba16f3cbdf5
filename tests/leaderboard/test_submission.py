"""The check of submitted records: each false value is reported with its line, and honest records pass."""

import copy
import dataclasses
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_plugins.guess import Guess
from fake_plugins.peeker import Peeker
from fakes import install_plugins, write_album, write_scene

import bench
from bench import cli
from bench.api import View
from bench.codebook.examples import write_dictionary
from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.localization.scene_index import SceneIndex
from bench.localization.server import Server
from bench.runner import records
from bench.runner.attack_process import execute_in_attack_process
from bench.tasks.reconstruction import Reconstruction
from bench.threat_model import DefenseDatabase, Knowledge, OtherReleases, PublicDatabase, ServerMap
from bench.types import Points, Subspaces
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended
from leaderboard import submission
from leaderboard.submission import Fault

Lines = list[dict[str, Any]]
PLUGINS = {"feature_privacy.attacks": {name: f"fake_plugins.{name}:PLUGIN" for name in ("sketch", "guess", "peeker")}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Photographs, a dictionary, and the fake plugins installed."""
    path = tmp_path_factory.mktemp("submission")
    write_album(path / "album", 2)
    with pytest.MonkeyPatch.context() as monkeypatch:
        install_plugins(path / "installed", monkeypatch, PLUGINS)
        yield path


@pytest.fixture(scope="module")
def honest(folder: Path) -> Lines:
    """Two records of a pair that applies, and one of a pair that does not."""
    return sorted(run(folder, Guess(), Undefended()), key=lambda record: record["status"], reverse=True)


def run(folder: Path, attack: Any, *more: Any) -> Lines:
    ldp = LDP(epsilon=8.0, dictionary=write_dictionary(folder))
    return bench.run([ldp, *more], [attack], folder / "album", task=Reconstruction(inverter="sketch"))


@pytest.fixture
def faults(folder: Path, tmp_path: Path) -> Callable[..., list[Fault]]:
    def check(lines: Lines | str, sample: int = 0) -> list[Fault]:
        path = tmp_path / "records.jsonl"
        path.write_text(lines if isinstance(lines, str) else "".join(json.dumps(records.seal(line)) + "\n" for line in lines))
        (dictionary,) = folder.glob("dictionary-*.safetensors")
        return submission.check(path, images=folder / "album", files=[dictionary], sample=sample)[1]

    return check


@pytest.mark.slow
def test_honest_records_pass_and_are_reproduced(faults: Callable[..., list[Fault]], honest: Lines) -> None:
    assert [record["status"] for record in honest] == ["ok", "ok", "n/a"]
    assert faults(honest, sample=1) == []


@pytest.mark.slow
def test_an_attack_that_reads_the_secret_is_found(faults: Callable[..., list[Fault]], folder: Path) -> None:
    """All numbers of its records are those of `bench run`. Only a separate process reveals the difference."""
    cheating = run(folder, Peeker())
    assert all(record["metrics"]["recovered"] == 1 for record in cheating)
    assert faults(cheating) == []
    reported = faults(cheating, sample=2)
    assert {fault.line for fault in reported} == {1, 2}
    assert any(fault.message.startswith("metrics.recovered: is 1, but 0.") for fault in reported)


@pytest.mark.slow
def test_a_changed_number_is_found(faults: Callable[..., list[Fault]], honest: Lines) -> None:
    lied = copy.deepcopy(honest[:2])
    lied[1]["metrics"]["recovered"] *= 0.5
    assert [fault.line for fault in faults(lied, sample=2)] == [2]


def change(*path: str, to: Any) -> Callable[[dict[str, Any]], None]:
    def changed(record: dict[str, Any]) -> None:
        *above, last = path
        for part in above:
            record = record[part]
        record[last] = to

    return changed


def update_hashes(record: dict[str, Any]) -> None:
    """Set the hashes to those of the changed record."""
    task = {"name": record["task"], **record["task_settings"]}
    parts = (task, record["defense"], record["attack"], record["dataset"], record["seed"], record["metric_settings"])
    record["experiment_id"] = records.experiment_id(*parts)
    record["run_hash"] = records.run_hash(record["experiment_id"], record["environment"])


@pytest.mark.parametrize(
    ("lie", "complaint"),
    [
        (lambda record: record.pop("seed"), "the record: 'seed' is a required property"),
        (change("more", to=1), "the record: Additional properties are not allowed"),
        (change("seconds", to="1"), "seconds: '1' is not of type 'number'"),
        (change("metrics", "ssim", to=True), "metrics.ssim: True is not of type"),
        (change("sample", to=7), "sample: 7 is not of type 'string'"),
        (change("privacy", "private", to=True), "privacy.private: False was expected"),
        (change("status", to="good"), "status: 'good' is not one of"),
        (change("reason", to="why"), "reason: 'why' is not of type 'null'"),
        (change("defense", "epsilon", to=9.0), "experiment_id: is "),
        (change("environment", "threads", to=99), "run_hash: is "),
        (change("metrics", "ssim", to=1.5), "metrics.ssim: 1.5 is outside the range from -1 to 1"),
        (change("metrics", "keypoints", to=3), "privacy.keypoints: differs from metrics.keypoints"),
        (change("privacy", "epsilon_image", to=1.0), "privacy.epsilon_image: is 1.0, should be "),
        (change("privacy", "guarantee", to="perfect"), "privacy.guarantee: is perfect, should be epsilon-ldp"),
        (change("sample", to="7.png"), "sample: the dataset has no '7.png'"),
    ],
)
def test_false_values_of_one_record(faults: Callable[..., list[Fault]], honest: Lines, lie: Any, complaint: str) -> None:
    lied = copy.deepcopy(honest)
    lie(lied[1])
    messages = [fault.message for fault in faults(lied) if fault.line == 2]
    assert any(message.startswith(complaint) for message in messages), messages


@pytest.mark.parametrize(
    ("lie", "complaint"),
    [
        (change("defense", "name", to="lpd"), "unknown defense 'lpd'; did you mean 'ldp'?"),
        (change("defense", "subset_size", to="many"), "ldp: subset_size must be a whole number"),
        (change("defense", "epsilon", to="1E400000000"), "ldp: epsilon must be a number or a fraction"),
        (change("defense", "dictionary", to="sha256:" + "0" * 64), "defense.dictionary is sha256:000"),
        (change("dataset", "hash", to="sha256:" + "0" * 64), "dataset.hash is sha256:000"),
        (change("metric_settings", "ssim", to={}), "metric_settings.ssim is {}"),
    ],
)
def test_false_values_of_an_experiment_with_matching_hashes(
    faults: Callable[..., list[Fault]], honest: Lines, lie: Any, complaint: str
) -> None:
    lied = copy.deepcopy(honest[:2])
    for record in lied:
        lie(record)
        update_hashes(record)
    (fault,) = faults(lied)
    assert fault.line == 1
    assert complaint in fault.message


def test_pairs_that_do_not_apply_and_pairs_that_do(faults: Callable[..., list[Fault]], honest: Lines) -> None:
    silent = [record | {"status": "n/a", "reason": "no", "metrics": {}, "seconds": None} for record in honest[:2]]
    assert any("applies, but the record says n/a" in fault.message for fault in faults(silent))
    bold = honest[0] | {name: honest[2][name] for name in ("defense", "attack", "experiment_id", "run_hash")}
    assert any("does not apply (guess attacks" in fault.message for fault in faults([bold]))


@pytest.mark.slow
def test_missing_and_repeated_samples(faults: Callable[..., list[Fault]], honest: Lines) -> None:
    assert faults(honest[:1]) == [Fault(1, "its experiment lacks 1 of 2 samples, such as '1.png'")]
    assert faults([*honest[:2], honest[0]]) == [Fault(3, "repeats the sample and experiment of line 1")]
    failed = honest[0] | {"status": "failed", "reason": "tired", "metrics": {}, "seconds": None}
    assert faults([failed, *honest[:2]]) == []


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "not valid JSON"),
        ('{"seconds": NaN}', "NaN is not a number"),
        ("[]", "the record: [] is not of type 'object'"),
        ("", "there is no"),
    ],
)
def test_lines_that_are_not_records(faults: Callable[..., list[Fault]], text: str, complaint: str) -> None:
    assert complaint in faults(text)[0].message


def test_numbers_too_large_for_a_double(faults: Callable[..., list[Fault]], honest: Lines) -> None:
    text = json.dumps(honest[0] | {"seconds": 0.125}).replace('"seconds": 0.125', '"seconds": 1e999')
    assert Fault(1, "seconds: not finite") in faults(text)


@pytest.mark.slow
def test_command(honest: Lines, folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "records.jsonl"
    path.write_text(json.dumps(honest[0] | {"sample": "\x1b[31m\n::error::"}) + "\n")
    (dictionary,) = map(str, folder.glob("dictionary-*.safetensors"))
    beside = ["--images", str(folder / "album"), "--file", dictionary, "--sample", "0"]
    assert cli.main(["submit-check", str(path), *beside]) == 1
    output, messages = capfd.readouterr()
    assert all(line.startswith("line 1: ") for line in output.splitlines())
    assert "\x1b" not in output
    assert re.search(r"bench: \d+ faults in 1 record$", messages, re.MULTILINE)
    path.write_text("".join(json.dumps(records.seal(record)) + "\n" for record in honest))
    assert cli.main(["submit-check", str(path), *beside]) == 0
    assert "bench: no fault in 3 records, of which" in capfd.readouterr().err
    changed = [records.seal(honest[0]), *honest[1:]]
    changed[2] = changed[2] | {"reason": "no"}  # without its digest
    path.write_text("".join(json.dumps(record) + "\n" for record in changed))
    assert cli.main(["submit-check", str(path), *beside]) == 1
    assert "bench: 1 fault in 3 records\n" in capfd.readouterr().err
    assert cli.main(["submit-check", str(tmp_path / "absent")]) == 2
    assert cli.main(["submit-check", str(path), "--file", str(path)]) == 2


# ---- the attack process


def build_view(needs: frozenset[type[Knowledge]]) -> View:
    """Return a view of a release with other releases and a database."""
    known = {
        OtherReleases: lambda: OtherReleases(draw=lambda count: iter([build_release(seed) for seed in range(count)])),
        PublicDatabase: lambda: PublicDatabase(words=np.zeros((3, 128), np.uint8)),
    }
    return View(release=build_release(0), defense=Affine(), extractor=Sift(), knowledge={what: known[what] for what in needs})


def build_release(seed: int) -> Subspaces:
    rng = np.random.default_rng(seed)
    bases = np.linalg.qr(rng.normal(size=(5, 128, 2)))[0].transpose(0, 2, 1).astype(np.float32)
    return Subspaces(
        positions=Points(keypoints=np.zeros((5, 2), np.float32)),
        size=(9, 9),
        origins=rng.normal(size=(5, 128)).astype(np.float32),
        bases=bases,
    )


def sum_releases(view: View, rng: np.random.Generator) -> np.ndarray:
    """Use all knowledge of the view, and note the refused classes."""
    others = list(view.know(OtherReleases).draw(3))
    view.notes.append(f"{len(view.know(PublicDatabase).words)} words")
    try:
        view.know(DefenseDatabase)
    except PermissionError as error:
        view.notes.append(str(error))
    return np.asarray(sum(other.origins for other in others) + rng.normal(size=(5, 128)), np.float32)


def fail(view: View, rng: np.random.Generator) -> np.ndarray:
    raise ArithmeticError("lost count")


@pytest.mark.slow
def test_the_attack_process_gives_the_same_result() -> None:
    needs = frozenset({OtherReleases, PublicDatabase})
    local, remote = build_view(needs), build_view(needs)
    one, other = np.random.default_rng(3), np.random.default_rng(3)
    assert np.array_equal(execute_in_attack_process(sum_releases, remote, other), sum_releases(local, one))
    assert local.notes == remote.notes == ["3 words", "this attack did not declare DefenseDatabase in its `needs`"]
    assert one.random() == other.random()


def camera_and_references(view: View, rng: np.random.Generator) -> np.ndarray:
    served = view.know(ServerMap).server
    assert not served.scene_index.scene.queries
    names = [reference.name for reference in served.scene_index.scene.references]
    return np.array([served.camera.params[0], len(names), names[0].count("/")], np.float32)


@pytest.mark.slow
def test_the_map_comes_without_the_queries(tmp_path: Path) -> None:
    """One of the queries is the secret."""
    whole = write_scene(tmp_path)
    public = Public(scene_index=SceneIndex(whole, Sift()))
    view = build_view(frozenset())
    served = Server(public=public, camera=whole.queries[0].camera)
    view = dataclasses.replace(view, knowledge={ServerMap: lambda: ServerMap(server=served)})
    result = execute_in_attack_process(camera_and_references, view, np.random.default_rng(0))
    assert result.tolist() == [np.float32(75.1), len(whole.references), 1]


@pytest.mark.slow
def test_errors_of_the_attack_process_are_raised() -> None:
    with pytest.raises(RuntimeError, match="lost count"):
        execute_in_attack_process(fail, build_view(frozenset()), np.random.default_rng(0))
