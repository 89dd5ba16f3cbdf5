"""`bench.protect`: the random generator, and devices with memoized defenses."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest

import bench
from bench.codebook.examples import draw_features
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.mechanisms import protection
from bench.registry.composed import Composed
from bench.settings import Asset
from bench.testing import are_equal
from bench.types import Descriptors, WordSets
from defenses.ldp import LDP
from defenses.lines import RandomLines
from defenses.none import Undefended


def words(release: object) -> np.ndarray:
    assert isinstance(release, WordSets)
    assert release.words is not None
    return release.words


def test_releases_are_independent(small: Asset) -> None:
    features, defense = draw_features(), LDP(dictionary=small)
    assert not are_equal(bench.protect(features, defense), bench.protect(features, defense))
    assert isinstance(bench.protect(features, Undefended()), Descriptors)


def test_the_key_is_the_operating_systems(small: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []

    def draw_bytes(count: int) -> bytes:
        sizes.append(count)
        return b"\x07" * count

    monkeypatch.setattr(protection.secrets, "token_bytes", draw_bytes)
    features, defense = draw_features(), LDP(dictionary=small)
    first, again = bench.protect(features, defense), bench.protect(features, defense)
    assert sizes == [32, 32]
    assert are_equal(first, again)  # a function of these bits alone
    assert are_equal(first, defense.protect(features, Public(), protection.create_generator(b"\x07" * 32)))


def test_the_cipher_is_chacha20() -> None:
    """The keystream of RFC 8439, A.1, test vectors 1 and 2 (one key of zeros, blocks 0 and 1), and of a key of its draft."""
    zeros = protection.create_generator(bytes(32)).bytes(128)
    assert zeros[:32].hex() == "76b8e0ada0f13d90405d6ae55386bd28bdd219b8a08ded1aa836efcc8b770dc7"
    assert zeros[64:96].hex() == "9f07e7be5551387a98ba977c732d080dcb0f29a048e3656912c6533e32ee7aed"
    one = protection.create_generator(bytes(31) + b"\x01").bytes(32)
    assert one.hex() == "4540f05a9f1fb296d7736e7b208e3c96eb4fe1834688d2604f450952ed432d41"


# ---- memoized defenses


def test_a_device_gives_equal_words_equal_answers(small: Asset, tmp_path: Path) -> None:
    defense, features, key = LDP(dictionary=small, memoize=True), draw_features(200), tmp_path / "key"
    first, again = (words(bench.protect(features, defense, device=key)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    nearest = Public().nearest_words(small, features)
    for word in set(nearest.tolist()):
        assert len({tuple(row) for row in first[nearest == word].tolist()}) == 1
    reversed_features = features.take(np.arange(200)[::-1])
    np.testing.assert_array_equal(words(bench.protect(reversed_features, defense, device=key)), first[::-1])
    # The controls: another device answers differently, and so does a defense without memoization.
    assert (words(bench.protect(features, defense, device=tmp_path / "other")) != first).any()
    fresh = LDP(dictionary=small)
    assert (words(bench.protect(features, fresh)) != words(bench.protect(features, fresh))).any()


def test_another_configuration_has_other_answers(small: Asset, tmp_path: Path) -> None:
    """Under one key, the bits that decide whether the true word is included would be the same at every ε."""
    features, key = draw_features(300), tmp_path / "key"
    key.write_bytes(bytes(range(32)))  # one device: the fraction included depends on its draws
    rows = [words(bench.protect(features, LDP(dictionary=small, memoize=True, epsilon=e), device=key)) for e in (4.0, 4.01)]
    nearest = Public().nearest_words(small, features)
    included = [(row == nearest[:, None]).any(axis=1) for row in rows]
    assert 0.02 < included[0].mean() < 0.5
    assert (included[0] != included[1]).mean() > 0.02
    equal_keys = [
        LDP(dictionary=small, memoize=True, epsilon=e).protect(features, Public(), protection.create_generator(key.read_bytes()))
        for e in (4.0, 4.01)
    ]
    included = [(words(release) == nearest[:, None]).any(axis=1) for release in equal_keys]
    assert (included[0] != included[1]).mean() < 0.01  # the control: one key for both


def test_the_key_is_created_once_for_its_owner(small: Asset, tmp_path: Path) -> None:
    defense, key = LDP(dictionary=small, memoize=True), tmp_path / "key"
    bench.protect(draw_features(), defense, device=key)
    key_bytes = key.read_bytes()
    assert len(key_bytes) == 32
    assert len(set(key_bytes)) > 8
    assert stat.S_IMODE(os.stat(key).st_mode) == 0o600
    bench.protect(draw_features(), defense, device=str(key))
    assert key.read_bytes() == key_bytes


def test_missing_and_invalid_keys_are_refused(small: Asset, tmp_path: Path) -> None:
    features, memoized = draw_features(), LDP(dictionary=small, memoize=True)
    with pytest.raises(UserError, match=r"ldp, as configured, needs a file for the device's key: protect\(..., device=PATH\)"):
        bench.protect(features, memoized)
    with pytest.raises(UserError, match="ldp, as configured, is not memoized"):
        bench.protect(features, LDP(dictionary=small), device=tmp_path / "key")
    assert not (tmp_path / "key").exists()
    (tmp_path / "short").write_bytes(b"secret")
    with pytest.raises(UserError, match="short: a device's key has 32 bytes, but this file has 6"):
        bench.protect(features, memoized, device=tmp_path / "short")
    with pytest.raises(UserError, match="cannot create or read the device's key: No such file"):
        bench.protect(features, memoized, device=tmp_path / "nowhere" / "key")


def test_a_memoized_defense_that_hides_positions_answers_all_photographs_alike(small: Asset, tmp_path: Path) -> None:
    """Photographs have different numbers of keypoints, and so different draws of an order."""
    ldp = LDP(dictionary=small, epsilon=3.0, subset_size=2, memoize=True)
    defense, features = Composed(geometry=RandomLines(), descriptors=ldp), draw_features(50)
    releases = [bench.protect(features.take(np.arange(count)), defense, device=tmp_path / "key") for count in (50, 20)]
    every, some = ({tuple(sorted(row)) for row in words(release).tolist()} for release in releases)
    assert some < every
