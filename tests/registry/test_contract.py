"""Contract tests of every registered plugin, and controls that break the contract."""

import ast
import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import draw_texture

import bench
from attacks.clustering import Clustering
from attacks.nearest import Nearest
from bench import testing
from bench.api import Attack, Defense, Extractor, Metric, Privacy, View
from bench.cache import store
from bench.codebook import dictionary
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.formats import tensor_file
from bench.geometry.nearest_words import unit_rows
from bench.images import photographs
from bench.images.photographs import Source
from bench.registry import discovery, fields, spec
from bench.registry.discovery import Kind
from bench.testing import check_applicability, check_attack, check_defense, check_extractor, check_metric
from bench.types import Descriptors, Features, Points
from defenses.affine import Affine
from defenses.ldp import LDP


def parametrize(kind: Kind) -> Any:
    return pytest.mark.parametrize("plugin", discovery.load_plugins(kind), ids=lambda plugin: plugin.name())


def build_plugin(plugin: type) -> Any:
    if fields.list_required(plugin):
        pytest.skip("has a required field, and a test of its own")
    return spec.build(plugin, {})


@parametrize(discovery.DEFENSE)
def test_defense(plugin: type[Defense], tmp_path: Path) -> None:
    defense = build_plugin(plugin)
    small = write_dictionary(tmp_path)
    check_defense(dataclasses.replace(defense, **dict.fromkeys(fields.list_assets(defense), small)), Public(), draw_features())


@parametrize(discovery.METRIC)
def test_metric(plugin: type[Metric]) -> None:
    try:
        metric = build_plugin(plugin)
    except UserError as error:  # it needs an optional extra that is not installed
        pytest.skip(str(error))
    check_metric(metric)


@parametrize(discovery.EXTRACTOR)
def test_extractor(plugin: type[Extractor], tmp_path: Path) -> None:
    try:
        extractor = build_plugin(plugin)
    except UserError as error:  # its weights are in a package that is not installed
        pytest.skip(str(error))
    check_extractor(extractor, photographs.crop_square(draw_texture(0), 256))


PAIRS = [
    pytest.param(attack, defense, id=f"{attack.name()}-{defense.name()}")
    for attack in discovery.load_plugins(discovery.ATTACK)
    for defense in discovery.load_plugins(discovery.DEFENSE)
]


@pytest.mark.slow
@pytest.mark.parametrize(("attack", "defense"), PAIRS)
def test_attack(attack: type[Attack], defense: type[Defense], tmp_path: Path) -> None:
    attacker, defender = build_plugin(attack), build_plugin(defense)
    if "database" in fields.list_assets(attacker):
        attacker = dataclasses.replace(attacker, database=write_dictionary(tmp_path))
    if check_applicability(attacker, defender, Sift(), Public()):
        check_attack(attacker, defender, Sift(), draw_features(20))


# ---- learned features: signed, without exact zeros, and of another length


@dataclasses.dataclass(frozen=True, kw_only=True)
class Signed(Extractor):
    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        return draw_features(20, length=64, signed=True)


def adapt(plugin: type, **given: Any) -> Any:
    """Return the plugin for signed descriptors: with `given` dictionaries, and naive LDP on float32."""
    built = build_plugin(plugin)
    element = {"element": "float32x64"} if plugin.name() == "naive-ldp" else {}
    return dataclasses.replace(built, **{name: value for name, value in given.items() if hasattr(built, name)}, **element)


@parametrize(discovery.DEFENSE)
def test_defense_of_signed_descriptors(plugin: type[Defense], tmp_path: Path) -> None:
    words = write_dictionary(tmp_path, length=64, signed=True)
    check_defense(adapt(plugin, dictionary=words, database=words), Public(), draw_features(length=64, signed=True))


@parametrize(discovery.DEFENSE)
def test_dictionary_of_sift_is_refused(plugin: type[Defense], tmp_path: Path) -> None:
    """Negative control."""
    for length, message in ((64, "have length 64, the words of .* 128"), (128, "negative components")):
        defense = build_plugin(plugin) if length == 128 and plugin.name() != "naive-ldp" else adapt(plugin)
        if not fields.list_assets(defense):
            continue
        with pytest.raises(UserError, match=message):
            defense.protect(draw_features(length=length, signed=True), Public(), np.random.default_rng(0))


