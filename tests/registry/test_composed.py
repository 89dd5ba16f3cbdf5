"""Defenses composed from one of positions and one of descriptors."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.registry import discovery, fields, spec
from bench.registry.composed import Composed
from bench.runner.record_shape import REQUIRED
from bench.testing import are_equal, check_defense
from bench.types import Descriptors, Lines, Points, WordSets
from defenses.ldp import LDP
from defenses.lines import RandomLines
from defenses.none import Undefended


def test_plus_separates_only_before_the_name_of_a_defense() -> None:
    assert spec.split_parts("lines+ldp:epsilon=1e+1,words=0+none") == ["lines", "ldp:epsilon=1e+1,words=0", "none"]
    assert spec.split_parts("ldp:dictionary=a+ldp-words") == ["ldp:dictionary=a+ldp-words"]
    assert spec.read("ldp:epsilon=1e+1", discovery.DEFENSE) == LDP(epsilon=10.0)


@pytest.mark.parametrize(
    "text", ["lines+ldp:epsilon=1e+1,subset_size=3", "ldp:subset_size=3,epsilon=10+lines", "lines + ldp:subset_size=3"]
)
def test_parts_keep_their_fields_in_any_order(text: str) -> None:
    defense = spec.read(text, discovery.DEFENSE)
    assert defense == Composed(geometry=RandomLines(), descriptors=LDP(epsilon=10.0, subset_size=3))
    assert pickle.loads(pickle.dumps(defense)) == defense


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("lines+permutation", "lines and permutation both release positions"),
        ("ldp+affine", "ldp and affine both release descriptors"),
        ("lines+ldp+none", "ldp and none both release descriptors"),
        ("lines+lpd", "unknown defense 'lpd'; did you mean 'ldp'?"),
        ("linse+ldp:epsilon=10", "unknown defense 'linse'; did you mean 'lines'?"),
        ("lines+", "unknown defense ''"),
        ("lines+ldp:epsilom=1", "unknown field of ldp"),
    ],
)
def test_refusals(text: str, complaint: str) -> None:
    with pytest.raises(UserError, match=re.escape(complaint)) as refusal:
        spec.read(text, discovery.DEFENSE)
    assert "\n" not in str(refusal.value)


def test_a_record_lists_the_parts() -> None:
    recorded = spec.to_json(spec.read("lines+ldp:epsilon=10", discovery.DEFENSE))
    assert recorded["name"] == "lines+ldp"
    assert recorded["parts"] == [{"name": "lines"}, spec.to_json(LDP(epsilon=10.0))]
    assert REQUIRED["defense"](recorded)
    assert not REQUIRED["defense"]({"name": "lines+ldp", "parts": [{"name": "lines"}, "ldp"]})
    assert not REQUIRED["defense"]({**recorded, "epsilon": 10.0})


def test_the_release_has_the_lines_and_the_word_sets(tmp_path: Path) -> None:
    ldp, public, secret = LDP(dictionary=write_dictionary(tmp_path)), Public(), draw_features()
    defense = Composed(geometry=RandomLines(), descriptors=ldp)
    check_defense(defense, public, secret)
    release = defense.protect(secret, public, np.random.default_rng(1))
    alone = ldp.protect(secret, public, np.random.default_rng(1))
    assert isinstance(release, WordSets)
    assert isinstance(alone, WordSets)
    assert isinstance(release.positions, Lines)
    assert are_equal(release.candidates, alone.candidates)  # the answers of a memoized defense are those that it gives alone
    assert defense.privacy(public) == ldp.privacy(public)
    assert fields.list_assets(defense) == {"dictionary": ldp.dictionary}
    assert (defense.dictionary_field, defense.releases, defense.positions) == ("dictionary", WordSets, Lines)


def test_lines_with_none_are_lines() -> None:
    secret, public = draw_features(), Public()
    both = Composed(geometry=RandomLines(), descriptors=Undefended()).protect(secret, public, np.random.default_rng(1))
    assert are_equal(both, RandomLines().protect(secret, public, np.random.default_rng(1)))
    assert isinstance(both, Descriptors)
    assert not isinstance(both.positions, Points)
