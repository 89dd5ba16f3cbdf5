"""The command that repeats an experiment is read by the command line as the same experiment."""

import shlex
from pathlib import Path
from typing import Any

import fabricated
import pytest
from fabricated import PHOTOGRAPHS, ldp, reconstructions
from fakes import write_album

from bench import cli
from bench.api import Attack, Defense, Extractor
from bench.cli.commands import run
from bench.codebook.examples import write_dictionary
from bench.core.hashing import short_hash
from bench.datasets.gallery import Gallery
from bench.extractors.sift import Sift
from bench.registry import discovery, spec
from bench.runner.plan import Plan, RunConfiguration, build_plan
from bench.tasks.collisions import Collisions
from bench.tasks.localization import Localization
from bench.tasks.reconstruction import Reconstruction
from leaderboard.comparison import GroupedExperiment, LocatedRecord
from leaderboard.recipe import build_recipe


def planned(command: str) -> Plan:
    """Return the plan that `bench run` builds for a command."""
    program, *words = shlex.split(command)
    assert program == "bench"
    args, extra = cli.build_parser().parse_known_args(words)
    assert not extra
    task = spec.read(args.task, discovery.TASK)
    attacks: list[Attack] = [spec.read(text, discovery.ATTACK) for text in args.attack or []]
    defenses: list[Defense] = [run._read_defense(text, task) for text in args.defense]
    pairs = tuple((defense, attack) for defense in defenses for attack in attacks or [None])
    extractor: Extractor = spec.read(args.extractor, discovery.EXTRACTOR)
    dataset = None if args.dataset is None else spec.read(args.dataset, discovery.DATASET)
    return build_plan(
        RunConfiguration(pairs=pairs, images=args.images, task=task, extractor=extractor, dataset=dataset, seed=args.seed)
    )


def group(plan: Plan) -> list[GroupedExperiment]:
    records = [experiment.metadata | {"sample": "a", "status": "ok", "reason": None} for experiment in plan.experiments]
    return [GroupedExperiment(defense="d", attack="a", records=(LocatedRecord(record, Path()),)) for record in records]


UPRIGHT, ORIENTED = Sift(), Sift(upright=False, max_keypoints=77)


@pytest.mark.parametrize(
    ("defense", "attack", "extractor"),
    [
        ("none", "dia", UPRIGHT),
        ("affine:dim=4", "sparsity:ties=2", ORIENTED),
        ("affine:dim=2,lifting=random", "nearest", ORIENTED),
        ("ldp:epsilon=16", "dia", UPRIGHT),
        ("ldp:epsilon=1/3,subset_size=4,memoize=true", "keypoints", UPRIGHT),
        ("naive-ldp:epsilon=inf", "keypoints", UPRIGHT),
        ("ldp", "repeat:releases=4", ORIENTED),
    ],
)
def test_the_command_repeats_the_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, defense: str, attack: str, extractor: Extractor
) -> None:
    write_album(tmp_path / "my album")
    monkeypatch.chdir(tmp_path)
    pairs = ((spec.read(defense, discovery.DEFENSE), spec.read(attack, discovery.ATTACK)),)
    configuration = RunConfiguration(
        pairs=pairs, images=Path("my album"), task=Reconstruction(), extractor=extractor, dataset=None, seed=7
    )
    plan = build_plan(configuration)
    (experiment,) = group(plan)
    command = build_recipe(experiment).command
    assert planned(command).hash == plan.hash == short_hash([experiment.metadata["experiment_id"]])


def test_default_fields_are_omitted(monkeypatch: pytest.MonkeyPatch) -> None:
    configuration = RunConfiguration(
        pairs=((spec.read("affine", discovery.DEFENSE), None),),
        images=None,
        task=Collisions(),
        extractor=Sift(),
        dataset=None,
        seed=0,
    )
    (experiment,) = group(build_plan(configuration))
    assert build_recipe(experiment).command == "bench run --task collisions --defense affine --seed 0"
    assert build_recipe(experiment).needs == ()


