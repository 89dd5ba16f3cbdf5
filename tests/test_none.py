"""No defense: what goes in comes out, in memory of its own."""

import numpy as np

from bench.plugin import Privacy
from bench.public import Public
from bench.types import Features
from defenses.none import PLUGIN


def test_releases_the_descriptors_and_shares_no_memory() -> None:
    rng = np.random.default_rng(0)
    descriptors = rng.normal(size=(5, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    keypoints = rng.uniform(0, 64, (5, 2)).astype(np.float32)
    secret = Features(keypoints=keypoints, descriptors=descriptors, codes=None, size=(64, 48))
    release = PLUGIN().protect(secret, Public(), rng)
    kept = descriptors.copy(), keypoints.copy()
    descriptors[:] = 0
    keypoints[:] = 0
    np.testing.assert_array_equal(release.descriptors, kept[0])
    np.testing.assert_array_equal(release.keypoints, kept[1])
    assert release.size == (64, 48)


def test_promises_nothing() -> None:
    assert PLUGIN().privacy(Public()) == Privacy("none")
    assert PLUGIN.name() == "none"
