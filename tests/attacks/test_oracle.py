"""The oracle selects the true words, which agree with an enumeration, and is never taken for an attack."""

import dataclasses

import numpy as np
import pytest

import bench
from attacks.dia import DIA
from attacks.oracle import Oracle
from bench.api import View
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.codebook.true_words import find_true_candidates, find_true_words
from bench.extractors.sift import Sift
from bench.testing import check_attack
from bench.threat_model import TrueWords
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended


def test_the_true_words_are_selected(tmp_path):
    defense, secret, public = LDP(dictionary=write_dictionary(tmp_path), epsilon=5.0), draw_features(200), Public()
    release = defense.protect(secret, public, np.random.default_rng(0))
    words = public.dictionary(defense.dictionary).words.astype(float)
    nearest = np.argmax(secret.descriptors @ (words / np.linalg.norm(words, axis=1, keepdims=True)).T, axis=1)
    expected = [row for row in range(200) if nearest[row] in release.words[row]]
    assert 20 < len(expected) < 180
    candidates = find_true_candidates(release, find_true_words(defense, secret, public))
    view = View(
        release=release, defense=defense, extractor=Sift(), knowledge={TrueWords: lambda: TrueWords(candidates=candidates)}
    )
    selection = Oracle().select(view, np.random.default_rng(0))
    assert selection.rows.tolist() == expected
    truth = words[nearest[expected]]
    np.testing.assert_allclose(selection.descriptors, truth / np.linalg.norm(truth, axis=1, keepdims=True), atol=1e-6)


def test_without_the_true_words_it_is_refused():
    view = View(release=draw_release(), defense=LDP(), extractor=Sift())
    with pytest.raises(PermissionError, match="did not declare TrueWords"):
        Oracle().select(view, np.random.default_rng(0))


def draw_release():
    defense = LDP()
    return defense.protect(draw_features(5), Public(), np.random.default_rng(0))


class Undeclared(Oracle):
    """Finds the true words without a declaration."""

    needs = frozenset()

    def select(self, view, rng):
        known = {TrueWords: lambda: TrueWords(candidates=self.candidates)}
        return super().select(dataclasses.replace(view, knowledge=known), rng)


def test_the_oracle_is_exempt_from_the_contract_by_its_declaration(tmp_path, monkeypatch):
    """Negative control: the same attack without the declaration reads the secret, and the contract finds it."""
    defense = LDP(dictionary=write_dictionary(tmp_path), epsilon=5.0)
    secret = draw_features(20)
    check_attack(Oracle(), defense, Sift(), secret)
    import bench.tasks.reconstruction as reconstruction

    build_view = reconstruction.build_view

    def build_leaky_view(trial):
        Undeclared.candidates = find_true_candidates(trial.release, find_true_words(trial.defense, trial.secret, trial.public))
        return build_view(trial)

    monkeypatch.setattr("bench.testing.build_view", build_leaky_view)
    with pytest.raises(AssertionError):
        check_attack(Undeclared(), defense, Sift(), secret)


@pytest.mark.parametrize("defense", [Undefended(), Affine()])
def test_it_applies_to_word_sets_alone(defense):
    assert "oracle" in (Oracle().explain_not_applicable(defense, Sift(), Public()) or "")


@pytest.mark.exhaustive
def test_it_exceeds_the_attack_where_few_words_are_true():
    """At ε = 10 about 15% of the sets contain the true word."""
    from bench.images.photographs import list_builtin

    photographs = [source.path for source in list_builtin()[:3]]
    records = bench.run([LDP()], [DIA(), Oracle()], photographs)
    means = {
        name: np.mean([record["metrics"]["identified"] for record in records if record["attack"]["name"] == name])
        for name in ("dia", "oracle")
    }
    assert means["oracle"] > means["dia"]