@pytest.mark.slow
def test_a_dictionary_of_the_scene_is_built_again() -> None:
    tiny = Gallery(width=64, height=48, detail=0.1, views=2, queries=2)
    ldp = spec.read("ldp:epsilon=9,words=32,dictionary=references", discovery.DEFENSE)
    task = Localization(retrieval="released", trials=100)
    plan = build_plan(RunConfiguration(pairs=((ldp, None),), images=None, task=task, extractor=Sift(), dataset=tiny, seed=1))
    (experiment,) = group(plan)
    repeated = build_recipe(experiment)
    assert repeated.command == (
        "bench run --task localization:retrieval=released,trials=100 --defense ldp:epsilon=9,words=32 "
        "--dataset gallery:views=2,queries=2,width=64,height=48,detail=0.1 --seed 1"
    )
    assert planned(repeated.command).hash == plan.hash
    assert any("is made from the references of the scene" in line for line in repeated.needs)


def test_own_files_are_named_by_their_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = write_dictionary(tmp_path)
    write_album(tmp_path / "album")
    monkeypatch.chdir(tmp_path)
    pairs = ((spec.read(f"ldp:epsilon=5,dictionary={own}", discovery.DEFENSE), spec.read("keypoints", discovery.ATTACK)),)
    plan = build_plan(
        RunConfiguration(pairs=pairs, images=Path("album"), task=Reconstruction(), extractor=Sift(), dataset=None, seed=0)
    )
    (experiment,) = group(plan)
    repeated = build_recipe(experiment)
    assert repeated.command == "bench run --defense ldp:epsilon=5,dictionary=FILE --attack keypoints --images album --seed 0"
    digest = experiment.metadata["defense"]["dictionary"]
    assert f"FILE for dictionary of ldp: {digest}" in repeated.needs
    assert planned(repeated.command.replace("FILE", own)).hash == plan.hash


def fabricate(records: list[dict[str, Any]]) -> GroupedExperiment:
    return GroupedExperiment(defense="d", attack="a", records=tuple(LocatedRecord(one, Path()) for one in records))


def test_a_plugin_that_is_not_installed_has_all_its_fields() -> None:
    unrelated = {"name": "unrelated", "levels": 8, "soft": True, "rate": 0.5, "file": None}
    (command,) = build_recipe(fabricate(reconstructions(unrelated, [0.5], attack={"name": "unheard-of"}))).command.splitlines()
    assert "--defense unrelated:levels=8,soft=true,rate=0.5,file=none --attack unheard-of" in command


def test_each_seed_has_its_line() -> None:
    records = reconstructions(ldp(8.0), [0.5], seed=3) + reconstructions(ldp(8.0), [0.5], seed=1)
    assert [line.rpartition(" ")[2] for line in build_recipe(fabricate(records)).command.splitlines()] == ["1", "3"]


@pytest.mark.parametrize("name", ["$(touch pwned)", "a b; rm -rf x", "--out=elsewhere", "it's\n`id`"])
def test_names_are_quoted_for_a_shell(name: str) -> None:
    experiment = fabricate(reconstructions({"name": name}, [0.5], dataset=PHOTOGRAPHS | {"name": name}))
    program, run, *words = shlex.split(build_recipe(experiment).command)
    assert (program, run) == ("bench", "run")
    args, extra = cli.build_parser().parse_known_args([run, *words])
    assert not extra
    assert args.defense == [name]
    assert args.images == Path(name)
    assert args.out is None


def test_the_settings_of_a_task_are_given() -> None:
    settings = {
        "task": "localization",
        "task_settings": {"retrieval": "released", "retrieved": 20, "trials": 500},
        "attack": None,
    }
    command = build_recipe(fabricate(reconstructions({"name": "none"}, [0.5], **settings))).command
    assert command.startswith("bench run --task localization:retrieval=released,trials=500 --defense none --images photos")


def test_a_dataset_is_given_by_its_spec() -> None:
    gallery = fabricated.GALLERY | {"spec": {"name": "gallery", "views": 12, "queries": 300}}
    experiment = fabricate(reconstructions({"name": "none"}, [0.5], dataset=gallery))
    assert "--dataset gallery:views=12" in build_recipe(experiment).command
    assert "--images" not in build_recipe(experiment).command
