"""The shipped files: sizes, checksums, provenance, and the expected order of the attacks' results."""

import numpy as np
import pandas as pd
import pytest

import bench
from attacks.dia import DIA
from attacks.keypoints import Keypoints
from bench.codebook.public import ASSETS, SHIPPED, Public
from bench.context import weights as context
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.inversion import weights
from bench.inversion.reconstruct import reconstruct_image
from bench.inversion.symmetry import find_symmetries
from bench.inversion.train import check_quantisation
from defenses.affine import Affine
from defenses.exponential import Exponential
from defenses.ldp import LDP
from defenses.naive_ldp import NaiveLDP
from defenses.none import Undefended
from defenses.plateau import Plateau
from defenses.privunit import PrivUnit
from metrics.ssim import SSIM

WORDS = ASSETS / "inversion-ldp.safetensors"  # trained longer than the others, with a context model
NETWORKS = [ASSETS / f"inversion-{name}.safetensors" for name in ("affine", "none")]  # compared with each other in tables

THIRD = 266  # photographs that the dictionary was not built from


@pytest.fixture(scope="module")
def public():
    return Public()


def test_all_together_stay_under_95_megabytes():
    assert sum(path.stat().st_size for path in ASSETS.iterdir()) < 95e6


@pytest.mark.slow
def test_dictionaries(public):
    k, z, xfeat, aliked = (public.dictionary(name) for name in ("shipped", "shipped-public", "shipped-xfeat", "shipped-aliked"))
    assert (k.words.shape, z.words.shape) == ((256_000, 128), (128_000, 128))
    assert (xfeat.words.shape, aliked.words.shape) == ((16_000, 64), (16_000, 128))
    assert k.photographs == xfeat.photographs == aliked.photographs
    for words in (k, z, xfeat, aliked):
        assert len(np.unique(words.words, axis=0)) == len(words)
        assert words.words.any(axis=1).all()
    assert not k.photographs & z.photographs, "the attacker's database must be built from other photographs"
    assert not k.photographs & {source.content_hash() for source in photographs.list_builtin()}
    assert not z.photographs & {source.content_hash() for source in photographs.list_builtin()}


def test_no_dictionary_was_built_from_tuning_or_test_photographs(public, shared_data):
    names = [name for split in ("tune.txt", "test.txt") for name in (shared_data / split).read_text().split()]
    held_out = {photographs.Source(name, shared_data / "train" / name).content_hash() for name in names}
    assert len(held_out) == 200
    for asset in SHIPPED:
        assert not held_out & public.dictionary(asset).photographs


def select_stages(path):
    """Return the training stages that must be equal. After the first on the third, initial checkpoints may differ."""
    stages = weights.list_training_stages(weights.load(path).meta)
    common = 1 + next((number for number, stage in enumerate(stages) if stage["photographs"] == THIRD), len(stages))
    return stages[:common] + [stage | {"start": None} for stage in stages[common:]]


@pytest.mark.parametrize("path", NETWORKS, ids=lambda path: path.stem)
def test_networks_have_equal_training_and_follow_the_rules(path):
    meta, expected = weights.load(path).meta, select_stages(NETWORKS[0])
    assert select_stages(path) == expected, "unequal training makes an unfair comparison"
    assert select_stages(ASSETS / "inversion-oriented.safetensors") != expected  # the control
    assert meta["photographs"] == THIRD
    if meta["quantisation_error"] is not None:
        check_quantisation(meta["quantisation_error"]["training"], meta["quantisation_error"]["validation"])


def test_the_network_for_words_is_trained_longer_and_follows_the_rules():
    """It starts from the network for raw descriptors. The defense that it attacks cannot gain from a weaker attacker."""
    network, start = weights.load(WORDS), weights.load(ASSETS / "inversion-none.safetensors")
    stages = weights.list_training_stages(network.meta)
    assert (stages[:-1], stages[-1]["start"]) == (weights.list_training_stages(start.meta), start.digest)
    own = [stage for stage in weights.list_training_stages(weights.load(NETWORKS[0]).meta) if stage["photographs"] == THIRD]
    assert stages[-1]["crops"] > sum(stage["crops"] for stage in own)
    assert network.meta["context"] == context.load(ASSETS / "context.safetensors").digest
    check_quantisation(**network.meta["quantisation_error"])


