"""What attacks on subspaces may depend on: the subspace and not its basis; and knowing more never hurts, on average."""

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from bench.api import Asset, Attack, DescriptorAttack, Trial
from bench.codebook import dictionary
from bench.codebook.public import Public
from bench.core.randomness import randomness
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.registry import discovery, spec
from bench.runner.other_releases import OtherReleases
from bench.tasks.reconstruction import RELEASES, Reconstruction, view
from bench.testing import NO_SAMPLE, shot
from bench.types import Features, Floats, Knowledge, Release, Subspaces
from defenses.affine import Affine
from defenses.ldp import LDP
from leaderboard.intervals import interval
from metrics.angle import Angle

SUB_DATABASES = 4  # fewer and smaller than in earnest, so that few releases of others cover them
KEYPOINTS = 150


@pytest.fixture(scope="module")
def database(tmp_path_factory) -> Asset:
    """1,600 words of the shipped database."""
    words = Public().dictionary("shipped", 1600).words
    path = tmp_path_factory.mktemp("database") / "W.safetensors"
    dictionary.save(path, words, {"photographs": []})
    return Asset(path)


@pytest.fixture(scope="module")
def secret() -> Features:
    """Some of the astronaut's features."""
    found = Sift().extract(photographs.read(photographs.builtin()[0].path).pixels)
    return found.take(np.sort(np.random.default_rng(0).choice(len(found), KEYPOINTS, replace=False)))


def trial(attack: Attack, defense: Affine | LDP, secret: Features, others: int | None = None) -> Trial:
    """An attack on one release; `others` limits how many releases of other photographs there are."""
    public = Public()
    population = OtherReleases(photographs.builtin()[1:4], Sift(max_keypoints=400), defense, public, randomness)

    def strangers(count: int) -> Iterator[Release]:
        return population.without("astronaut")(count if others is None else min(count, others))

    return Trial(
        sample=NO_SAMPLE,
        images=(shot(secret, defense.protect(secret, public, np.random.default_rng(1))),),
        defense=defense,
        attack=attack,
        extractor=Sift(),
        public=public,
        metrics=(),
        rng=np.random.default_rng(2),
        others=strangers,
        repeats=tuple(defense.protect(secret, public, np.random.default_rng([3, turn])) for turn in range(attack.repeats())),
    )


def estimate(carried_out: Trial) -> Floats:
    assert isinstance(carried_out.attack, DescriptorAttack)
    return carried_out.attack.recover(view(carried_out), np.random.default_rng(4))


def angles(truth: Floats, found: Floats) -> Floats:
    """Degrees of each keypoint."""
    return np.array([Angle()(truth[row : row + 1], found[row : row + 1]) for row in range(len(truth))])


def rewritten(release: Subspaces, rng: np.random.Generator) -> Subspaces:
    """The same subspaces by other origins and other orthonormal bases."""
    turn = np.linalg.qr(rng.normal(size=(len(release), release.dim, release.dim)))[0]
    bases = turn @ release.bases.astype(np.float64)
    steps = rng.normal(size=(len(release), release.dim))
    origins = release.origins + np.einsum("nm,nmd->nd", steps, bases)
    return dataclasses.replace(release, origins=origins.astype(np.float32), bases=bases.astype(np.float32))


def on_subspaces() -> list[type[Attack]]:
    return [
        attack
        for attack in discovery.everything(discovery.ATTACK)
        if issubclass(attack, DescriptorAttack) and Subspaces in attack.accepts
    ]


@pytest.mark.parametrize("plugin", on_subspaces(), ids=lambda plugin: plugin.name())
def test_the_basis_that_was_drawn_says_nothing(plugin, database, secret):
    defense = Affine(dim=4, database=database, sub_databases=SUB_DATABASES)
    attack = spec.build(plugin, {})
    assert Reconstruction().explain_not_applicable(defense, attack, Sift(), Public()) is None
    first = trial(attack, defense, secret)
    rng = np.random.default_rng(5)
    repeats = tuple(rewritten(release, rng) for release in first.repeats)
    second = dataclasses.replace(first.released(rewritten(first.release, rng)), repeats=repeats)
    apart = angles(estimate(first), estimate(second))
    assert np.mean(apart < 0.1) > 0.95  # degrees; float32 turns a few close decisions over
    if not attack.needs & {Knowledge.REPEATED_RELEASES}:
        turned = secret.take(np.roll(np.arange(len(secret)), 1))
        elsewhere = first.released(defense.protect(turned, Public(), np.random.default_rng(6)))
        assert np.median(angles(estimate(first), estimate(elsewhere))) > 5  # negative control: other subspaces


def less(attack: Attack, secret: Features, defense: Affine | LDP) -> tuple[Floats, Floats]:
    """Angles to the truth with all that the attack may know, and with less of it."""
    full = trial(attack, defense, secret)
    if Knowledge.REPEATED_RELEASES in attack.needs:
        poor = trial(dataclasses.replace(attack, releases=1), defense, secret)
    elif Knowledge.OTHER_RELEASES in attack.needs:
        poor = trial(attack, defense, secret, others=0)
    else:
        poor = full
    seen = view(poor)
    known = dict(seen.knowledge)
    for what in attack.needs & {Knowledge.DATABASE, Knowledge.PUBLIC_DATABASE}:
        whole = known[what]()
        known[what] = lambda whole=whole: whole.first(len(whole) // 8)
    assert isinstance(poor.attack, DescriptorAttack)
    worse = poor.attack.recover(dataclasses.replace(seen, knowledge=known), np.random.default_rng(4))
    return angles(secret.descriptors, estimate(full)), angles(secret.descriptors, worse)


KNOWING = [
    attack
    for attack in discovery.everything(discovery.ATTACK)
    if issubclass(attack, DescriptorAttack) and attack.needs & (RELEASES | {Knowledge.DATABASE, Knowledge.PUBLIC_DATABASE})
]


@pytest.mark.parametrize("plugin", KNOWING, ids=lambda plugin: plugin.name())
def test_nobody_gains_by_knowing_less(plugin, database, secret):
    attack = spec.build(plugin, {})
    with_all, with_less = less(attack, secret, Affine(dim=4, database=database, sub_databases=SUB_DATABASES))
    gain = interval(with_all - with_less)  # degrees by which less knowledge is better
    assert gain.low <= 0, f"{attack.name()} is better without: by {gain}"


def test_a_gain_by_knowing_less_would_be_noticed(database, secret):
    """Negative control: with the two turned around the interval does not hold zero."""
    with_all, with_less = less(
        spec.read("database", discovery.ATTACK), secret, Affine(dim=4, database=database, sub_databases=SUB_DATABASES)
    )
    assert interval(with_less - with_all).low > 0
