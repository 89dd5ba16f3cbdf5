"""Localization from end to end, in Aachen's layout: records, exported files, and inputs that must fail."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gallery_stretch import list_queries, list_references

from attacks.inlier import Inlier
from bench import cli
from bench.api import Defense
from bench.cache import store
from bench.codebook.examples import write_dictionary
from bench.core.errors import UserError
from bench.datasets import aachen
from bench.datasets.aachen import Aachen
from bench.extractors.sift import Sift
from bench.formats import lists, pairs, scene_export
from bench.images.scene import Scene
from bench.localization import pose
from bench.runner import execute
from bench.runner.records import Record
from bench.settings import Asset
from bench.task_api import REJECTED
from bench.tasks.localization import THRESHOLDS, Localization, score_pose
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended
from leaderboard import localization_results
from leaderboard.tables import list_rejected

pytestmark = pytest.mark.slow

SIFT = Sift(max_keypoints=400)
STRICT = "recall_0.25m_2deg"


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(store.VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fifteen references and five queries between them, two of which count as night images."""
    queries = [replace(image, condition="night" if number > 2 else "day") for number, image in enumerate(list_queries())]
    out = tmp_path_factory.mktemp("dataset") / "aachen"
    scene_export.write(Scene(name="stretch", references=list_references(), queries=tuple(queries)), "aachen", out)
    return out


def run(dataset: Path, *defenses: Defense, **task: object) -> list[Record]:
    return execute.run(list(defenses), task=Localization(trials=3000, **task), dataset=Aachen(path=dataset), extractor=SIFT)


def mean(records: list[Record], metric: str = STRICT) -> float:
    return float(np.mean([record["metrics"][metric] for record in records]))


@pytest.fixture(scope="module")
def raw(dataset: Path) -> list[Record]:
    return run(dataset, Undefended())


def test_poses_and_retrieved_references_are_recorded(dataset: Path, raw: list[Record]) -> None:
    assert mean(raw) == 1
    truth = {query.name: query.cam_from_world for query in aachen.load(dataset).queries}
    names = {reference.name for reference in aachen.load(dataset).references}
    for record in raw:
        found = lists.parse_pose([repr(value) for value in record["estimates"]["pose"]], "here")
        true = truth[record["sample"]]
        assert true is not None
        distance, angle = pose.compute_errors(found, true)
        assert (distance, angle) == pytest.approx((record["metrics"]["translation_error"], record["metrics"]["rotation_error"]))
        assert set(record["estimates"]["retrieved"]) == names  # there are fewer than `retrieved`
        assert 0 < record["metrics"]["trials"] <= 3000


def test_exact_poses_score_one_and_poses_at_twice_the_scale_zero(dataset: Path) -> None:
    for query in aachen.load(dataset).queries:
        true = query.cam_from_world
        assert true is not None
        larger = type(true)(true.rotation, 2 * true.translation)
        for found, expected in ((true, 1.0), (larger, 0.0)):
            scores = score_pose(pose.compute_errors(found, true))
            assert [scores[f"recall_{name}"] for name in THRESHOLDS] == [expected] * len(THRESHOLDS)
    assert score_pose(None)[STRICT] == 0.0
    assert score_pose(None)["translation_error"] is None


# ---- matchers and retrieval


WORDS = LDP(dictionary=Asset("references"), words=1000, epsilon=9.0, subset_size=2)
MATCHED: dict[str, Defense] = {
    "vocabulary": WORDS,
    "mutual-nn": WORDS,
    "point-to-subspace": Affine(dim=2),
    "subspace-to-subspace": Affine(dim=2),
}


def test_each_matcher_localizes(dataset: Path) -> None:
    found = {matcher: run(dataset, defense, matcher=matcher) for matcher, defense in MATCHED.items()}
    for records in found.values():
        assert mean(records) >= 0.8
        assert mean(records, "inliers") > 40
    # Two subspaces may be close although their descriptors are not: more accidental matches, and fewer inliers.
    points, lifted = found["point-to-subspace"], found["subspace-to-subspace"]
    assert mean(lifted, "inliers") < mean(points, "inliers")
    assert mean(lifted, "matches") > mean(points, "matches")


def test_retrieval_by_released_words(dataset: Path) -> None:
    """True words retrieve the same references as raw descriptors; random words do not."""
    raw, released, random = (
        run(dataset, LDP(dictionary=Asset("references"), words=1000, epsilon=epsilon), retrieval=retrieval, retrieved=3)
        for epsilon, retrieval in ((10.0, "raw"), (10.0, "released"), (0.0, "released"))
    )

    def measure_overlap(found: list[Record]) -> float:
        return float(np.mean([len({*_retrieved(one)} & {*_retrieved(other)}) / 3 for one, other in zip(raw, found, strict=True)]))

    assert measure_overlap(released) > 0.6 > measure_overlap(random)
    assert mean(released) >= 0.8
    assert mean(random) == 0