@parametrize(discovery.DEFENSE)
def test_signed_words_are_refused_for_sift(plugin: type[Defense], tmp_path: Path) -> None:
    """Words of another extractor with equal length."""
    defense = build_plugin(plugin)
    if not fields.list_assets(defense):
        return
    words = write_dictionary(tmp_path, length=128, signed=True)
    with pytest.raises(UserError, match=r"8-bit vectors of SIFT, the words of .* have signs"):
        adapt(plugin, dictionary=words, database=words).protect(draw_features(), Public(), np.random.default_rng(0))


@pytest.mark.parametrize("attack", [Nearest, Clustering])
def test_public_database_of_sift_is_refused(attack: type[Attack], tmp_path: Path, images: Path) -> None:
    """Before the run, since an attack would compare vectors of different spaces. The control is a database of these features."""
    words = write_dictionary(tmp_path, length=64, signed=True)
    defense = Affine(database=words)
    with pytest.raises(UserError, match=rf"length 64, the words of shipped-public \(of {attack.name()}\) 128"):
        bench.run([defense], [attack()], images, extractor=Signed())
    small = {"neighbours": 5, "others": 0} if attack is Clustering else {}
    records = bench.run([defense], [attack(database=words, **small)], images, extractor=Signed())
    assert {record["status"] for record in records} == {"ok"}


REASONS = {"lattice": "does not declare 8-bit descriptors", "sparsity": "does not declare any"}


@pytest.mark.slow
@pytest.mark.parametrize(("attack", "defense"), PAIRS)
def test_attack_on_signed_descriptors(attack: type[Attack], defense: type[Defense], tmp_path: Path) -> None:
    words, public_words = (write_dictionary(tmp_path, 512, seed, 64, signed=True) for seed in (1, 2))
    attacker, defender = adapt(attack, database=public_words), adapt(defense, dictionary=words, database=words)
    if issubclass(defender.releases, attacker.accepts) and attack.name() in REASONS:
        assert REASONS[attack.name()] in str(attacker.explain_not_applicable(defender, Signed(), Public()))
    if check_applicability(attacker, defender, Signed(), Public()):
        check_attack(attacker, defender, Signed(), draw_features(20, length=64, signed=True))


# ---- negative controls: each violates one rule, and its check fails