def test_every_required_release_is_supported(public):
    defenses = [Undefended(), *(Affine(dim=dim) for dim in (2, 4, 8, 16))]
    defenses += [LDP(epsilon=epsilon, subset_size=m) for epsilon in (8.0, 10.0, 16.0) for m in (1, 2, 3, 4)]
    defenses += [Affine(lifting=lifting, dim=dim) for lifting in ("random", "adversarial") for dim in (2, 4, 16)]
    defenses += [Plateau(epsilon=epsilon) for epsilon in (8.0, 10.0, 16.0)]
    defenses += [Exponential(epsilon=epsilon) for epsilon in (8.0, 10.0, 32.0)]
    defenses += [PrivUnit(), PrivUnit(epsilon=32.0), NaiveLDP(), NaiveLDP(epsilon=32.0)]
    assert [DIA().explain_not_applicable(defense, Sift(), public) for defense in defenses] == [None] * len(defenses)
    assert "no adapted attacker" in (DIA().explain_not_applicable(LDP(epsilon=20), Sift(), public) or "")


@pytest.mark.slow
def test_oriented_descriptors_have_an_attacker_of_their_own(public):
    """The network for upright descriptors reconstructs them far worse, and is not used (control)."""
    oriented = Sift(upright=False)
    defenses = [Undefended(), *(Affine(dim=dim) for dim in (2, 4, 16)), *(LDP(epsilon=epsilon) for epsilon in (8.0, 10.0, 16.0))]
    assert [DIA().explain_not_applicable(defense, oriented, public) for defense in defenses] == [None] * len(defenses)
    assert Keypoints().explain_not_applicable(LDP(), oriented, public) is None
    assert "no adapted attacker" in (DIA().explain_not_applicable(LDP(epsilon=20), oriented, public) or "")
    images = [source.path for source in photographs.list_builtin()[:3]]
    adapted = [record["metrics"]["ssim"] for record in bench.run([Undefended()], [DIA()], images, extractor=oriented)]
    upright = weights.load(ASSETS / "inversion-none.safetensors")
    mismatched = []
    for path in images:
        pixels = photographs.read(path).pixels
        release = Undefended().protect(oriented.extract(pixels), public, np.random.default_rng(0))
        image = reconstruct_image(upright.module, release, find_symmetries(oriented), np.empty(0, np.float32), 1, "invariant")
        mismatched.append(SSIM()(pixels / np.float32(255), image))
    assert np.mean(adapted) > np.mean(mismatched) + 0.1


@pytest.mark.slow
def test_the_main_run_is_reproducible_bit_for_bit():
    image = [photographs.list_builtin()[0].path]
    once, again, other = (bench.run([LDP()], [DIA()], image, seed=seed) for seed in (5, 5, 6))
    assert once[0]["metrics"] == again[0]["metrics"] != other[0]["metrics"]


def measure_ssim(images):
    records = bench.run([Undefended(), LDP(epsilon=16), LDP(epsilon=10)], [DIA()], images)
    assert {record["status"] for record in records} == {"ok"}
    frame = pd.json_normalize(records)
    frame["epsilon"] = frame.get("defense.epsilon")
    return frame.pivot_table(index="sample", columns=frame["epsilon"].astype(object).fillna("raw"), values="metrics.ssim")


def assert_ordered(table: pd.DataFrame) -> None:
    """Raw > ε = 16 > ε = 10 on average."""
    raw, weak, strong = table["raw"].mean(), table[16.0].mean(), table[10.0].mean()
    assert raw > weak > strong, f"SSIM: raw {raw:.4f}, ε = 16 {weak:.4f}, ε = 10 {strong:.4f}"


@pytest.mark.exhaustive
def test_order_on_the_built_in_photographs():
    table = measure_ssim(None)
    assert len(table) == 7
    assert_ordered(table)
    with pytest.raises(AssertionError):  # negative control
        assert_ordered(table.rename(columns={10.0: 16.0, 16.0: 10.0}))


@pytest.mark.exhaustive
def test_order_on_the_test_photographs(shared_data):
    names = (shared_data / "test.txt").read_text().split()
    table = measure_ssim([shared_data / "train" / name for name in names])
    assert len(table) == 100
    assert_ordered(table)
