"""Suites of attacks: their expansion, and the attacks of records that belong to them."""

import json

import pytest

from attacks.blank import Blank
from attacks.database import Database
from attacks.density import Density
from attacks.dia import DIA
from bench.core import hashing
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.registry import discovery, spec
from bench.runner import attack_suite
from bench.runner.plan import RunConfiguration, build_plan, cross
from bench.settings import Asset
from bench.tasks.reconstruction import Reconstruction
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

STANDARD = "standard-2026.1"
PUBLISHED = {
    STANDARD: "sha256:4e0fff56bba1f224bbbecf85c9bbf5bf3c6d3b432a3a9c3eecb6b3254f7b2f2c",
    "standard-2026.2": "sha256:62dab61c61dd8519fc44e2e23d4036e77c57978a4129ff4171dfe5530724b80c",
    "standard-2026.3": "sha256:02d9f336a7ce309daacde5e582c0aa53c783d51717850d9b7cecafd76d7a6caa",
}


def test_the_newest_suite_has_every_built_in_attack_once_with_all_its_fields() -> None:
    attacks = attack_suite.read_attacks([attack_suite.list_attack_suites()[-1]])
    built_in = {entry.name for entry in discovery.discover(discovery.ATTACK).values() if entry.origin.startswith("attacks")}
    assert sorted(attack.name() for attack in attacks) == sorted(built_in)
    assert built_in > {attack.name() for attack in attack_suite.read_attacks([STANDARD])}


def test_published_suites_do_not_change() -> None:
    """A change of the attacks is a new version. The defaults of the attacks may change."""
    assert {name: hashing.digest(attack_suite.find(name).specs) for name in attack_suite.list_attack_suites()} == PUBLISHED
    by_name = {attack.name(): attack for attack in attack_suite.read_attacks([STANDARD])}
    assert by_name["database"] == Database(neighbours=4000, estimators=3)
    assert by_name["density"] == Density(width=8.0)


def test_suites_and_attacks_are_combined() -> None:
    attacks = attack_suite.read_attacks(["dia:weights=mine.safetensors", STANDARD])
    assert attacks[0] == DIA(weights=Asset("mine.safetensors"))
    assert attacks[1:] == attack_suite.find(STANDARD).build_attacks()
    assert attack_suite.read_attacks(["density:width=0.5"]) == [Density(width=0.5)]  # a point in a value names no suite


@pytest.mark.parametrize("text", ["standard-2027.1", "standard-2026.1:others=3", "attack.py"])
def test_an_unknown_version_lists_the_known_ones(text: str) -> None:
    with pytest.raises(UserError, match=rf"unknown suite of attacks '{text}'.*vailable: standard-2026\.1"):
        attack_suite.read_attacks([text])


def test_a_field_that_a_suite_does_not_fix_is_an_error() -> None:
    loose = attack_suite.AttackSuite(name="loose-1.0", summary="", specs=("database:neighbours=4000",))
    with pytest.raises(UserError, match=r"loose-1\.0 does not fix estimators of database"):
        loose.build_attacks()


@pytest.mark.slow
def test_records_of_a_planned_suite_belong_to_it() -> None:
    """Also those of pairs that do not apply, and of attacks that use files."""
    pairs = cross(Reconstruction(), [Undefended(), Affine(), LDP()], attack_suite.read_attacks([STANDARD]))
    plan = build_plan(RunConfiguration(pairs=pairs, images=None, task=Reconstruction(), extractor=Sift(), dataset=None, seed=0))
    suite = attack_suite.find(STANDARD)
    for experiment in plan.experiments:
        attack = json.loads(json.dumps(experiment.metadata["attack"]))
        specification = suite.find_spec(attack)
        assert specification is not None
        assert specification.partition(":")[0] == attack["name"]


@pytest.mark.parametrize(
    ("attack", "expected"),
    [
        ({"neighbours": 4000, "estimators": 3}, True),
        ({"neighbours": 4000, "estimators": 3, "inversion": {"name": "dia", "weights": "sha256:0"}}, True),
        ({"neighbours": 4000, "estimators": 3, "words": "sha256:0"}, True),
        ({"neighbours": 400, "estimators": 3}, False),  # a weaker attacker
        ({"neighbours": 4000, "estimators": 3, "rounds": 1}, False),  # a field that the version does not have
        ({"neighbours": 4000}, False),
    ],
)
def test_an_attack_belongs_to_a_suite_with_exactly_its_settings(attack: dict[str, object], expected: bool) -> None:
    assert (attack_suite.find(STANDARD).find_spec({"name": "database", **attack}) is not None) is expected


def test_files_are_free_because_networks_are_trained_for_a_defense() -> None:
    suite = attack_suite.find(STANDARD)
    for asset in ("shipped", "sha256:" + "d" * 64):
        assert suite.find_spec({"name": "dia", "weights": asset}) == "dia"
    assert suite.find_spec(spec.to_json(Blank())) == "blank"
    assert suite.find_spec({"name": "my-attack"}) is None
