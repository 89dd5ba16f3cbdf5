"""What the distribution ships: sizes, checksums, provenance, and the order that the attacks must have."""

import numpy as np
import pandas as pd
import pytest

import bench
from attacks.dia import DIA
from bench.codebook.public import ASSETS, Public
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.inversion import weights
from bench.inversion.reconstruct import painted
from bench.inversion.symmetry import symmetries
from bench.inversion.train import check_quantisation
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended
from metrics.ssim import SSIM

ORIENTED = ASSETS / "inversion-oriented.safetensors"  # of other features, which no defense here is compared on
NETWORKS = sorted(set(ASSETS.glob("inversion-*.safetensors")) - {ORIENTED})

THIRD = 266  # photographs that the dictionary was not made from


@pytest.fixture(scope="module")
def public():
    return Public()


def test_all_together_stay_under_95_megabytes():
    assert sum(path.stat().st_size for path in ASSETS.iterdir()) < 95e6


def test_dictionaries(public):
    k, z = public.dictionary("shipped"), public.dictionary("shipped-public")
    assert (len(k), len(z)) == (256_000, 128_000)
    for words in (k, z):
        assert len(np.unique(words.words, axis=0)) == len(words)
        assert words.words.any(axis=1).all()
    assert not k.photographs & z.photographs, "the attacker's database is made from other photographs"
    assert not k.photographs & {source.content_hash() for source in photographs.builtin()}
    assert not z.photographs & {source.content_hash() for source in photographs.builtin()}


def test_nothing_that_is_tuned_or_reported_on_made_a_dictionary(public, shared_data):
    names = [name for split in ("tune.txt", "test.txt") for name in (shared_data / split).read_text().split()]
    held_out = {photographs.Source(name, shared_data / "train" / name).content_hash() for name in names}
    assert len(held_out) == 200
    for asset in ("shipped", "shipped-public"):
        assert not held_out & public.dictionary(asset).photographs


def training(path):
    """A network's legs, as far as they must be equal: after the first on the third, each starts from a network of its own."""
    legs = weights.legs(weights.load(path).meta)
    common = 1 + next((number for number, leg in enumerate(legs) if leg["photographs"] == THIRD), len(legs))
    return legs[:common] + [leg | {"start": None} for leg in legs[common:]]


@pytest.mark.parametrize("path", NETWORKS, ids=lambda path: path.stem)
def test_networks_were_trained_alike_and_as_the_rule_demands(path):
    meta, alike = weights.load(path).meta, training(NETWORKS[0])
    assert training(path) == alike, "unequal training makes an unfair comparison"
    assert training(ORIENTED) != alike  # the control
    assert meta["photographs"] == THIRD
    if meta["quantisation_error"] is not None:
        check_quantisation(meta["quantisation_error"]["training"], meta["quantisation_error"]["validation"])


def test_every_release_that_must_be_served_is_served(public):
    served = [Undefended(), *(Affine(dim=dim) for dim in (2, 4, 8, 16))]
    served += [LDP(epsilon=epsilon, subset_size=m) for epsilon in (8.0, 10.0, 16.0) for m in (1, 2, 3, 4)]
    assert [DIA().explain_not_applicable(defense, Sift(), public) for defense in served] == [None] * len(served)
    assert "no adapted attacker" in (DIA().explain_not_applicable(LDP(epsilon=20), Sift(), public) or "")


def test_oriented_descriptors_have_an_attacker_of_their_own(public):
    """The network for upright ones paints them far worse, and is not used (control)."""
    oriented = Sift(upright=False)
    assert "no adapted attacker" in (DIA().explain_not_applicable(LDP(), oriented, public) or "")
    images = [source.path for source in photographs.builtin()[:3]]
    shown = [record["metrics"]["ssim"] for record in bench.run([Undefended()], [DIA()], images, extractor=oriented)]
    upright = weights.load(ASSETS / "inversion-none.safetensors")
    misled = []
    for path in images:
        pixels = photographs.read(path).pixels
        release = Undefended().protect(oriented.extract(pixels), public, np.random.default_rng(0))
        image = painted(upright.module, release, symmetries(oriented), np.empty(0, np.float32), 1, "invariant")
        misled.append(SSIM()(pixels / np.float32(255), image))
    assert np.mean(shown) > np.mean(misled) + 0.1


def test_the_main_job_repeats_bit_for_bit():
    image = [photographs.builtin()[0].path]
    once, again, other = (bench.run([LDP()], [DIA()], image, seed=seed) for seed in (5, 5, 6))
    assert once[0]["metrics"] == again[0]["metrics"] != other[0]["metrics"]


def ssim_by_defense(images):
    records = bench.run([Undefended(), LDP(epsilon=16), LDP(epsilon=10)], [DIA()], images)
    assert {record["status"] for record in records} == {"ok"}
    frame = pd.json_normalize(records)
    frame["epsilon"] = frame.get("defense.epsilon")
    return frame.pivot_table(index="unit", columns=frame["epsilon"].astype(object).fillna("raw"), values="metrics.ssim")


def assert_ordered(table: pd.DataFrame) -> None:
    """Raw > ε = 16 > ε = 10 on average."""
    raw, weak, strong = table["raw"].mean(), table[16.0].mean(), table[10.0].mean()
    assert raw > weak > strong, f"SSIM: raw {raw:.4f}, ε = 16 {weak:.4f}, ε = 10 {strong:.4f}"


def test_order_on_the_built_in_photographs():
    table = ssim_by_defense(None)
    assert len(table) == 7
    assert_ordered(table)
    with pytest.raises(AssertionError):  # negative control
        assert_ordered(table.rename(columns={10.0: 16.0, 16.0: 10.0}))


def test_order_on_the_test_photographs(shared_data):
    names = (shared_data / "test.txt").read_text().split()
    table = ssim_by_defense([shared_data / "train" / name for name in names])
    assert len(table) == 100
    assert_ordered(table)
