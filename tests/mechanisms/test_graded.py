"""Draws by levels: `exponential` and `metric-ldp` against enumeration and their proofs; broken variants are detected."""

import dataclasses
import json
import math
from collections import Counter
from fractions import Fraction
from itertools import permutations
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from fakes import write_album
from scipy import stats

import bench
from attacks import keypoints
from bench.api import Defense
from bench.audit.auditor import audit, create_features_near_words
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import ASSETS, Public
from bench.core.errors import UserError
from bench.core.exact import Exact
from bench.geometry.nearest_words import unit_rows
from bench.geometry.neighbours import Neighbours
from bench.mechanisms import budget
from bench.mechanisms.graded import draw_graded_words
from bench.types import Features, WordSets
from defenses.exponential import Exponential
from defenses.metric_ldp import MetricLDP
from leaderboard import comparison, group_tables, tables

ALPHA = 1e-4


def chances(weights: np.ndarray, size: int) -> dict[tuple[int, ...], float]:
    """Return the probability of each set, if words are drawn one at a time without replacement."""
    sets: dict[tuple[int, ...], float] = {}
    for order in permutations(range(len(weights)), size):
        chance, left = 1.0, float(weights.sum())
        for word in order:
            chance *= weights[word] / left
            left -= weights[word]
        key = tuple(sorted(order))
        sets[key] = sets.get(key, 0.0) + chance
    return sets


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 2, 3])
def test_words_against_enumeration(size: int) -> None:
    codes, draws = draw_features(7, 2).codes, 60_000
    assert codes is not None
    unit = unit_rows(codes).astype(np.float64)
    cosines = unit @ unit[3]
    borders = np.quantile(cosines, [0.3, 0.6, 0.9])
    powers = [Fraction(level, 2) for level in range(4)]
    words = draw_graded_words(Neighbours(codes), np.full(draws, 3), borders, powers, size, np.random.default_rng(0))
    assert (np.diff(words, axis=1) > 0).all()
    observed = Counter(map(tuple, words.tolist()))
    levels = (cosines[:, None] >= borders - 1e-12).sum(axis=1)
    for scale, right in ((1.0, True), (1.2, False)):
        expected = chances(np.exp(scale * levels / 2), size)
        p = stats.chisquare([observed[Z] for Z in expected], [draws * chance for chance in expected.values()]).pvalue
        assert p > ALPHA if right else p < 1e-6


def measure_frequencies(defense: Defense, secrets: Features, public: Public, draws: int) -> np.ndarray:
    """Return the frequencies of words. -> (secrets, K)"""
    found = []
    for row in range(len(secrets)):
        release = defense.protect(secrets.take(np.full(draws, row)), public, np.random.default_rng(row))
        assert isinstance(release, WordSets)
        assert release.words is not None
        found.append(np.bincount(release.words.ravel(), minlength=len(secrets)) / draws)
    return np.array(found)


@pytest.mark.slow
def test_exponential_has_the_law_of_its_docstring(tmp_path: Path) -> None:
    public, asset = Public(), write_dictionary(tmp_path, 12)
    defense = Exponential(epsilon=6.0, floor=0.3, levels=5, dictionary=asset)
    secrets = create_features_near_words(defense, public)
    unit = unit_rows(public.dictionary(asset).words).astype(np.float64)
    utility = np.floor((unit @ unit.T - 0.3) / 0.7 * 5 + 1e-6).clip(0) / 5
    weights = np.exp(6.0 * utility / 2)
    np.testing.assert_allclose(
        measure_frequencies(defense, secrets, public, 20_000), weights / weights.sum(1, keepdims=True), atol=0.02
    )
    assert defense.privacy(public).epsilon == 6.0


@pytest.mark.slow
def test_metric_ldp_has_the_law_of_its_docstring(tmp_path: Path) -> None:
    public, asset = Public(), write_dictionary(tmp_path, 12)
    defense = MetricLDP(epsilon=5.0, steps=4, dictionary=asset)
    secrets = create_features_near_words(defense, public)
    unit = unit_rows(public.dictionary(asset).words).astype(np.float64)
    distances = np.ceil(np.linalg.norm(unit[:, None] - unit, axis=2) * 4 - 1e-5) / 4
    weights = np.exp(-5.0 * distances / 2)
    np.testing.assert_allclose(
        measure_frequencies(defense, secrets, public, 20_000), weights / weights.sum(1, keepdims=True), atol=0.02
    )
    # The metric of the guarantee is at least the rounded distance, and is a metric.
    metric = np.array([[float(defense.distance(secrets, public, i, j)) for j in range(12)] for i in range(12)])
    assert (metric >= distances).all()
    assert (metric <= distances + 0.25).all()
    assert (metric[:, None] <= metric[:, :, None] + metric[None]).all()
    assert np.abs(np.log(weights[:, None] / weights[None])).max() <= 5.0 / 2 * metric.max()
    ratios = np.log(weights / weights.sum(1, keepdims=True))
    assert (np.abs(ratios[:, None] - ratios[None]).max(axis=2) <= 5.0 * metric + 1e-9).all()


def test_a_guarantee_by_distance_has_no_epsilon_per_descriptor(tmp_path: Path) -> None:
    guarantee = MetricLDP(dictionary=write_dictionary(tmp_path)).privacy(Public())
    assert (guarantee.guarantee, guarantee.epsilon, guarantee.per_distance) == ("d-chi", None, 16.0)
    assert Exponential(dictionary=write_dictionary(tmp_path)).distance(draw_features(2), Public(), 0, 1) == 1


