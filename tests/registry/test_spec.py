"""Plugins as text, and as the JSON of records."""

import math
from pathlib import Path

import pytest

from bench.codebook.examples import write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.registry import discovery, spec
from bench.settings import Asset
from defenses.affine import Affine
from defenses.ldp import LDP


def test_fields_are_parsed_by_type() -> None:
    plugin, given = spec.parse("ldp:epsilon=12,subset_size=4", discovery.DEFENSE)
    assert plugin is LDP
    assert given == {"epsilon": 12.0, "subset_size": 4}
    assert isinstance(given["epsilon"], float)
    assert spec.build(plugin, given) == LDP(epsilon=12.0, subset_size=4)


@pytest.mark.parametrize("text", ["ldp", "ldp:", " ldp : "])
def test_no_fields_give_defaults(text: str) -> None:
    assert spec.parse(text.strip(), discovery.DEFENSE)[0] is LDP
    assert spec.read("ldp", discovery.DEFENSE) == LDP()


def test_infinity_booleans_choices_and_paths() -> None:
    assert spec.read("ldp:epsilon=inf,subset_size=1", discovery.DEFENSE) == LDP(epsilon=math.inf, subset_size=1)
    assert spec.read("sift:upright=false", discovery.EXTRACTOR) == Sift(upright=False)
    assert spec.read("affine:lifting=random", discovery.DEFENSE) == Affine(lifting="random")
    assert spec.read("ldp:dictionary=/a/b=c.safetensors", discovery.DEFENSE) == LDP(dictionary=Asset("/a/b=c.safetensors"))


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (discovery.DEFENSE, "ldp"),
        (discovery.DEFENSE, "ldp:epsilon=12.5,memoize=true"),
        (discovery.DEFENSE, "ldp:epsilon=inf,dictionary=/a/b.safetensors"),
        (discovery.DEFENSE, "lines+affine:lifting=random,dim=2"),
        (discovery.EXTRACTOR, "sift:upright=false"),
        (discovery.ATTACK, "clustering:coverage=0.5"),
    ],
)
def test_the_text_of_a_plugin_is_read_as_that_plugin(kind: discovery.Kind, text: str) -> None:
    plugin = spec.read(text, kind)
    assert spec.read(spec.to_text(plugin), kind) == plugin
    assert sorted(spec.to_text(plugin).replace("=", ",").split(",")) == sorted(text.replace("=", ",").split(","))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("lpd", "did you mean 'ldp'"),
        (
            "ldp:epsilom=1",
            r"unknown field of ldp 'epsilom'; did you mean 'epsilon'\? Available: dictionary, epsilon, memoize, subset_size",
        ),
        ("ldp:epsilon=much", "epsilon must be a number"),
        ("ldp:epsilon=nan", "epsilon must be a number"),
        ("ldp:epsilon=", "epsilon must be a number"),
        ("ldp:subset_size=1.5", "subset_size must be a whole number, not '1.5'"),
        ("ldp:dictionary=", "dictionary must be 'shipped' or the path of a file"),
        ("affine:lifting=hybird", "lifting must be one of random, adversarial, hybrid"),
        ("ldp:epsilon", "'epsilon' is not field=value"),
        ("ldp:epsilon=1,,", "'' is not field=value"),
        ("ldp:epsilon=1,epsilon=2", "epsilon is given twice"),
        ("ldp:epsilon=-1", "epsilon"),
        ("ldp:subset_size=0", "subset_size"),
        ("affine:dim=3", "even"),
        ("", "unknown defense ''"),
    ],
)
def test_errors(text: str, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        spec.read(text, discovery.DEFENSE)


def test_boolean_is_true_or_false() -> None:
    with pytest.raises(UserError, match="upright must be true or false, not '1'"):
        spec.read("sift:upright=1", discovery.EXTRACTOR)


def test_required_field() -> None:
    with pytest.raises(UserError, match=r"hloc needs path \(a path\): write hloc:path="):
        spec.read("hloc", discovery.EXTRACTOR)


def test_json_has_the_digest_of_files(tmp_path: Path) -> None:
    public, small = Public(), write_dictionary(tmp_path)
    assert spec.to_json_with_digests(LDP(epsilon=10, dictionary=small), public) == {
        "name": "ldp",
        "epsilon": 10.0,
        "subset_size": 2,
        "dictionary": public.dictionary(small).digest,
        "words": 0,
        "memoize": False,
    }
    renamed = Asset(Path(small).rename(tmp_path / "renamed.safetensors"))
    assert spec.to_json_with_digests(LDP(dictionary=renamed), public) == spec.to_json_with_digests(
        LDP(epsilon=10, dictionary=small), public
    )


def test_json_has_no_infinity_and_one_form_of_a_number(tmp_path: Path) -> None:
    small = write_dictionary(tmp_path)
    assert spec.to_json_with_digests(LDP(epsilon=math.inf, dictionary=small), Public())["epsilon"] == "inf"
    assert repr(spec.to_json(LDP(epsilon=10))["epsilon"]) == "10.0"


@pytest.mark.parametrize(("text", "value"), [("21/2", 10.5), ("0.1", 0.1), ("1/3", "1/3"), ("10", 10.0), ("inf", "inf")])
def test_fraction_is_exact(text: str, value: float | str) -> None:
    """Different configurations are different in records."""
    assert spec.to_json(spec.read(f"ldp:epsilon={text}", discovery.DEFENSE))["epsilon"] == value
    assert spec.to_json(spec.read("ldp:epsilon=0.3333333333333333", discovery.DEFENSE))["epsilon"] != "1/3"


def test_resolved_values_override_fields() -> None:
    from attacks.nearest import Nearest

    assert spec.to_json_with_digests(Nearest(), Public(), {"database": "sha256:00", "inversion": None}) == {
        "name": "nearest",
        "database": "sha256:00",
        "inversion": None,
    }
