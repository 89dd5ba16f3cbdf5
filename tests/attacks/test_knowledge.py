"""Attacks on subspaces depend on the subspace and not on its basis; more knowledge does not hurt on average."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from bench.api import Attack, DescriptorAttack
from bench.codebook import dictionary
from bench.codebook.public import Public
from bench.core.randomness import derive_generator
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.registry import discovery, spec
from bench.runner.other_releases import ReleasePool
from bench.settings import Asset
from bench.task_api import Trial
from bench.tasks.reconstruction import RELEASES, Reconstruction, build_view
from bench.testing import EMPTY_SAMPLE, build_image
from bench.threat_model import DefenseDatabase, OtherReleases, PublicDatabase, RepeatedReleases
from bench.types import Features, Floats, Release, Subspaces
from defenses.affine import Affine
from defenses.ldp import LDP
from leaderboard.intervals import interval
from metrics.angle import Angle

SUB_DATABASES = 4  # fewer and smaller than the defaults, so that few other releases cover them
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
    """Some features of the astronaut photograph."""
    found = Sift().extract(photographs.read(photographs.list_builtin()[0].path).pixels)
    return found.take(np.sort(np.random.default_rng(0).choice(len(found), KEYPOINTS, replace=False)))


def build_trial(attack: Attack, defense: Affine | LDP, secret: Features, others: int | None = None) -> Trial:
    """Build a trial of an attack on one release. `others` limits the number of releases of other photographs."""
    public = Public()
    pool = ReleasePool(photographs.list_builtin()[1:4], Sift(max_keypoints=400), defense, public, derive_generator)

    def draw_others(count: int) -> Iterator[Release]:
        return pool.without("astronaut")(count if others is None else min(count, others))

    return Trial(
        sample=EMPTY_SAMPLE,
        images=(build_image(secret, defense.protect(secret, public, np.random.default_rng(1))),),
        defense=defense,
        attack=attack,
        extractor=Sift(),
        public=public,
        metrics=(),
        rng=np.random.default_rng(2),
        others=draw_others,
        repeats=tuple(defense.protect(secret, public, np.random.default_rng([3, turn])) for turn in range(attack.repeats())),
    )


def estimate(trial: Trial) -> Floats:
    assert isinstance(trial.attack, DescriptorAttack)
    return trial.attack.recover(build_view(trial), np.random.default_rng(4))


def measure_angles(truth: Floats, found: Floats) -> Floats:
    """Return the angle of each keypoint in degrees."""
    return np.array([Angle()(truth[row : row + 1], found[row : row + 1]) for row in range(len(truth))])


def reparameterise(release: Subspaces, rng: np.random.Generator) -> Subspaces:
    """Return the same subspaces with other origins and orthonormal bases."""
    turn = np.linalg.qr(rng.normal(size=(len(release), release.dim, release.dim)))[0]
    bases = turn @ release.bases.astype(np.float64)
    steps = rng.normal(size=(len(release), release.dim))
    origins = release.origins + np.einsum("nm,nmd->nd", steps, bases)
    return dataclasses.replace(release, origins=origins.astype(np.float32), bases=bases.astype(np.float32))


def list_subspace_attacks() -> list[Any]:
    """Return the attacks on subspaces: a fast one for `make test`, all others for the exhaustive tests."""
    return [
        pytest.param(attack, marks=pytest.mark.slow if attack.name() == "nearest" else pytest.mark.exhaustive, id=attack.name())
        for attack in discovery.load_plugins(discovery.ATTACK)
        if issubclass(attack, DescriptorAttack) and Subspaces in attack.accepts
    ]


@pytest.mark.parametrize("plugin", list_subspace_attacks())
def test_the_random_basis_has_no_effect(plugin, database, secret):
    defense = Affine(dim=4, database=database, sub_databases=SUB_DATABASES)
    attack = spec.build(plugin, {})
    assert Reconstruction().explain_not_applicable(defense, attack, Sift(), Public()) is None
    first = build_trial(attack, defense, secret)
    rng = np.random.default_rng(5)
    repeats = tuple(reparameterise(release, rng) for release in first.repeats)
    second = dataclasses.replace(first.with_release(reparameterise(first.release, rng)), repeats=repeats)
    apart = measure_angles(estimate(first), estimate(second))
    assert np.mean(apart < 0.1) > 0.95  # degrees; float32 changes a few close decisions
    if not attack.needs & {RepeatedReleases}:
        turned = secret.take(np.roll(np.arange(len(secret)), 1))
        elsewhere = first.with_release(defense.protect(turned, Public(), np.random.default_rng(6)))
        assert np.median(measure_angles(estimate(first), estimate(elsewhere))) > 5  # negative control: other subspaces


def compare_knowledge(attack: Attack, secret: Features, defense: Affine | LDP) -> tuple[Floats, Floats]:
    """Return angles to the truth with all knowledge of the attack, and with less of it."""
    full = build_trial(attack, defense, secret)
    if RepeatedReleases in attack.needs:
        poor = build_trial(dataclasses.replace(attack, releases=1), defense, secret)
    elif OtherReleases in attack.needs:
        poor = build_trial(attack, defense, secret, others=0)
    else:
        poor = full
    seen = build_view(poor)
    known = dict(seen.knowledge)
    for what in attack.needs & {DefenseDatabase, PublicDatabase}:
        whole = known[what]()
        fewer = dataclasses.replace(whole, words=whole.words[: len(whole.words) // 8])
        known[what] = lambda fewer=fewer: fewer
    assert isinstance(poor.attack, DescriptorAttack)
    worse = poor.attack.recover(dataclasses.replace(seen, knowledge=known), np.random.default_rng(4))
    return measure_angles(secret.descriptors, estimate(full)), measure_angles(secret.descriptors, worse)


WITH_KNOWLEDGE = [
    attack
    for attack in discovery.load_plugins(discovery.ATTACK)
    if issubclass(attack, DescriptorAttack)
    and Subspaces in attack.accepts
    and attack.needs & (RELEASES | {DefenseDatabase, PublicDatabase})
]


@pytest.mark.slow
@pytest.mark.parametrize("plugin", WITH_KNOWLEDGE, ids=lambda plugin: plugin.name())
def test_less_knowledge_does_not_help(plugin, database, secret):
    attack = spec.build(plugin, {})
    with_all, with_less = compare_knowledge(attack, secret, Affine(dim=4, database=database, sub_databases=SUB_DATABASES))
    gain = interval(with_all - with_less)  # degrees by which less knowledge is better
    assert gain.low <= 0, f"{attack.name()} is better with less knowledge, by {gain}"


@pytest.mark.slow
def test_a_gain_by_less_knowledge_would_be_detected(database, secret):
    """Negative control: with exchanged sides, the interval does not contain zero."""
    with_all, with_less = compare_knowledge(
        spec.read("database", discovery.ATTACK), secret, Affine(dim=4, database=database, sub_databases=SUB_DATABASES)
    )
    assert interval(with_less - with_all).low > 0