def _retrieved(record: Record) -> list[str]:
    names: list[str] = record["estimates"]["retrieved"]
    return names


def test_the_inlier_attack_verifies_what_the_server_can_localize(dataset: Path) -> None:
    """Subspaces are matched with all references, because retrieval by them fails; random words verify almost nothing."""
    random = LDP(dictionary=Asset("references"), words=1000, epsilon=0.0)
    found = execute.run(
        [Undefended(), Affine(), random], [Inlier(retrieved=1, trials=3000)], dataset=Aachen(path=dataset), extractor=SIFT
    )
    inliers: dict[str, list[int]] = {}
    for record in found:
        (note,) = (note for note in record["notes"] if note.endswith("keypoints verified"))
        inliers.setdefault(record["defense"]["name"], []).append(int(note.split()[0]))
    assert min(inliers["none"]) > 50
    assert np.mean(inliers["affine"]) > np.mean(inliers["none"])  # of one reference's points
    # The digest of our source enters the seed of this release. Over eight seeds, and with more keypoints, at most 24.
    assert max(inliers["ldp"]) < 30


# ---- controls


def test_no_budget_localizes_nothing(dataset: Path) -> None:
    """Negative control: at ε = 0 words are random, and only their number is right."""
    assert mean(run(dataset, LDP(dictionary=Asset("references"), words=1000, epsilon=0.0))) == 0


def test_random_dictionaries_localize_if_both_sides_share_them(dataset: Path, tmp_path: Path) -> None:
    """They act as a hash, since similar descriptors have the same nearest word. Too few words do not distinguish descriptors."""
    many, few = (LDP(dictionary=write_dictionary(tmp_path, size), epsilon=np.inf, subset_size=1) for size in (2000, 200))
    assert mean(run(dataset, many)) >= 0.8
    assert mean(run(dataset, few)) <= 0.4


