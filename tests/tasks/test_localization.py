"""Localization from end to end, in Aachen's layout: what is recorded, what it leaves for other programs, and what must fail."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gallery_stretch import KEPT, STRETCH, WALK

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
from bench.tasks.localization import THRESHOLDS, Localization, score_pose
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended
from leaderboard import localization_results

SIFT = Sift(max_keypoints=400)
STRICT = "recall_0.25m_2deg"


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(store.VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fifteen references and five queries between them, of which two count as taken by night."""
    taken = [WALK.scene().references[number] for number in STRETCH]
    between = [image for number, image in enumerate(taken) if number not in KEPT]
    queries = [replace(image, condition="night" if number > 2 else "day") for number, image in enumerate(between)]
    out = tmp_path_factory.mktemp("place") / "aachen"
    scene_export.write(
        Scene(name="stretch", references=tuple(taken[number] for number in KEPT), queries=tuple(queries)), "aachen", out
    )
    return out


def run(place: Path, *defenses: Defense, **task: object) -> list[Record]:
    return execute.run(list(defenses), task=Localization(trials=3000, **task), dataset=Aachen(path=place), extractor=SIFT)


def mean(records: list[Record], metric: str = STRICT) -> float:
    return float(np.mean([record["metrics"][metric] for record in records]))


@pytest.fixture(scope="module")
def raw(place: Path) -> list[Record]:
    return run(place, Undefended())


def test_poses_and_what_was_retrieved_are_recorded(place: Path, raw: list[Record]) -> None:
    assert mean(raw) == 1
    truth = {query.name: query.cam_from_world for query in aachen.load(place).queries}
    names = {reference.name for reference in aachen.load(place).references}
    for record in raw:
        found = lists.parse_pose([repr(value) for value in record["estimates"]["pose"]], "here")
        true = truth[record["sample"]]
        assert true is not None
        apart, turned = pose.compute_errors(found, true)
        assert (apart, turned) == pytest.approx((record["metrics"]["translation_error"], record["metrics"]["rotation_error"]))
        assert set(record["estimates"]["retrieved"]) == names  # of so few all
        assert 0 < record["metrics"]["trials"] <= 3000


def test_exact_poses_score_everything_and_twice_the_size_nothing(place: Path) -> None:
    for query in aachen.load(place).queries:
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


def test_each_matcher_localizes(place: Path) -> None:
    found = {matcher: run(place, defense, matcher=matcher) for matcher, defense in MATCHED.items()}
    for records in found.values():
        assert mean(records) >= 0.8
        assert mean(records, "inliers") > 40
    # Two subspaces are near each other where their descriptors are not: more accidents, and fewer inliers.
    points, lifted = found["point-to-subspace"], found["subspace-to-subspace"]
    assert mean(lifted, "inliers") < mean(points, "inliers")
    assert mean(lifted, "matches") > mean(points, "matches")


def test_retrieval_by_what_was_released_needs_nothing_else(place: Path) -> None:
    """With words that tell the truth it finds the references that raw descriptors find; with random ones it does not."""
    raw, told, random = (
        run(place, LDP(dictionary=Asset("references"), words=1000, epsilon=epsilon), retrieval=retrieval, retrieved=3)
        for epsilon, retrieval in ((10.0, "raw"), (10.0, "released"), (0.0, "released"))
    )

    def shared(found: list[Record]) -> float:
        return float(np.mean([len({*_retrieved(one)} & {*_retrieved(other)}) / 3 for one, other in zip(raw, found, strict=True)]))

    assert shared(told) > 0.6 > shared(random)
    assert mean(told) >= 0.8
    assert mean(random) == 0


def _retrieved(record: Record) -> list[str]:
    names: list[str] = record["estimates"]["retrieved"]
    return names


def test_the_inlier_attack_verifies_whatever_the_server_can_localize(place: Path) -> None:
    """Of subspaces all references are tried, for they do not tell which to retrieve; random words verify next to nothing."""
    random = LDP(dictionary=Asset("references"), words=1000, epsilon=0.0)
    found = execute.run([Undefended(), Affine(), random], [Inlier(retrieved=1, trials=3000)], dataset=Aachen(path=place))
    verified: dict[str, list[int]] = {}
    for record in found:
        verified.setdefault(record["defense"]["name"], []).append(int(record["notes"][-1].split()[0]))
    assert min(verified["none"]) > 40
    assert np.mean(verified["affine"]) > np.mean(verified["none"])  # of one reference's points
    assert max(verified["ldp"]) < 20


# ---- controls


def test_no_budget_localizes_nothing(place: Path) -> None:
    """Negative control: at ε = 0 words are random, and only their number is right."""
    assert mean(run(place, LDP(dictionary=Asset("references"), words=1000, epsilon=0.0))) == 0


def test_words_made_up_at_random_localize_if_both_sides_have_them(place: Path, tmp_path: Path) -> None:
    """They are a hash: near descriptors have the same nearest word. With too few of them nothing is told apart."""
    many, few = (LDP(dictionary=write_dictionary(tmp_path, size), epsilon=np.inf, subset_size=1) for size in (2000, 200))
    assert mean(run(place, many)) >= 0.8
    assert mean(run(place, few)) <= 0.4