@pytest.mark.slow
def test_a_guarantee_by_distance_is_in_no_epsilon_column(tmp_path: Path) -> None:
    """Neither records, tables, the leaderboard's tables nor budgets have it. The records follow the schema."""
    small = write_dictionary(tmp_path)
    defenses = [MetricLDP(dictionary=small), Exponential(dictionary=small)]
    write_album(tmp_path / "photos", 1)
    records = bench.run(defenses, [keypoints.PLUGIN()], tmp_path / "photos", out=tmp_path / "run")
    privacy = records[0]["privacy"]
    assert (privacy["guarantee"], privacy["epsilon_per_distance"]) == ("d-chi", 16.0)
    assert [privacy[name] for name in ("epsilon_descriptor", "epsilon_image", "epsilon_image_optimal")] == [None] * 3
    assert "epsilon_per_distance" not in records[1]["privacy"]
    schema = json.loads((ASSETS / "record-2.schema.json").read_text(encoding="utf-8"))
    for record in records:
        jsonschema.validate(record, schema)
    (table,) = tables.build_tables(records)
    labels = [column.label for column in table.columns]
    by_distance, by_epsilon = (dict(zip(labels, row.texts, strict=True)) for row in table.rows)
    assert (by_distance["ε/descriptor"], by_distance["ε/image"], by_epsilon["ε/descriptor"]) == ("n/a", "n/a", "10")
    assert by_distance["note"] == "not ε-LDP: ε = 16 per unit of distance"
    (group,) = comparison.build_groups(comparison.load_records(tmp_path / "run"))
    rows = {row.experiment.metadata["defense"]["name"]: row.values for row in group_tables.build_pairs_table(group).rows}
    assert rows["metric-ldp"]["guarantee"] == "d_χ privacy, ε = 16 per unit of distance"
    assert rows["metric-ldp"]["epsilon_descriptor"] is None is rows["metric-ldp"]["epsilon_image"]
    assert rows["exponential"]["epsilon_descriptor"] == 10.0
    assert {record["defense"]["name"] for record in budget.select_nearest_records(records, 16.0)} == {"exponential"}


# ---- the audit


@pytest.mark.slow
def test_guarantees_hold(tmp_path: Path) -> None:
    for defense in (Exponential(epsilon=2.0, floor=0.2), MetricLDP(epsilon=3.0), Exponential(epsilon=4.0, subset_size=3)):
        found = audit(defense, 64, 4000, 0, tmp_path)
        assert found.verdict == "consistent"
        assert found.by_distance == isinstance(defense, MetricLDP)
    assert found.strongest.epsilon < 1


@pytest.mark.slow
def test_exponential_uses_about_half_of_its_epsilon(tmp_path: Path) -> None:
    found = audit(Exponential(epsilon=Exact("1/3"), floor=0.3), 3, 400, 0, tmp_path).enumeration
    assert found is not None
    assert not found.exceeds
    assert 1 / 6 < found.low <= found.high < 1 / 5


@pytest.mark.slow
def test_enumeration_of_a_guarantee_by_distance(tmp_path: Path) -> None:
    found = audit(MetricLDP(epsilon=2.0), 3, 400, 0, tmp_path).enumeration
    assert found is not None
    assert not found.exceeds
    assert 1.0 < found.low <= found.high < 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class WithoutTheTwo(Exponential):
    """Spends all of ε on the numerator."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        return dataclasses.replace(self.sound(), epsilon=2 * self.epsilon).protect(secret, public, rng)

    def sound(self) -> Exponential:
        return Exponential(**{field.name: getattr(self, field.name) for field in dataclasses.fields(self)})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rescaled(MetricLDP):
    """Measures distances in eighths of the guarantee's unit of distance."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        sound = MetricLDP(epsilon=8 * self.epsilon, steps=self.steps, dictionary=self.dictionary)
        return sound.protect(secret, public, rng)


@pytest.mark.slow
def test_broken_variants_are_detected(tmp_path: Path) -> None:
    found = audit(WithoutTheTwo(epsilon=Exact("1/3"), floor=0.3), 3, 400, 0, tmp_path)
    assert found.enumeration is not None
    assert found.enumeration.exceeds
    assert not any(finding.certain_epsilon > found.claimed for finding in found.findings)  # too little for so few trials
    found = audit(Rescaled(epsilon=1.0), 8, 20_000, 0, tmp_path)
    assert {finding.family for finding in found.findings if finding.certain_epsilon > 1.0} >= {"membership", "position"}


# ---- configuration


@pytest.mark.parametrize(
    ("plugin", "given", "complaint"),
    [
        (Exponential, {"epsilon": math.inf}, "epsilon must be at least 0 and finite"),
        (Exponential, {"floor": 1.0}, "floor must be at least 0 and below 1"),
        (Exponential, {"levels": 0}, "levels must be at least 1"),
        (Exponential, {"words": -1}, "words must be 0 for all"),
        (MetricLDP, {"epsilon": math.nan}, "epsilon must be at least 0 and finite"),
        (MetricLDP, {"steps": 0}, "steps must be at least 1"),
        (MetricLDP, {"words": 1}, "words must be 0 for all"),
    ],
)
def test_invalid_settings_are_refused(plugin: Any, given: dict[str, float], complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        plugin(**given)


def test_a_dictionary_with_too_few_words_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="subset_size is 9, but the dictionary has 8 words"):
        Exponential(subset_size=9, dictionary=write_dictionary(tmp_path, 8)).privacy(Public())
