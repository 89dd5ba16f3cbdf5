"""The runner: determinism, resumption, and recovery from errors."""

import copy
import gc
import json
import os
import re
import shutil
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_plugins.broken import Broken
from fake_plugins.glimpse import Glimpse
from fake_plugins.guess import Guess
from fake_plugins.sketch import Sketch
from fakes import FAKES, install_plugins, prepare_plan
from PIL import Image

from attacks.repeat import Repeat
from bench.api import Attack, Defense, View
from bench.cache import store
from bench.codebook.examples import write_dictionary
from bench.core.errors import UserError
from bench.datasets.gallery import Gallery
from bench.mechanisms import composition
from bench.runner import directory, engines, execute
from bench.runner.records import FILE, Record, seal
from bench.runner.trial import TrialRunner
from bench.settings import Asset
from bench.task_api import Task
from bench.tasks.reconstruction import Reconstruction
from bench.threat_model import DefenseDatabase, PublicDatabase, ServerMap
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended
from leaderboard import run_report

RECONSTRUCTION = Reconstruction(inverter="sketch")


@pytest.fixture(autouse=True)
def _fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path / "installed", monkeypatch, FAKES)


def run(defenses: list[Defense], attacks: list[Attack], images: Any, task: Task = RECONSTRUCTION, **more: Any) -> list[Record]:
    return execute.run(defenses, attacks, images, task=task, **more)


def written(out: Path) -> list[Record]:
    return [json.loads(line) for line in (out / FILE).read_text().splitlines()]


def judged(records: list[Record]) -> list[Any]:
    """Return the records without their duration, and without the digest, which covers it."""
    return [{key: value for key, value in record.items() if key not in ("seconds", "digest")} for record in records]


@pytest.mark.slow
def test_record_has_what_the_schema_says(images: Path, small: Asset) -> None:
    first, second = run([LDP(epsilon=8, dictionary=small)], [Sketch()], images)
    assert (first["sample"], second["sample"]) == ("0.png", "1.png")
    assert first["schema"] == 2
    assert first["status"] == "ok"
    assert first["reason"] is None
    assert first["task"] == "reconstruction"
    assert first["defense"]["epsilon"] == 8.0
    assert first["defense"]["dictionary"].startswith("sha256:")
    assert first["attack"] == {"name": "sketch", "brightness": 1.0}
    assert first["dataset"]["name"] == "album"
    assert first["dataset"]["extractor"]["upright"] is True
    assert first["metric_settings"]["ssim"]["sigma"] == 1.5
    count = first["metrics"]["keypoints"]
    assert count > 0
    assert first["metrics"]["angle"] is None  # the attack recovered no descriptors
    assert 0 < first["metrics"]["mae"] < 1
    privacy = first["privacy"]
    assert (privacy["guarantee"], privacy["epsilon_descriptor"], privacy["keypoints"], privacy["releases"]) == (
        "epsilon-ldp",
        8.0,
        count,
        1,
    )
    assert privacy["epsilon_image"] == count * 8.0
    assert privacy["epsilon_image_optimal"] == composition.compose_optimal(8.0, count, privacy["delta"]) < count * 8.0
    assert privacy["uncovered"] == ["the keypoints' positions", "the number of keypoints"]
    assert (privacy["seeded"], privacy["private"]) == (True, False)
    assert privacy["log10_true"] < 0
    assert first["seconds"] > 0
    assert first["environment"]["source"].startswith("sha256:")
    json.dumps(first, allow_nan=False)


@pytest.mark.slow
def test_recovered_descriptors_are_scored_and_reconstructed(images: Path, small: Asset) -> None:
    record = run([LDP(dictionary=small)], [Guess()], images)[0]
    assert record["metrics"]["angle"] > 0
    assert record["metrics"]["ssim"] is not None
    assert record["attack"] == {"name": "guess", "inversion": {"name": "sketch", "brightness": 1.0}}


def test_descriptors_are_scored_where_no_network_reconstructs_them(images: Path, small: Asset) -> None:
    from bench.extractors.sift import Sift

    few = Sift(max_keypoints=77)  # no network for it is shipped
    record = run([LDP(dictionary=small)], [Guess()], images, Reconstruction(), extractor=few)[0]
    assert record["status"] == "ok"
    assert record["metrics"]["angle"] > 0
    assert record["metrics"]["ssim"] is None
    assert record["notes"][0].startswith("no image: ")