@dataclasses.dataclass(frozen=True, kw_only=True)
class Leaky(Defense):
    releases = Descriptors

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        return Descriptors(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, descriptors=secret.descriptors)

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shifted(Leaky):
    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        return Descriptors(
            positions=Points(keypoints=secret.keypoints + 1), size=secret.size, descriptors=secret.descriptors.copy()
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Careless(Leaky):
    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        order = np.random.default_rng().permutation(len(secret))  # its own randomness
        return Descriptors(
            positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, descriptors=secret.descriptors[order]
        )


@pytest.mark.parametrize(
    ("defense", "complaint"), [(Leaky(), "shares memory"), (Shifted(), "keypoints"), (Careless(), "same rng")]
)
def test_wrong_defense_is_detected(defense: Defense, complaint: str) -> None:
    with pytest.raises(AssertionError, match=complaint):
        check_defense(defense, Public(), draw_features())


def test_extractor_with_keypoints_in_order_of_response_is_detected() -> None:
    class Ranked(Sift):
        def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
            features = super().extract(image, source)
            return dataclasses.replace(
                features, keypoints=features.keypoints[::-1], descriptors=features.descriptors[::-1], codes=features.codes[::-1]
            )

    with pytest.raises(AssertionError, match="order of keypoints"):
        check_extractor(Ranked(), photographs.crop_square(draw_texture(0), 256))


def test_peeking_attack_is_detected() -> None:
    from fake_plugins.guess import Guess

    class Peeking(Guess):
        accepts = (Descriptors,)

        def recover(self, view: View, rng: np.random.Generator) -> np.ndarray:
            assert isinstance(view.release, Descriptors)
            return view.release.descriptors

    with pytest.raises(AssertionError, match="saw more"):
        check_attack(Peeking(), Leaky(), Sift(), draw_features())


def test_attack_that_reads_the_cache_is_detected(tmp_path: Path) -> None:
    from fake_plugins.guess import Guess

    class CachedFeatures(Guess):
        def recover(self, view: View, rng: np.random.Generator) -> np.ndarray:
            (features,) = (entry.path for entry in store.list_entries() if entry.kind == "features")
            return unit_rows(tensor_file.load(features, "features")[0]["descriptors"] + np.float32(1e-3))

    class CachedWords(Guess):
        def recover(self, view: View, rng: np.random.Generator) -> np.ndarray:
            (words,) = (entry.path for entry in store.list_entries() if entry.kind == "words")
            indices = tensor_file.load(words, "words")[0]["words"]
            return unit_rows(dictionary.load(Path(small)).words[indices])

    small = write_dictionary(tmp_path)
    for attack in (CachedFeatures(), CachedWords()):
        with pytest.raises(AssertionError, match="saw more"):
            check_attack(attack, LDP(dictionary=small), Sift(), draw_features())


VIOLATIONS = """
import dataclasses
import numpy as np
from test_contract import Careless, Leaky, Shifted
from bench import testing
from bench.api import Attack, Dataset, ImageAttack, Metric
from bench.codebook.examples import draw_features
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.images.scene import Scene
from bench.tasks.reconstruction import Reconstruction
from bench.types import Descriptors
from fakes import draw_texture

@dataclasses.dataclass(frozen=True, kw_only=True)
class Bright(ImageAttack):
    accepts = (Descriptors,)
    def reconstruct(self, view, rng):
        return np.full((*view.release.size[::-1], 3), 2, np.float32)

@dataclasses.dataclass(frozen=True, kw_only=True)
class Narrow(Metric):
    compares, unit, range, higher_is_better_for = "descriptors", "", (0.0, 0.5), "defender"
    def __call__(self, truth, estimate):
        return 1.0 - float(np.array_equal(truth, estimate))

@dataclasses.dataclass(frozen=True, kw_only=True)
class Empty(Dataset):
    def scene(self):
        return Scene(name="empty", references=(), queries=())

class Ranked(Sift):
    def extract(self, image, source=None):
        features = super().extract(image, source)
        parts = {name: getattr(features, name)[::-1] for name in ("keypoints", "descriptors", "codes")}
        return dataclasses.replace(features, **parts)

secret, image = draw_features(20), photographs.crop_square(draw_texture(0), 256)
for check, arguments in (
    (testing.check_defense, (Leaky(), Public(), secret)),
    (testing.check_defense, (Shifted(), Public(), secret)),
    (testing.check_defense, (Careless(), Public(), secret)),
    (testing.check_attack, (Bright(), Leaky(), Sift(), secret)),
    (testing.check_metric, (Narrow(),)),
    (testing.check_extractor, (Ranked(), image)),
    (testing.check_task, (Reconstruction(), Leaky(), Sift(), secret)),
    (testing.check_dataset, (Empty(),)),
):
    try:
        check(*arguments)
    except AssertionError as error:
        print(f"{check.__name__}: {error}")
    else:
        print(f"{check.__name__} did not notice")
"""


@pytest.mark.slow
@pytest.mark.parametrize("options", [[], ["-O"], ["-OO"]], ids=str)
def test_the_contract_holds_under_optimisation(options: list[str]) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    command = [sys.executable, *options, "-c", VIOLATIONS]
    lines = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.splitlines()
    assert lines == [
        "check_defense: the release shares memory with the secret",
        "check_defense: the released keypoints differ from the secret ones",
        "check_defense: the same rng gave another release",
        "check_attack: the result has values above 1",
        "check_metric: the value is outside the declared range",
        "check_extractor: the order of keypoints would reveal their strength: return by_position()",
        "check_task: check_task is for tasks that take no attack",
        "check_dataset: the scene is empty",
    ]


def test_no_check_is_a_bare_assertion() -> None:
    assert not [node for node in ast.walk(ast.parse(Path(str(testing.__file__)).read_text())) if isinstance(node, ast.Assert)]