# ---- what it leaves for other programs


def bench(place: Path, out: Path, *more: str) -> tuple[int, list[Record]]:
    """`bench run` of raw descriptors and of words, and its records."""
    command = ["run", "--task", "localization:trials=3000", "--dataset", f"aachen:path={place}", "--out", str(out)]
    defenses = more or ("--defense", "none", "--defense", "ldp:words=1000,epsilon=inf,subset_size=1")
    status = cli.main([*command, "--extractor", "sift:max_keypoints=400", *defenses])
    return status, [json.loads(line) for line in (out / "records.jsonl").read_text().splitlines()]


def edited(place: Path, out: Path, change: Callable[[str], str]) -> Path:
    """A copy whose list of queries by day has its first line changed."""
    out.mkdir()
    for path in place.iterdir():
        if path.name != "queries":
            (out / path.name).symlink_to(path)
    (out / "queries").mkdir()
    for path in (place / "queries").iterdir():
        first, *others = path.read_text().splitlines()
        first = change(first) if path.name.startswith("day") else first
        (out / "queries" / path.name).write_text("\n".join([first, *others]) + "\n")
    return out


def test_withheld_poses_are_handed_in_and_failures_are_counted(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As Aachen is downloaded: no ground truth. One query's intrinsics are wrong, so it has no pose to hand in."""
    withheld = edited(place, tmp_path / "withheld", _longer)
    (withheld / "ground_truth.txt").unlink()
    status, records = bench(withheld, tmp_path / "out")
    assert status == 1
    told = capsys.readouterr().err
    truth = {query.name.rpartition("/")[2]: query.cam_from_world for query in aachen.load(place).queries}
    files = sorted((tmp_path / "out").glob("Aachen_eval_*.txt"))
    assert [path.name for path in files] == [
        "Aachen_eval_ldp_epsilon_inf_subset_size_1_words_1000-seed0.txt",
        "Aachen_eval_none_sends_positions-seed0.txt",
    ]
    for path in files:
        found = lists.read_poses(path)
        assert f"{path}: 4 poses; 1 queries that failed are left out" in told
        assert len(found) == 4 == len(truth) - 1
        for name, (_, there) in found.items():
            true = truth[name]
            assert true is not None
            assert pose.compute_errors(there, true)[0] < 0.25
    for record in records:
        if record["status"] == "ok":
            assert not {STRICT, "translation_error"} & record["metrics"].keys()
            assert record["notes"] == ["its pose is withheld"]


def _longer(line: str) -> str:
    """A list's line whose focal length is half as long again."""
    name, model, width, height, focal, *others = line.split()
    return " ".join([name, model, width, height, str(1.5 * float(focal)), *others])


def test_wrong_intrinsics_are_reported_and_not_averaged(
    place: Path, raw: list[Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, records = bench(edited(place, tmp_path / "wrong", _longer), tmp_path / "out", "--defense", "none")
    assert status == 1
    failed = [record for record in records if record["status"] == "failed"]
    assert [record["sample"] for record in failed] == [raw[0]["sample"]]
    assert "its intrinsics do not fit; its raw features ask for 0.6" in failed[0]["reason"]
    assert failed[0]["metrics"] == {}
    assert failed[0]["reason"] in capsys.readouterr().out
    assert mean([record for record in records if record["status"] == "ok"]) == 1


def test_pairs_are_written_and_read_again(place: Path, raw: list[Record], tmp_path: Path) -> None:
    written = tmp_path / "pairs.txt"
    assert next(localization_results.write(raw, tmp_path)) == f"{written}: what was retrieved for 5 queries"
    assert pairs.read(written) == {record["sample"]: _retrieved(record) for record in raw}
    again = run(place, Undefended(), pairs=written)
    assert [record["metrics"] for record in again] == [record["metrics"] for record in raw]
    kept = {query: references[:2] for query, references in pairs.read(written).items()}
    pairs.write(written, kept)
    fewer = run(place, Undefended(), pairs=written)
    assert {record["sample"]: _retrieved(record) for record in fewer} == kept
    assert mean(fewer, "matches") < mean(raw, "matches")
    other = [{**record, "experiment_id": "other", "defense": {"name": "affine", "dim": 2}} for record in fewer]
    assert len(list(localization_results.write([*raw, *other], tmp_path))) == 4  # of each its pairs and its poses
    assert pairs.read(tmp_path / "pairs-affine_dim_2-seed0.txt") == kept


def test_pairs_with_a_stranger_are_a_mistake(place: Path, tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("query/day/0.png db/stranger.png\n")
    reference = aachen.load(place).queries[0].name
    path.write_text(f"{reference} db/stranger.png\n")
    (failed, *_) = run(place, Undefended(), pairs=path)
    assert failed["reason"] == f"{path}: db/stranger.png is no reference of the map"
    with pytest.raises(UserError, match="retrieved and trials must be at least 1"):
        Localization(retrieved=0)