def test_a_baseline_that_localizes_nothing_is_named(
    dataset: Path, raw: list[Record], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The server is given one reference of another query, so it has no match for any query."""
    other = tmp_path / "pairs.txt"
    other.write_text(f"elsewhere.png {aachen.load(dataset).references[0].name}\n")
    warning = "warning: without a defense, 0 of 5 queries are localized"
    task, out = f"localization:pairs={other}", str(tmp_path / "run")
    arguments = ["run", "--task", task, "--dataset", f"aachen:path={dataset}", "--extractor", "sift:max_keypoints=400"]
    assert cli.main([*arguments, "--defense", "none", "--out", out]) == 0
    assert capfd.readouterr().err.count(warning) == 1
    assert list(localization_results.find_lost_baselines(raw)) == []
    lost = [{**record, "metrics": record["metrics"] | {"recall_5m_10deg": 0.0}} for record in raw]
    (line,) = localization_results.find_lost_baselines(lost)
    assert line.startswith(warning)
    assert list(localization_results.find_lost_baselines([*lost[1:], raw[0]])) == []  # one query is enough
    defended = [{**record, "defense": {"name": "ldp"}} for record in lost]
    assert list(localization_results.find_lost_baselines(defended)) == []
    # Where the true poses are withheld, any pose counts.
    withheld = [{**record, "metrics": {}} for record in raw]
    assert list(localization_results.find_lost_baselines(withheld)) == []
    assert len(list(localization_results.find_lost_baselines([{**each, "estimates": {"pose": None}} for each in withheld]))) == 1


# ---- exported files


def run_command(dataset: Path, out: Path, *more: str) -> tuple[int, list[Record]]:
    """Run `bench run` on raw descriptors and on words. Returns its exit status and records."""
    command = ["run", "--task", "localization:trials=3000", "--dataset", f"aachen:path={dataset}", "--out", str(out)]
    defenses = more or ("--defense", "none", "--defense", "ldp:words=1000,epsilon=inf,subset_size=1")
    status = cli.main([*command, "--extractor", "sift:max_keypoints=400", *defenses])
    return status, [json.loads(line) for line in (out / "records.jsonl").read_text().splitlines()]


def copy_with_edit(dataset: Path, out: Path, change: Callable[[str], str]) -> Path:
    """Copy the dataset with a changed first line in the list of day queries."""
    out.mkdir()
    for path in dataset.iterdir():
        if path.name != "queries":
            (out / path.name).symlink_to(path)
    (out / "queries").mkdir()
    for path in (dataset / "queries").iterdir():
        first, *others = path.read_text().splitlines()
        first = change(first) if path.name.startswith("day") else first
        (out / "queries" / path.name).write_text("\n".join([first, *others]) + "\n")
    return out


def test_withheld_poses_are_exported_and_failures_are_counted(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As in the download of Aachen, there is no ground truth. The intrinsics of one query are wrong, so it has no pose."""
    withheld = copy_with_edit(dataset, tmp_path / "withheld", _lengthen_focal)
    (withheld / "ground_truth.txt").unlink()
    status, records = run_command(withheld, tmp_path / "out")
    assert status == 0
    messages = capsys.readouterr().err
    truth = {query.name.rpartition("/")[2]: query.cam_from_world for query in aachen.load(dataset).queries}
    files = sorted((tmp_path / "out").glob("Aachen_eval_*.txt"))
    assert [path.name for path in files] == [
        "Aachen_eval_ldp_epsilon_inf_subset_size_1_words_1000-seed0.txt",
        "Aachen_eval_none_sends_positions-seed0.txt",
    ]
    for path in files:
        found = lists.read_poses(path)
        assert f"{path}: 4 poses; 1 queries without a pose are left out" in messages
        assert len(found) == 4 == len(truth) - 1
        for name, (_, pose_found) in found.items():
            true = truth[name]
            assert true is not None
            assert pose.compute_errors(pose_found, true)[0] < 0.25
    for record in records:
        assert not {STRICT, "translation_error"} & record["metrics"].keys()
        assert record["notes"] == ["its pose is withheld"] or record["notes"][0].startswith(REJECTED)
    assert sum(record["notes"][0].startswith(REJECTED) for record in records) == 2  # the query, under each defense


def _lengthen_focal(line: str) -> str:
    """Return a list's line with 1.5 times the focal length."""
    name, model, width, height, focal, *others = line.split()
    return " ".join([name, model, width, height, str(1.5 * float(focal)), *others])


def test_a_query_with_wrong_intrinsics_counts_as_not_localized(
    dataset: Path, raw: list[Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It stays in the mean, and the table states the number. With the right intrinsics, all queries are localized."""
    wrong = copy_with_edit(dataset, tmp_path / "wrong", _lengthen_focal)
    status, records = run_command(wrong, tmp_path / "out", "--defense", "none")
    assert status == 0
    assert {record["status"] for record in records} == {"ok"}
    (rejected,) = (record for record in records if record["notes"])
    assert rejected["sample"] == raw[0]["sample"]
    assert rejected["notes"][0].startswith(f"{REJECTED}: its raw features fit 0.6")
    assert rejected["metrics"] == {
        **{f"recall_{name}": 0.0 for name in THRESHOLDS},
        **dict.fromkeys(("translation_error", "rotation_error", "matches", "inliers", "trials")),
        "keypoints": rejected["metrics"]["keypoints"],
    }
    assert mean(records) == 0.8
    assert mean(raw) == 1
    remark = "queries rejected for their intrinsics: not localized"
    assert f"1 of 3 {remark}" in " ".join(capsys.readouterr().out.split())  # of those by day
    assert list_rejected(records) == [f"1 of 5 {remark}"]
    assert list_rejected(raw) == []


def test_pairs_are_written_and_read_again(dataset: Path, raw: list[Record], tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    assert next(localization_results.write(raw, tmp_path)) == f"{path}: the images retrieved for 5 queries"
    assert pairs.read(path) == {record["sample"]: _retrieved(record) for record in raw}
    again = run(dataset, Undefended(), pairs=path)
    assert [record["metrics"] for record in again] == [record["metrics"] for record in raw]
    shortened = {query: references[:2] for query, references in pairs.read(path).items()}
    pairs.write(path, shortened)
    fewer = run(dataset, Undefended(), pairs=path)
    assert {record["sample"]: _retrieved(record) for record in fewer} == shortened
    assert mean(fewer, "matches") < mean(raw, "matches")
    other = [{**record, "experiment_id": "other", "defense": {"name": "affine", "dim": 2}} for record in fewer]
    assert len(list(localization_results.write([*raw, *other], tmp_path))) == 4  # pairs and poses of each
    assert pairs.read(tmp_path / "pairs-affine_dim_2-seed0.txt") == shortened


def test_pairs_with_an_unknown_reference_are_refused(dataset: Path, tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    query = aachen.load(dataset).queries[0].name
    path.write_text(f"{query} db/unknown.png\n")
    (failed, *_) = run(dataset, Undefended(), pairs=path)
    assert failed["reason"] == f"{path}: db/unknown.png is no reference of the map"
    with pytest.raises(UserError, match="retrieved and trials must be at least 1"):
        Localization(retrieved=0)