@pytest.mark.slow
def test_same_seed_gives_the_same_metrics_and_another_seed_others(images: Path, small: Asset) -> None:
    grid = ([LDP(dictionary=small), Affine(lifting="random")], [Sketch(), Guess()], images)
    assert judged(run(*grid)) == judged(run(*grid))
    assert run(*grid)[0]["metrics"] != run(*grid, seed=1)[0]["metrics"]


@pytest.mark.slow
def test_release_depends_on_neither_the_attack_nor_the_order_nor_other_samples(images: Path, small: Asset) -> None:
    def of(records: list[Record]) -> dict[tuple[str, str, str], Any]:
        return {(r["defense"]["name"], r["attack"]["name"], r["sample"]): (r["experiment_id"] and r["metrics"]) for r in records}

    ldp, affine = LDP(dictionary=small), Affine(lifting="random")
    whole = of(run([ldp, affine], [Sketch(), Guess()], images))
    assert whole == of(run([affine, ldp], [Guess(), Sketch()], images))
    alone = run([affine], [Guess()], [images / "1.png"])
    assert [record["metrics"] for record in alone] == [whole["affine", "guess", "1.png"]]


def test_releases_are_freed_after_their_last_use(images: Path, small: Asset) -> None:
    plan = prepare_plan([LDP(dictionary=small)], [Sketch()], images, task=RECONSTRUCTION)
    trials, (experiment,), sample = TrialRunner(plan), plan.experiments, plan.samples[0]
    release = weakref.ref(trials.build_trial(experiment, sample).images[0].release)
    gc.disable()
    try:
        assert release() is not None  # for the next attack on it
        trials.clear()
        assert release() is None
    finally:
        gc.enable()
    assert trials.execute(experiment, sample).record["status"] == "ok"


def test_all_attacks_see_the_same_release(images: Path, small: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[View] = []

    def spoiling(original: Callable[..., Any]) -> Callable[..., Any]:
        def spoil(self: Any, view: View, rng: np.random.Generator) -> Any:
            seen.append(copy.deepcopy(view))
            estimate = original(self, view, rng)
            view.release.keypoints[:] = 0  # a change by one attack does not affect the next
            return estimate

        return spoil

    monkeypatch.setattr(Sketch, "reconstruct", spoiling(Sketch.reconstruct))
    run([LDP(dictionary=small)], [Sketch(), Sketch(brightness=0.5)], [images / "0.png"])
    assert np.array_equal(seen[0].release.keypoints, seen[1].release.keypoints)
    assert np.array_equal(seen[0].release.words, seen[1].release.words)  # type: ignore[attr-defined]


def test_view_holds_declared_knowledge_alone(images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nosy(self: Any, view: View, rng: np.random.Generator) -> Any:
        view.know(PublicDatabase)

    monkeypatch.setattr(Sketch, "reconstruct", nosy)
    record = run([Undefended()], [Sketch()], [images / "0.png"])[0]
    assert record["status"] == "failed"
    assert "did not declare PublicDatabase" in record["reason"]


# ---- pairs that do not apply


@pytest.mark.slow
def test_pair_that_does_not_apply_says_why(images: Path, small: Asset) -> None:
    records = run([Undefended(), LDP(dictionary=small)], [Guess()], images)
    assert [(record["sample"], record["status"]) for record in records] == [("*", "n/a"), ("0.png", "ok"), ("1.png", "ok")]
    assert records[0]["reason"] == "guess attacks WordSets or Subspaces; none releases Descriptors"
    assert records[0]["metrics"] == {}


def test_only_inapplicable_pairs_are_an_error(images: Path, tmp_path: Path) -> None:
    reason = "guess attacks WordSets or Subspaces; none releases Descriptors"
    with pytest.raises(UserError, match=rf"^nothing to run: {reason}; `bench list attacks` shows the attacks that apply"):
        run([Undefended()], [Guess()], images, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_attack_without_its_knowledge_does_not_apply(images: Path, small: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Sketch, "needs", frozenset({ServerMap}))
    with pytest.raises(UserError, match="sketch needs the server's map; there is none"):
        run([LDP(dictionary=small)], [Sketch()], images)
    monkeypatch.setattr(Sketch, "needs", frozenset({DefenseDatabase}))
    with pytest.raises(UserError, match="sketch needs the database W"):
        run([LDP(dictionary=small)], [Sketch()], images)
    assert run([Affine(database=small)], [Sketch()], images)[0]["status"] == "ok"


# ---- errors


def test_unreadable_photograph_is_a_failed_record_and_the_others_are_run(images: Path, tmp_path: Path) -> None:
    (images / "0b.jpg").write_bytes(b"\xff\xd8\xff no photograph")
    Image.new("RGB", (64, 64), "grey").save(images / "flat.png")
    records = run([Undefended()], [Sketch(), Sketch(brightness=0.5)], images)
    assert [record["status"] for record in records] == ["ok", "ok", "failed", "failed", "ok", "ok", "failed", "failed"]
    assert "cannot be read as an image" in records[2]["reason"]
    assert "no keypoint" in records[6]["reason"]
    assert records[2]["privacy"]["epsilon_image"] is None
    assert records[2]["privacy"]["epsilon_image_optimal"] is None


@pytest.mark.slow
def test_odd_names_of_photographs_end_no_run(images: Path, tmp_path: Path) -> None:
    texture = (images / "0.png").read_bytes()
    (images / "x.png.png").mkdir()
    names = ["m" + "x" * 250 + ".png", "nul.png", "x.png", "x.png.png/y.png", os.fsdecode(b"caf\xe9.png")]
    for number, name in enumerate(names):
        (images / name).write_bytes(texture + bytes([number]))  # photographs of one content would share a release
    out = tmp_path / "out"
    records = run([Undefended()], [Sketch()], images, out=out)
    assert [record["status"] for record in records] == ["ok"] * 7
    assert {record["sample"] for record in records} == {*names, "0.png", "1.png"}
    assert all(directory.reconstruction_path(out, record).is_file() for record in records)
    assert all(directory.photograph_path(out, record).is_file() for record in records)
    assert len(list((out / "reconstructions").rglob("*.png"))) == 7 + 1  # the folder x.png.png is not one of them
    run_report.write(records, out, "bench run")
    assert all(directory.figure_path(out, record["sample"]).is_file() for record in records)
    before = (out / FILE).read_bytes()
    assert run([Undefended()], [Sketch()], images, out=out) == records  # it can be resumed
    assert (out / FILE).read_bytes() == before


def test_a_picture_that_cannot_be_written_fails_its_sample_alone(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    whole = run([Undefended()], [Sketch()], images)
    taken = directory.reconstruction_path(out, whole[0])
    taken.mkdir(parents=True)  # a folder in its place
    records = run([Undefended()], [Sketch()], images, out=out)
    assert [record["status"] for record in records] == ["failed", "ok"]
    assert "picture cannot be written" in records[0]["reason"]
    assert records[0]["metrics"] == {}
    assert records[0]["privacy"]["keypoints"] is None
    assert [line["status"] for line in map(json.loads, (out / FILE).read_text().splitlines())] == ["failed", "ok"]
    taken.rmdir()
    assert judged(run([Undefended()], [Sketch()], images, out=out)) == judged(whole)


def test_broken_plugin_fails_its_own_experiments_and_leaves_a_traceback(images: Path, tmp_path: Path) -> None:
    records = run([Broken(), Undefended()], [Sketch()], images, out=tmp_path / "out")
    assert [record["status"] for record in records] == ["failed", "ok", "failed", "ok"]
    assert records[0]["reason"] == "internal error in plugin broken: TypeError: unsupported operand"
    assert "Traceback" in (tmp_path / "out" / "errors.log").read_text()


@pytest.mark.parametrize(
    ("returned", "complaint"),
    [
        (np.zeros((256, 256), np.float32), r"expected float32 \(256, 256, 3\)"),
        (np.zeros((256, 256, 3)), "returned float64"),
        (np.full((256, 256, 3), 2, np.float32), "expected 0 to 1"),
        (np.full((256, 256, 3), np.nan, np.float32), "not finite"),
        (None, "returned NoneType"),
    ],
)
def test_invalid_image_is_detected(images: Path, monkeypatch: pytest.MonkeyPatch, returned: Any, complaint: str) -> None:
    monkeypatch.setattr(Sketch, "reconstruct", lambda self, view, rng: returned)
    record = run([Undefended()], [Sketch()], [images / "0.png"])[0]
    assert record["status"] == "failed"
    assert re.search(complaint, record["reason"])


def test_invalid_configurations_are_refused_before_anything_is_written(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    empty = tmp_path / "empty"
    empty.mkdir()
    tiny = write_dictionary(tmp_path, words=3)
    broken = Path(shutil.copy(write_dictionary(tmp_path), tmp_path / "broken.safetensors"))
    broken.write_bytes(broken.read_bytes()[:-1] + b"\x07")
    mistakes: list[tuple[Callable[[], Any], str]] = [
        (lambda: run([Undefended()], [Sketch()], empty, out=out), "no photograph in it"),
        (lambda: run([Undefended()], [Sketch()], tmp_path / "absent", out=out), "no such folder"),
        (lambda: run([Undefended()], [Sketch()], [], out=out), "no photograph was given"),
        (lambda: run([], [Sketch()], images, out=out), "no defense"),
        (lambda: run([Undefended()], [], images, out=out), "needs an attack"),
        (lambda: run([LDP(subset_size=4, dictionary=tiny)], [Sketch()], images, out=out), "subset_size|words"),
        (lambda: run([LDP(dictionary=Asset(tmp_path / "none"))], [Sketch()], images, out=out), "no such file"),
        (lambda: run([LDP(dictionary=Asset(broken))], [Sketch()], images, out=out), "checksum"),
        (lambda: run([Affine(database=tiny)], [Sketch()], images, out=out), "affine"),
        (lambda: run([Affine(dim=200)], [Sketch()], images, out=out), "dim must be below"),
        (
            lambda: run([Undefended()], [Sketch()], images, Reconstruction(inverter="guess"), out=images / "0.png"),
            "cannot write",
        ),
        (lambda: run([Affine(lifting="random")], [Guess()], images, Reconstruction(inverter="guess"), out=out), "inverter"),
    ]
    for mistake, complaint in mistakes:
        with pytest.raises(UserError, match=complaint):
            mistake()
    assert not out.exists()


def test_lack_of_memory_stops_the_run_instead_of_failing_the_photograph(images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def hungry(self: Any, view: View, rng: np.random.Generator) -> Any:
        raise MemoryError

    monkeypatch.setattr(Sketch, "reconstruct", hungry)
    with pytest.raises(MemoryError):
        run([Undefended()], [Sketch()], images)


# ---- resuming


@pytest.mark.slow
def test_finished_run_is_not_repeated(images: Path, small: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid: Any = ([Undefended(), LDP(dictionary=small)], [Sketch(), Guess()], images)
    first = run(*grid, out=tmp_path / "out")
    before = (tmp_path / "out" / FILE).read_bytes()

    def refuse(self: Any, view: View, rng: np.random.Generator) -> Any:
        raise AssertionError

    monkeypatch.setattr(Sketch, "reconstruct", refuse)
    assert run(*grid, out=tmp_path / "out") == first
    assert (tmp_path / "out" / FILE).read_bytes() == before
    for record in first:
        assert directory.reconstruction_path(tmp_path / "out", record).is_file() == (record["status"] == "ok")


@pytest.mark.slow
def test_interrupted_run_resumes_with_the_same_result(images: Path, small: Asset, tmp_path: Path) -> None:
    grid: Any = ([LDP(dictionary=small)], [Sketch(), Guess()], images)
    whole = run(*grid)
    plan = prepare_plan(*grid, task=RECONSTRUCTION)
    started: Iterator[Record] = execute.execute([plan], tmp_path / "out")
    next(started)
    started.close()  # type: ignore[attr-defined]
    file = tmp_path / "out" / FILE
    file.write_bytes(file.read_bytes() + b'{"schema": 1, "cel')  # and the crash cut off a line
    resumed = run(*grid, out=tmp_path / "out")
    assert judged(resumed) == judged(whole)
    assert len(file.read_bytes().splitlines()) == 4


@pytest.mark.slow
def test_failed_samples_are_tried_again(images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(Sketch, "reconstruct", lambda self, view, rng: None)
        assert {record["status"] for record in run([Undefended()], [Sketch()], images, out=tmp_path / "out")} == {"failed"}
    again = run([Undefended()], [Sketch()], images, out=tmp_path / "out")
    assert {record["status"] for record in again} == {"ok"}
    assert judged(again) == judged(run([Undefended()], [Sketch()], images))


def test_changed_photograph_or_setting_is_another_experiment(images: Path) -> None:
    def experiment(**more: Any) -> str:
        return (
            prepare_plan([Undefended()], [Sketch()], images, task=RECONSTRUCTION, **more).experiments[0].metadata["experiment_id"]
        )

    first = experiment()
    assert experiment() == first
    assert experiment(seed=1) != first
    shutil.copy(images / "0.png", images / "1.png")
    assert experiment() != first


def test_damaged_records_stop_the_run_before_it_starts(images: Path, tmp_path: Path) -> None:
    file = tmp_path / "out" / FILE
    file.parent.mkdir()
    file.write_bytes(b"nonsense\n{}\n")
    with pytest.raises(UserError, match="line 1"):
        run([Undefended()], [Sketch()], images, out=tmp_path / "out")
    assert file.read_bytes() == b"nonsense\n{}\n"


def edit(*path: str, to: Any) -> Callable[[Record], None]:
    def change(record: Record) -> None:
        *above, last = path
        for part in above:
            record = record[part]
        record[last] = to

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (edit("metrics", "ssim", to=8.58), "metrics.ssim: 8.58 is outside the range from -1 to 1"),
        (edit("metrics", "mae_background", to=-0.1), "metrics.mae_background: -0.1 is outside the range from 0 to 1"),
        (edit("metrics", "keypoints", to=1), "privacy.keypoints: differs from metrics.keypoints"),
        (edit("defense", to={"name": "ldp"}), "defense: is {'name': 'ldp'}, planned is {'name': 'none'"),
        (edit("attack", "brightness", to=0.5), "attack: is "),
        (edit("dataset", "hash", to="sha256:0"), "dataset: is "),
        (edit("seed", to=7), "seed: is 7, planned is 0"),
        (edit("task_settings", "inverter", to="dia"), "task_settings: is "),
        (edit("metric_settings", "ssim", to={}), "metric_settings: is "),
        (edit("environment", "threads", to=64), "environment: is "),
        (edit("sources", "defense", to=None), "sources: is "),
        (edit("experiment_id", to="0" * 16), "experiment_id: is 0000000000000000"),
        (edit("condition", to="night"), "condition: is night, planned is None"),
        (edit("privacy", "guarantee", to="perfect"), "privacy.guarantee: is perfect, should be none"),
        (edit("privacy", "epsilon_image", to=1.0), "privacy.epsilon_image: is 1.0, should be None"),
        (lambda record: record.update(status="n/a", reason="no"), "status: the pair applies, but the record says n/a"),
    ],
)
def test_a_held_record_that_contradicts_the_plan_stops_the_run(images: Path, tmp_path: Path, change: Any, complaint: str) -> None:
    file = tmp_path / "out" / FILE
    first = run([Undefended()], [Sketch()], images, out=tmp_path / "out")
    changed = copy.deepcopy(first[1])
    change(changed)
    file.write_text(json.dumps(first[0]) + "\n\n" + json.dumps(seal(changed)) + "\n")  # the digest is right
    before = file.read_bytes()
    with pytest.raises(UserError, match=re.escape(f"{FILE}, line 3: {complaint}")):
        run([Undefended()], [Sketch()], images, out=tmp_path / "out")
    assert file.read_bytes() == before


@pytest.mark.slow
def test_a_run_is_resumed_from_a_folder_of_another_name(images: Path, tmp_path: Path) -> None:
    first = run([Undefended()], [Sketch()], images, out=tmp_path / "out")
    renamed = images.rename(tmp_path / "renamed")
    assert run([Undefended()], [Sketch()], renamed, out=tmp_path / "out") == first


# ---- one device, several releases


@pytest.mark.slow
def test_releases_reveal_more_together_unless_the_defense_is_memoized(images: Path, small: Asset) -> None:
    """At ε = 5 a set of 512 words contains the true word with probability .37. It is then the most frequent word of 12 sets."""

    def of(memoize: bool, releases: int) -> tuple[float, dict[str, Any]]:
        defense = LDP(epsilon=5, dictionary=small, memoize=memoize)
        found = run([defense], [Repeat(releases=releases)], images)
        return float(np.mean([record["metrics"]["l2"] for record in found])), found[0]["privacy"]

    once, spent_once = of(memoize=False, releases=1)
    often, spent_often = of(memoize=False, releases=12)
    assert often < once - 0.1  # the attack gains by repetition
    assert (spent_once["releases"], spent_often["releases"]) == (1, 12)
    assert spent_often["epsilon_image"] == 12 * spent_once["epsilon_image"]
    remembered, spent = of(memoize=True, releases=12)
    assert remembered > often + 0.1  # but not by repeated answers of a memoized defense
    assert (spent["guarantee"], spent["releases"]) == ("epsilon-ldp-by-word", 1)
    assert spent["epsilon_image"] == spent_once["epsilon_image"]
    assert spent["uncovered"][-1] == "which keypoints share a word"


def test_a_memoized_defense_gives_one_answer_in_all_photographs(images: Path, small: Asset) -> None:
    """The runner uses one device for the features of all photographs."""
    seen: dict[int, set[tuple[int, ...]]] = {}

    class Watching(LDP):
        def protect(self, secret: Any, public: Any, rng: np.random.Generator) -> Any:
            release = super().protect(secret, public, rng)
            for word, answer in zip(public.nearest_words(small, secret).tolist(), release.words.tolist(), strict=True):
                seen.setdefault(word, set()).add(tuple(answer))
            return release

    run([Watching(dictionary=small, memoize=True)], [Sketch()], images)
    assert len(seen) > 20
    assert all(len(answers) == 1 for answers in seen.values())
    seen.clear()
    run([Watching(dictionary=small)], [Sketch()], images)
    assert any(len(answers) > 1 for answers in seen.values())  # the control


@pytest.mark.slow
def test_processes_write_the_same_records(images: Path, small: Asset, tmp_path: Path) -> None:
    (images / "bad.jpg").write_bytes(b"no photograph")
    engine = engines.choose_engine(workers=2)
    plan = prepare_plan([LDP(epsilon=8, dictionary=small), Undefended()], [Sketch(), Guess()], images, task=RECONSTRUCTION)
    alone = execute.sort_records([plan], execute.execute([plan], tmp_path / "alone"))
    together: Iterator[Record] = execute.execute([plan], tmp_path / "together", engine)
    next(together)
    next(together)
    together.close()  # interrupted after a record  # type: ignore[attr-defined]
    resumed = list(execute.execute([plan], tmp_path / "together", engine))
    assert judged(execute.sort_records([plan], resumed)) == judged(alone)
    assert sum(record["status"] != "failed" for record in written(tmp_path / "together")) == len(alone) - 3  # none twice
    pictures = {path.relative_to(tmp_path / "alone"): path.read_bytes() for path in (tmp_path / "alone").rglob("*.png")}
    assert pictures == {
        path.relative_to(tmp_path / "together"): path.read_bytes() for path in (tmp_path / "together").rglob("*.png")
    }
    assert {record["status"] for record in alone} == {"ok", "n/a", "failed"}


def test_selected_keypoints_alone_are_scored_and_reconstructed(images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    reconstruct = Sketch.reconstruct
    monkeypatch.setattr(
        Sketch, "reconstruct", lambda self, view, rng: seen.append(len(view.release)) or reconstruct(self, view, rng)
    )
    found = run([Undefended()], [Glimpse()], images)
    assert [record["metrics"]["l2"] for record in found] == [0, 0]
    assert "identified-scene" not in found[0]["metric_settings"], "photographs have no other views"
    assert seen == [-(-record["metrics"]["keypoints"] // 2) for record in found]


@pytest.mark.slow
def test_foreground_and_background_of_a_scene_are_scored_separately(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    gallery = Gallery(views=1, queries=1, night=0, width=160, height=128, detail=0.2, people=4)
    (record,) = execute.run([Undefended()], [Sketch()], task=RECONSTRUCTION, dataset=gallery)
    mask = gallery.scene().queries[0].pixels.foreground()
    assert mask is not None
    share = mask.mean()
    assert 0 < share < 1
    found = record["metrics"]
    parts = share * found["mae_foreground"] + (1 - share) * found["mae_background"]
    assert parts == pytest.approx(found["mae"])
    assert found["mae_foreground"] != found["mae_background"]
    assert record["condition"] == "day"
    assert record["dataset"]["spec"]["name"] == "gallery"
    assert "identified-scene" in found
    assert "identified-scene" in record["metric_settings"]
